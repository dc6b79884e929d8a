/* The numbers of one device. `hilbo device commission` has measured its damping and its delay; the others are those
 * that the device reports. The build sets `firmware`. A port's own settings, such as HILBO_SETTINGS of the STM32F405
 * port, are no numbers of the core: copy them from the header that the device was built with. */
#ifndef HILBO_DEVICE_CONFIG_H
#define HILBO_DEVICE_CONFIG_H

#include "hb_config.h"

static const struct hb_config HILBO_DEVICE_CONFIG = {{
    .line_rate_baud = {line_rate_baud},
    .tick_rate_Hz = {tick_rate_Hz},
    .watchdog_ticks = {watchdog_ticks},
    .hold_ticks = {hold_ticks},
    .most_taps = {most_taps},
    .most_states = {most_states},
    .capabilities = {capabilities},
    .delay_us = {delay_us}, /* {about_delay} */

    .damping_N_s_per_m = {damping}, /* {about_damping} */
    .force_limit_N = {force_limit_N},
    .continuous_force_N = {continuous_force_N},
    .heating_s = {heating_s},
    .position_low_mm = {position_low_mm},
    .position_high_mm = {position_high_mm},
    .encoder_step_mm = {encoder_step_mm},
    .slew_limit_N_per_s = {slew_limit_N_per_s},
    .velocity_limit_mm_per_s = {velocity_limit_mm_per_s},
    .plausible_step_mm = {plausible_step_mm}, /* not reported: twice the velocity limit in a tick */

    .K0_N_per_mm = {{{K0_low}, {K0_high}}},
    .K1_N_per_mm = {{{K1_low}, {K1_high}}},
    .B1_N_s_alpha_per_mm = {{{B1_low}, {B1_high}}},
    .alpha = {{{alpha_low}, {alpha_high}}},

    /* Not reported: gentle gains; replace them with those of the device's last header. */
    .servo_stiffness_N_per_mm = 1.0F,
    .servo_damping_N_s_per_mm = 0.02F,
    .servo_integral_N_per_mm_s = 5.0F,
    .servo_speed_mm_per_s = {servo_speed_mm_per_s},
}};

#endif
