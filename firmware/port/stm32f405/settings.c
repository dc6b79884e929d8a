#include "settings.h"

#include <stdbool.h>
#include <stddef.h>

static bool is_sign(int8_t sign)
{
    return sign == 1 || sign == -1;
}

const char *settings_fault(const struct settings *settings, const struct hb_config *config)
{
    if (settings->crystal_Hz % 2000000U != 0U || settings->crystal_Hz < 4000000U || settings->crystal_Hz > 26000000U) {
        return "crystal_Hz must be a multiple of 2 MHz, from 4 to 26 MHz.";
    }
    if (settings->output >= SETTINGS_OUTPUTS) {
        return "output must be one of enum settings_output.";
    }
    if (settings->pwm_Hz < 5000U || settings->pwm_Hz > 100000U) {
        return "pwm_Hz must be 5000 to 100000.";
    }
    if (!(settings->full_scale_N >= config->force_limit_N && settings->full_scale_N <= 1000.0F)) {
        return "full_scale_N must be the force limit or more, and at most 1000 N: measure it.";
    }
    if (!is_sign(settings->motor_sign) || !is_sign(settings->encoder_sign)) {
        return "motor_sign and encoder_sign must be 1 or -1.";
    }
    if (config->tick_rate_Hz == 0U || 1000000U % config->tick_rate_Hz != 0U) {
        return "tick_rate_Hz must divide 1000000: ticks are timed in whole microseconds.";
    }
    return NULL;
}

int32_t settings_steps(const struct settings *settings, float force_N, int32_t full_steps)
{
    const float full = (float)full_steps;
    const float steps = force_N / settings->full_scale_N * full * (float)settings->motor_sign;
    if (!(steps >= -full)) {
        return steps < 0.0F ? -full_steps : 0;
    }
    if (steps > full) {
        return full_steps;
    }
    return (int32_t)(steps < 0.0F ? steps - 0.5F : steps + 0.5F);
}
