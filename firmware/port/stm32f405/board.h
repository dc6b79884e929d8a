/* What the device needs of its board. board_real.c has the registers of an STM32F405, board_emulated.c what an emulator
 * has of them, with a simulated finger. The line is uart.h in both. */
#ifndef BOARD_H
#define BOARD_H

#include <stdbool.h>
#include <stdint.h>

#include "hb_config.h"
#include "settings.h"

/* Clock, pins and line; no force, and the motor's driver off. NULL, or one sentence about what is wrong with the settings
 * or does not work: then only the line, and the time, do. */
const char *board_start(const struct settings *settings, const struct hb_config *config);

/* Of enum hb_capability, what this board adds to a config. */
uint8_t board_capabilities(void);

/* Differs at every start; 0 where the board cannot give such a number. */
uint32_t board_boot_id(void);

/* A counter that wraps after 2^32 microseconds. */
uint32_t board_micros(void);

/* From now on `systick_interrupt` at each period. */
void board_start_ticks(uint32_t rate_Hz);

/* The processor waits for an interrupt, which is served when they are on again; called with interrupts off. */
void board_wait(void);

/* A reset unless board_tick_is_over follows within about five periods (3 to 9, as the watchdog's own clock is), again and
 * again. */
void board_start_watchdog(uint32_t period_us);

/* Once a tick, after the force is out, which was so long after the tick was due. */
void board_tick_is_over(uint32_t delay_us);

uint16_t board_encoder_counter(void);
bool board_encoder_is_good(void);
float board_sensed_N(void); /* NaN without a reading */
bool board_stop_is_open(void);

/* The force goes out, and the driver is on from the first one. */
void board_output(float force_N);

/* Longest time from board_output until the pins follow. */
uint32_t board_output_delay_us(void);

/* No force, and the driver off until the next force. */
void board_output_off(void);

/* After a fault of the processor: no force, and nothing more until a reset. */
_Noreturn void board_fault(void);

void systick_interrupt(void);

#endif
