/* How a board is wired, beside `struct hb_config`: both are written in hilbo_device_config.h. */
#ifndef SETTINGS_H
#define SETTINGS_H

#include <stdint.h>

#include "hb_config.h"

enum settings_output {
    SETTINGS_TWO_PWM,      /* an H-bridge with two inputs: PA8 pushes one way, PA9 the other */
    SETTINGS_PWM_AND_SIGN, /* PA8 has the magnitude, PA9 the sign: high is positive */
    SETTINGS_DAC,          /* PA4: 0 N at half the supply */
    SETTINGS_OUTPUTS       /* how many there are */
};

struct settings {
    uint32_t crystal_Hz; /* 4 to 26 MHz, a multiple of 2 MHz */
    enum settings_output output;
    uint32_t pwm_Hz;    /* 5 to 100 kHz */
    float full_scale_N; /* force at the full command; measured, with the amplifier's own current limit */
    int8_t motor_sign;   /* 1: a positive command pushes the handle out; -1: in */
    int8_t encoder_sign; /* 1: the counter rises into the material; -1: it falls */
};

/* NULL, or one sentence: what is wrong, and what to write. */
const char *settings_fault(const struct settings *settings, const struct hb_config *config);

/* The command for a force: -full_steps to full_steps, 0 for what is no number. */
int32_t settings_steps(const struct settings *settings, float force_N, int32_t full_steps);

#endif
