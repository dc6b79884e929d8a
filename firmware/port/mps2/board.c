#include "board.h"

#include <string.h>

/* Registers. */
static volatile uint32_t *at(uintptr_t address)
{
    return (volatile uint32_t *)address;
}

#define NVIC_ENABLE at(0xE000E100U)
#define SYSTICK_CONTROL at(0xE000E010U)
#define SYSTICK_RELOAD at(0xE000E014U)
#define SYSTICK_VALUE at(0xE000E018U)
#define UART_DATA at(0x40004000U)
#define UART_STATE at(0x40004004U)
#define UART_CONTROL at(0x40004008U)
#define UART_INTERRUPT at(0x4000400CU)
#define UART_DIVIDER at(0x40004010U)

enum {
    SYSTICK_ON = 1 << 0,
    SYSTICK_INTERRUPT = 1 << 1,
    SYSTICK_OF_CPU_CLOCK = 1 << 2,
    UART_SENDING_FULL = 1 << 0,
    UART_RECEIVED_FULL = 1 << 1,
    UART_SEND = 1 << 0,
    UART_RECEIVE = 1 << 1,
    UART_RECEIVED_INTERRUPTS = 1 << 3,
    UART_RECEIVED = 1 << 1,
};

void board_start_ticks(void)
{
    *SYSTICK_RELOAD = BOARD_CLOCK_HZ / BOARD_TICK_HZ - 1;
    *SYSTICK_VALUE = 0;
    *SYSTICK_CONTROL = SYSTICK_ON | SYSTICK_INTERRUPT | SYSTICK_OF_CPU_CLOCK;
}

void board_start_counter(void)
{
    *SYSTICK_RELOAD = 0xFFFFFF;
    *SYSTICK_VALUE = 0;
    *SYSTICK_CONTROL = SYSTICK_ON | SYSTICK_OF_CPU_CLOCK;
}

uint32_t board_counter(void)
{
    return *SYSTICK_VALUE;
}

void board_wait(void)
{
    __asm volatile("wfi" ::: "memory");
}

void board_interrupts_off(void)
{
    __asm volatile("cpsid i" ::: "memory");
}

void board_interrupts_on(void)
{
    __asm volatile("cpsie i" ::: "memory");
}

void board_uart_start(void)
{
    *UART_DIVIDER = BOARD_CLOCK_HZ / 921600;
    *UART_CONTROL = UART_SEND | UART_RECEIVE | UART_RECEIVED_INTERRUPTS;
    *NVIC_ENABLE = 1; /* interrupt 0: received */
}

bool board_uart_receive(uint8_t *byte)
{
    if ((*UART_STATE & UART_RECEIVED_FULL) == 0) {
        return false;
    }
    *UART_INTERRUPT = UART_RECEIVED;
    *byte = (uint8_t)*UART_DATA;
    return true;
}

bool board_uart_send(uint8_t byte)
{
    if ((*UART_STATE & UART_SENDING_FULL) != 0) {
        return false;
    }
    *UART_DATA = byte;
    return true;
}

/* Semihosting: operation in r0, its block of arguments in r1, result in r0. */
enum {
    SYS_OPEN = 0x01,
    SYS_CLOSE = 0x02,
    SYS_WRITE0 = 0x04,
    SYS_WRITE = 0x05,
    SYS_READ = 0x06,
    SYS_GET_CMDLINE = 0x15,
    SYS_EXIT_EXTENDED = 0x20,
    APPLICATION_EXIT = 0x20026,
    OPEN_READ_BINARY = 1,
    OPEN_WRITE_BINARY = 5,
};

static int32_t semihosting(int32_t operation, const void *arguments)
{
    register int32_t r0 __asm("r0") = operation;
    register const void *r1 __asm("r1") = arguments;
    __asm volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
}

_Noreturn void board_exit(uint32_t status)
{
    const uint32_t arguments[2] = {APPLICATION_EXIT, status};
    (void)semihosting(SYS_EXIT_EXTENDED, arguments);
    for (;;) {
        board_wait();
    }
}

void board_print(const char *text)
{
    (void)semihosting(SYS_WRITE0, text);
}

void board_print_unsigned(uint32_t value)
{
    char text[11];
    char *first = &text[sizeof text - 1];
    *first = '\0';
    do {
        *--first = (char)('0' + (char)(value % 10U));
        value /= 10U;
    } while (value != 0);
    board_print(first);
}

void board_print_hex(uint32_t value)
{
    char text[9];
    for (unsigned i = 0; i < 8; i++) {
        text[i] = "0123456789abcdef"[(value >> (28U - 4U * i)) & 0xFU];
    }
    text[8] = '\0';
    board_print(text);
}

bool board_command_line(char *text, size_t size)
{
    struct {
        char *text;
        uint32_t size;
    } arguments = {text, (uint32_t)size};
    return semihosting(SYS_GET_CMDLINE, &arguments) == 0;
}

int32_t board_open(const char *path, bool write)
{
    const struct {
        const char *path;
        uint32_t mode;
        uint32_t length;
    } arguments = {path, write ? OPEN_WRITE_BINARY : OPEN_READ_BINARY, (uint32_t)strlen(path)};
    return semihosting(SYS_OPEN, &arguments);
}

size_t board_read(int32_t handle, void *into, size_t size)
{
    const struct {
        int32_t handle;
        void *into;
        uint32_t size;
    } arguments = {handle, into, (uint32_t)size};
    return size - (size_t)semihosting(SYS_READ, &arguments); /* it returns what was not read */
}

bool board_write(int32_t handle, const void *from, size_t size)
{
    const struct {
        int32_t handle;
        const void *from;
        uint32_t size;
    } arguments = {handle, from, (uint32_t)size};
    return semihosting(SYS_WRITE, &arguments) == 0;
}

void board_close(int32_t handle)
{
    (void)semihosting(SYS_CLOSE, &handle);
}
