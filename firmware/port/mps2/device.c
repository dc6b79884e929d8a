/* Image: the device with its simulated finger, speaking the protocol over UART 0.
 *
 * Bytes are put into a ring by their interrupt. Everything else is one loop, in which the tick comes first: the timer's
 * interrupt only counts, and a count of two or more is an overrun. At the end of SysTick's interrupt the loop goes
 * on where it was, so that the longest wait of a tick is one call of hb_receive. */
#include "board.h"
#include "rig.h"
#include "ring.h"

static struct ring received;
static volatile uint32_t ticks_due;
static struct sim_rig rig;
static struct {
    uint8_t bytes[64];
    size_t size;
    size_t sent;
} unsent;

void systick_interrupt(void)
{
    ticks_due++;
}

void uart_received_interrupt(void)
{
    uint8_t byte = 0;
    while (board_uart_receive(&byte)) {
        ring_put(&received, byte);
    }
}

static bool receive(void)
{
    uint8_t byte = 0;
    const bool any = ring_take(&received, &byte);
    if (any) {
        (void)hb_receive(&rig.device, &byte, 1);
    }
    return any;
}

static bool transmit(void)
{
    if (unsent.sent == unsent.size) {
        unsent.sent = 0;
        unsent.size = hb_transmit(&rig.device, unsent.bytes, sizeof unsent.bytes);
    }
    const bool any = unsent.sent < unsent.size && board_uart_send(unsent.bytes[unsent.sent]);
    unsent.sent += any ? 1U : 0U;
    return any;
}

/* Until the next interrupt, unless there has been one since the loop looked. */
static void rest(void)
{
    board_interrupts_off();
    if (ticks_due == 0 && ring_is_empty(&received)) {
        board_wait();
    }
    board_interrupts_on();
}

/* The board has no memory that outlives a reset: its boot ids differ by the time at which the line first speaks. */
static uint32_t first_boot_id(void)
{
    uint32_t ticks_before = 0;
    while (ring_is_empty(&received)) {
        rest();
        ticks_before += ticks_due;
        ticks_due = 0;
    }
    return (ticks_before * (BOARD_CLOCK_HZ / BOARD_TICK_HZ) - board_counter()) * UINT32_C(2654435761) | 1U;
}

static void tick(void)
{
    board_interrupts_off();
    const uint32_t due = ticks_due;
    ticks_due = 0;
    board_interrupts_on();
    rig.late_ticks = due > 1U ? 1U : 0U;
    (void)sim_rig_tick(&rig);
}

int main(void)
{
    struct sim_rig_config config = sim_rig_defaults();
    config.world.substeps = 10; /* a Cortex-M4 has no double precision in hardware */
    board_uart_start();
    board_start_ticks();
    if (sim_rig_start(&rig, &config, first_boot_id()) != HB_OK) {
        return 1;
    }
    ticks_due = 0;
    for (;;) {
        if (ticks_due > 0) {
            tick();
        } else if (!receive() && !transmit()) {
            rest();
        }
    }
}
