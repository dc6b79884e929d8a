#include "uart.h"

#include "cortex_m.h"
#include "registers.h"
#include "ring.h"

static struct ring received;
static struct ring unsent;

/* To the nearest divider: 91 of 84 MHz gives 923077 baud in place of 921600. */
void uart_start(uint32_t clock_Hz, uint32_t baud)
{
    *USART_BRR(USART1) = (clock_Hz + baud / 2U) / baud;
    *USART_CR1(USART1) = USART_CR1_ON | USART_CR1_SEND | USART_CR1_RECEIVE | USART_CR1_RECEIVED_INTERRUPTS;
    cortex_m_enable_interrupt(USART1_INTERRUPT);
}

bool uart_receive(uint8_t *byte)
{
    return ring_take(&received, byte);
}

bool uart_has_received(void)
{
    return !ring_is_empty(&received);
}

size_t uart_room(void)
{
    return ring_room(&unsent);
}

/* False where the line has no room, or nothing is left to send. */
static bool send_one(void)
{
    uint8_t byte = 0;
    const bool any = (*USART_SR(USART1) & USART_SR_ROOM) != 0U && ring_take(&unsent, &byte);
    if (any) {
        *USART_DR(USART1) = byte;
    }
    return any;
}

/* The line takes a byte or two at once, an emulated one all of them; interrupts send the rest. */
void uart_send(const uint8_t *bytes, size_t size)
{
    for (size_t i = 0; i < size; i++) {
        ring_put(&unsent, bytes[i]);
    }
    cortex_m_interrupts_off(); /* which take from the same ring, and change the same register */
    while (send_one()) {
    }
    if (!ring_is_empty(&unsent)) {
        *USART_CR1(USART1) |= USART_CR1_ROOM_INTERRUPTS;
    }
    cortex_m_interrupts_on();
}

/* An overrun lost a byte, which the frame's CRC will tell; reading the data ends it. */
void usart1_interrupt(void)
{
    const uint32_t state = *USART_SR(USART1);
    if ((state & (USART_SR_RECEIVED | USART_SR_OVERRUN)) != 0U) {
        const uint8_t byte = (uint8_t)*USART_DR(USART1);
        if ((state & USART_SR_RECEIVED) != 0U) {
            ring_put(&received, byte);
        }
    }
    (void)send_one();
    if (ring_is_empty(&unsent)) {
        *USART_CR1(USART1) &= ~(uint32_t)USART_CR1_ROOM_INTERRUPTS;
    }
}
