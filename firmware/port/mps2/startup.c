/* From reset to `main`: vectors, FPU, variables, and a painted stack, whose high-water mark tells how deep it was. */
#include "board.h"

#include <stddef.h>

#include "cortex_m.h"

extern uint32_t stack_low[], stack_high[], data_low[], data_high[], bss_low[], bss_high[];
extern const uint32_t data_image[];

_Noreturn void reset(void);
int main(void);

enum { PAINT = 0x5AFE57AC, INTERRUPTS = 32, FIRST_INTERRUPT = 16 };

static _Noreturn void fault(void)
{
    board_exit(3);
}

static void nothing(void)
{
}

void __attribute__((weak)) systick_interrupt(void)
{
}

void __attribute__((weak)) uart_received_interrupt(void)
{
}

union vector {
    const void *stack;
    void (*handler)(void);
};

__attribute__((section(".vectors"), used)) static const union vector VECTORS[FIRST_INTERRUPT + INTERRUPTS] = {
    [0] = {.stack = stack_high},
    [1] = {.handler = reset},
    [2] = {.handler = nothing}, /* NMI */
    [3] = {.handler = fault},   /* hard fault */
    [4] = {.handler = fault},   /* memory */
    [5] = {.handler = fault},   /* bus */
    [6] = {.handler = fault},   /* usage */
    [11] = {.handler = fault},  /* SVC */
    [12] = {.handler = fault},  /* debug */
    [14] = {.handler = fault},  /* PendSV */
    [15] = {.handler = systick_interrupt},
    [FIRST_INTERRUPT] = {.handler = uart_received_interrupt},
};

_Noreturn void reset(void)
{
    cortex_m_enable_fpu();
    const uint32_t *const here = __builtin_frame_address(0);
    cortex_m_fill(stack_low, here - 32, (uint32_t)PAINT); /* what this function itself may still use stays */
    cortex_m_copy(data_low, data_high, data_image);
    cortex_m_fill(bss_low, bss_high, 0);
    board_exit((uint32_t)main());
}

uint32_t board_stack_bytes_used(void)
{
    const size_t words = ((uintptr_t)stack_high - (uintptr_t)stack_low) / sizeof stack_low[0];
    size_t clean = 0;
    while (clean < words && stack_low[clean] == (uint32_t)PAINT) {
        clean++;
    }
    return (uint32_t)((words - clean) * sizeof stack_low[0]);
}

