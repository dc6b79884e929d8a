/* USART1, with a ring for each direction: interrupts move the bytes. */
#ifndef UART_H
#define UART_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

void uart_start(uint32_t clock_Hz, uint32_t baud);

/* False where no byte has come. */
bool uart_receive(uint8_t *byte);
bool uart_has_received(void);

/* So many bytes can be sent now. */
size_t uart_room(void);
void uart_send(const uint8_t *bytes, size_t size);

void usart1_interrupt(void);

#endif
