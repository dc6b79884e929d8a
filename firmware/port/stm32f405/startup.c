/* From reset to `main`: vectors, floating-point unit, variables, and a painted stack. */
#include <stdint.h>

#include "board.h"
#include "cortex_m.h"
#include "registers.h"
#include "uart.h"

extern uint32_t stack_low[], stack_high[], data_low[], data_high[], bss_low[], bss_high[];
extern const uint32_t data_image[];

_Noreturn void reset(void);
int main(void);

enum { PAINT = 0x5AFE57AC, INTERRUPTS = 82, FIRST_INTERRUPT = 16 };

union vector {
    const void *stack;
    void (*handler)(void);
};

#define FAULT {.handler = board_fault}
#define FAULTS_4 FAULT, FAULT, FAULT, FAULT
#define FAULTS_12 FAULTS_4, FAULTS_4, FAULTS_4
#define FAULTS_13 FAULTS_12, FAULT
#define FAULTS_37 FAULTS_12, FAULTS_12, FAULTS_13
#define FAULTS_44 FAULTS_12, FAULTS_12, FAULTS_12, FAULTS_4, FAULTS_4

/* An interrupt that nobody asked for is a fault too. NMI: the crystal has failed. */
__attribute__((section(".vectors"), used)) static const union vector VECTORS[FIRST_INTERRUPT + INTERRUPTS] = {
    {.stack = stack_high},        {.handler = reset}, FAULTS_13, {.handler = systick_interrupt}, /* the processor's */
    FAULTS_37, {.handler = usart1_interrupt}, FAULTS_44,                                         /* the chip's */
};

_Static_assert(USART1_INTERRUPT == 37 && INTERRUPTS == 37 + 1 + 44, "the macros above fill the table of vectors");

_Noreturn void reset(void)
{
    *CORTEX_M_VECTORS = (uint32_t)(uintptr_t)VECTORS; /* a boot loader may have left its own */
    cortex_m_enable_fpu();
    const uint32_t *const here = __builtin_frame_address(0);
    cortex_m_fill(stack_low, here - 32, (uint32_t)PAINT); /* what this function itself may still use stays */
    cortex_m_copy(data_low, data_high, data_image);
    cortex_m_fill(bss_low, bss_high, 0);
    (void)main();
    board_fault();
}
