/* Image: the device on an STM32F405, or on what an emulator has of one.
 *
 * Interrupts move the line's bytes and count the ticks that are due. Everything else is one loop, in which the tick
 * comes first: its longest wait is one call of hb_receive. Two ticks due are an overrun, and how late each force was is
 * measured. */
#include "board.h"
#include "cortex_m.h"
#include "encoder.h"
#include "hb_device.h"
#include "hilbo_device_config.h"
#include "uart.h"

#ifndef HB_FIRMWARE_HASH
#define HB_FIRMWARE_HASH 0 /* the build sets it: CRC-32 of the core's sources */
#endif

static struct hb_config config;
static struct hb_device device;
static struct encoder encoder;
static volatile uint32_t ticks_due;
static uint32_t period_us;
static uint32_t due_us;   /* when the last tick was due */
static uint32_t delay_us; /* from then until its force was out */
static bool is_late;      /* a tick was missed before this one */

void systick_interrupt(void)
{
    ticks_due++;
}

static uint32_t take_ticks_due(void)
{
    cortex_m_interrupts_off();
    const uint32_t due = ticks_due;
    ticks_due = 0;
    cortex_m_interrupts_on();
    return due;
}

/* When this tick was due. An interrupt of the timer that was itself missed is no tick: time goes on without it. */
static void follow_time(uint32_t due)
{
    due_us += due * period_us;
    const uint32_t late_us = board_micros() - due_us;
    is_late = due > 1U || late_us >= period_us;
    if (late_us >= period_us) {
        due_us += late_us;
    }
}

/* ESTOP cuts the driver off too, whoever asked for it. */
static void put_out(float force_N)
{
    if (device.state == (uint8_t)HB_ESTOPPED) {
        board_output_off();
    } else {
        board_output(force_N);
    }
}

static void tick(void)
{
    follow_time(take_ticks_due());
    const struct hb_input input = {
        .position_counts = encoder_extend(&encoder, board_encoder_counter()) * HILBO_SETTINGS.encoder_sign,
        .position_valid = board_encoder_is_good(),
        .overrun = is_late,
        .stop_open = board_stop_is_open(),
        .delay_us = delay_us,
        .sensed_N = board_sensed_N(),
    };
    put_out(hb_tick(&device, &input));
    delay_us = board_micros() - due_us + 1U + board_output_delay_us(); /* rounded up */
    board_tick_is_over(delay_us);
}

static bool receive(void)
{
    uint8_t byte = 0;
    const bool any = uart_receive(&byte);
    if (any) {
        (void)hb_receive(&device, &byte, 1);
        if (device.state == (uint8_t)HB_ESTOPPED) {
            board_output_off(); /* at once; the next tick does the rest */
        }
    }
    return any;
}

static bool transmit(void)
{
    uint8_t bytes[64];
    const size_t room = uart_room();
    const size_t size = hb_transmit(&device, bytes, room < sizeof bytes ? room : sizeof bytes);
    if (size > 0) {
        uart_send(bytes, size);
    }
    return size > 0;
}

/* Until the next interrupt, unless there has been one since the loop looked. */
static void rest(void)
{
    cortex_m_interrupts_off();
    if (ticks_due == 0 && !uart_has_received()) {
        board_wait();
    }
    cortex_m_interrupts_on();
}

static void say(const char *text)
{
    for (; *text != '\0'; text++) {
        while (uart_room() == 0) {
        }
        uart_send((const uint8_t *)text, 1);
    }
}

/* A device that cannot start has no force and no answer. It says why, in plain text, once a second. */
static _Noreturn void refuse(const char *sentence)
{
    for (;;) {
        const uint32_t began_us = board_micros();
        say(sentence);
        say("\r\n");
        while (board_micros() - began_us < 1000000U) {
        }
    }
}

static const char *start(void)
{
    config = HILBO_DEVICE_CONFIG;
    config.firmware = HB_FIRMWARE_HASH;
    config.capabilities |= board_capabilities();
    const char *sentence = board_start(&HILBO_SETTINGS, &config);
    if (sentence == NULL) {
        const enum hb_error error = hb_init(&device, &config, board_boot_id());
        sentence = error != HB_OK ? hb_error_sentence(error) : NULL;
    }
    return sentence;
}

int main(void)
{
    const char *sentence = start();
    if (sentence != NULL) {
        refuse(sentence);
    }
    period_us = 1000000U / config.tick_rate_Hz;
    board_start_watchdog(period_us);
    encoder.counter = board_encoder_counter();
    cortex_m_interrupts_off();
    due_us = board_micros(); /* before the timer starts, so that no tick comes before it is due */
    board_start_ticks(config.tick_rate_Hz);
    cortex_m_interrupts_on();
    for (;;) {
        if (ticks_due > 0) {
            tick();
        } else if (!receive() && !transmit()) {
            rest();
        }
    }
}
