/* The emulated board: system timer, UART and the debugger's files. No vendor header: the registers are those of the
 * ARMv7-M architecture and of the Cortex-M System Design Kit's UART. */
#ifndef BOARD_H
#define BOARD_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum {
    BOARD_CLOCK_HZ = 25000000,
    BOARD_TICK_HZ = 1000,
};

/* Bytes of stack that have been used so far, at most. */
uint32_t board_stack_bytes_used(void);

/* System timer: `systick_interrupt` every millisecond, or a free-running counter (of 24 bits, counting down). */
void board_start_ticks(void);
void board_start_counter(void);
uint32_t board_counter(void);

/* The processor waits for an interrupt; with interrupts off too, in which case it is served when they are on again. */
void board_wait(void);
void board_interrupts_off(void);
void board_interrupts_on(void);

/* UART 0. `uart_received_interrupt` is called when a byte has come. */
void board_uart_start(void);
bool board_uart_receive(uint8_t *byte);
bool board_uart_send(uint8_t byte); /* false where there is no room */

void systick_interrupt(void);
void uart_received_interrupt(void);

/* Semihosting, which an emulator or a debugger serves. Handles are negative where it does not. */
_Noreturn void board_exit(uint32_t status);
void board_print(const char *text);
void board_print_unsigned(uint32_t value);
void board_print_hex(uint32_t value);
bool board_command_line(char *text, size_t size);
int32_t board_open(const char *path, bool write);
size_t board_read(int32_t handle, void *into, size_t size);
bool board_write(int32_t handle, const void *from, size_t size);
void board_close(int32_t handle);

#endif
