/* The numbers of one device on an STM32F405 board: copy this file, measure, write yours, and build with
 *
 *     make -C firmware images STM32F405_CONFIG=/folder/of/your/copy
 *
 * docs/device/firmware.md says how to find each. As they stand the numbers are careful guesses: at most 5 N, and so
 * little damping that only soft sets are accepted. The build sets `firmware`. */
#ifndef HILBO_DEVICE_CONFIG_H
#define HILBO_DEVICE_CONFIG_H

#include "hb_config.h"
#include "settings.h"

static const struct hb_config HILBO_DEVICE_CONFIG = {
    .line_rate_baud = 921600,
    .tick_rate_Hz = 1000,
    .watchdog_ticks = 250,
    .hold_ticks = 20,
    .most_taps = 255,
    .most_states = 12,
    .capabilities = HB_CAN_DRIVE, /* an incremental encoder: not homed at boot */
    .delay_us = 400,

    .damping_N_s_per_m = 0.3F,
    .force_limit_N = 5.0F,
    .continuous_force_N = 2.0F,
    .heating_s = 10.0F,
    .position_low_mm = -5.1F,
    .position_high_mm = 20.1F,
    .encoder_step_mm = 80.0F / 8192.0F, /* travel of one turn, by 4 times the encoder's lines */
    .slew_limit_N_per_s = 500.0F,
    .velocity_limit_mm_per_s = 500.0F,
    .plausible_step_mm = 1.0F,

    .K0_N_per_mm = {-10.0F, 10.0F},
    .K1_N_per_mm = {0.001F, 10.0F},
    .B1_N_s_alpha_per_mm = {0.0001F, 10.0F},
    .alpha = {0.005F, 0.995F},

    .servo_stiffness_N_per_mm = 1.0F,
    .servo_damping_N_s_per_mm = 0.02F,
    .servo_integral_N_per_mm_s = 5.0F,
    .servo_speed_mm_per_s = 50.0F,
};

static const struct settings HILBO_SETTINGS = {
    .crystal_Hz = 8000000,
    .output = SETTINGS_TWO_PWM,
    .pwm_Hz = 20000,
    .full_scale_N = 10.0F,
    .motor_sign = 1,
    .encoder_sign = 1,
};

#endif
