#include "hb_config.h"

#include "hb_math.h"

const char *hb_error_sentence(enum hb_error error)
{
    switch (error) {
    case HB_OK:
        return "The config is in order.";
    case HB_ERROR_TICKS:
        return "tick_rate_Hz must be 100 to 10000, watchdog_ticks 1 tick to 1 s and hold_ticks 1 tick to 0.1 s.";
    case HB_ERROR_MAXIMA:
        return "most_taps and most_states must be at most HB_MAX_TAPS and HB_MAX_STATES: build with larger maxima.";
    case HB_ERROR_CAPABILITIES:
        return "capabilities has a bit without a name: use those of enum hb_capability.";
    case HB_ERROR_LINE:
        return "line_rate_baud must be 1200 to 100000000.";
    case HB_ERROR_LIMITS:
        return "damping must be 0.001 to 1000 N.s/m, the force limit at most 100 N, the slew limit at least "
               "the force limit in 1 s, the velocity limit at least one encoder step a tick; all finite.";
    case HB_ERROR_STROKE:
        return "The stroke must reach an encoder step or more to both sides of 0, within 32767 steps, each <= 0.1 mm.";
    case HB_ERROR_STEP:
        return "plausible_step_mm must be finite and larger than what the velocity limit allows in one tick.";
    case HB_ERROR_PARAMETERS:
        return "Each parameter range must be finite with low <= high, K1 and B1 above 0, alpha in [2^-10, 1 - 2^-10].";
    case HB_ERROR_SERVO:
        return "The servo's gains must be finite and not negative, its speed above 0 and below the velocity limit.";
    case HB_ERROR_DELAY:
        return "delay_us must be at most one period, and above 0 on a device that is not simulated: measure it.";
    case HB_ERROR_HEATING:
        return "continuous_force_N must be above 0 and at most the force limit, heating_s 0.1 to 1000 s.";
    case HB_ERROR_BOOT_ID:
        return "The boot id is 0: give one that differs at every start.";
    case HB_ERROR_CONTRACTION:
        return "The compiler fuses products and sums, which changes the forces: build with -ffp-contract=off.";
    case HB_ERRORS:
    default:
        return "This error has no name.";
    }
}

static bool within(float value, float low, float high)
{
    return value >= low && value <= high; /* no NaN is */
}

static bool is_range(struct hb_range range, float low, float high)
{
    return within(range.low, low, high) && within(range.high, range.low, high);
}

#define LARGEST 1e6F   /* of any setting: products of two stay finite by far */
#define SMALLEST 1e-6F /* of those that must not be 0 */

static bool ticks_are_good(const struct hb_config *c)
{
    return c->tick_rate_Hz >= 100U && c->tick_rate_Hz <= 10000U && c->watchdog_ticks >= 1U &&
           c->watchdog_ticks <= c->tick_rate_Hz && c->hold_ticks >= 1U && c->hold_ticks * 10U <= c->tick_rate_Hz;
}

static bool limits_are_good(const struct hb_config *c)
{
    float rate_Hz = (float)c->tick_rate_Hz;
    return within(c->damping_N_s_per_m, 0.001F, 1000.0F) && within(c->force_limit_N, SMALLEST, 100.0F) &&
           within(c->slew_limit_N_per_s, c->force_limit_N, LARGEST) &&
           within(c->velocity_limit_mm_per_s, SMALLEST, LARGEST) &&
           c->velocity_limit_mm_per_s >= c->encoder_step_mm * rate_Hz;
}

static bool delay_is_good(const struct hb_config *c)
{
    bool simulated = (c->capabilities & (uint8_t)HB_IS_SIMULATED) != 0U;
    return c->delay_us <= 1000000U / c->tick_rate_Hz && (simulated || c->delay_us > 0U);
}

static bool heating_is_good(const struct hb_config *c)
{
    return within(c->continuous_force_N, SMALLEST, c->force_limit_N) && within(c->heating_s, 0.1F, 1000.0F);
}

static bool stroke_is_good(const struct hb_config *c)
{
    float reach_mm = 32767.0F * c->encoder_step_mm;
    return within(c->encoder_step_mm, SMALLEST, 0.1F) && within(c->position_low_mm, -reach_mm, -c->encoder_step_mm) &&
           within(c->position_high_mm, c->encoder_step_mm, reach_mm);
}

static bool parameters_are_good(const struct hb_config *c)
{
    return is_range(c->K0_N_per_mm, -LARGEST, LARGEST) && is_range(c->K1_N_per_mm, SMALLEST, LARGEST) &&
           is_range(c->B1_N_s_alpha_per_mm, SMALLEST, LARGEST) &&
           is_range(c->alpha, 1.0F / 1024.0F, 1.0F - 1.0F / 1024.0F);
}

static bool servo_is_good(const struct hb_config *c)
{
    return within(c->servo_stiffness_N_per_mm, 0.0F, LARGEST) && within(c->servo_damping_N_s_per_mm, 0.0F, LARGEST) &&
           within(c->servo_integral_N_per_mm_s, 0.0F, LARGEST) &&
           within(c->servo_speed_mm_per_s, SMALLEST, c->velocity_limit_mm_per_s);
}

enum hb_error hb_config_check(const struct hb_config *config)
{
    if (!ticks_are_good(config)) {
        return HB_ERROR_TICKS;
    }
    if (config->most_taps > HB_MAX_TAPS || config->most_states > HB_MAX_STATES) {
        return HB_ERROR_MAXIMA;
    }
    if (config->capabilities >= 32U) {
        return HB_ERROR_CAPABILITIES;
    }
    if (config->line_rate_baud < 1200U || config->line_rate_baud > 100000000U) {
        return HB_ERROR_LINE;
    }
    if (!limits_are_good(config)) {
        return HB_ERROR_LIMITS;
    }
    if (!stroke_is_good(config)) {
        return HB_ERROR_STROKE;
    }
    float fastest_mm = config->velocity_limit_mm_per_s / (float)config->tick_rate_Hz;
    if (!(config->plausible_step_mm > fastest_mm && config->plausible_step_mm <= LARGEST)) {
        return HB_ERROR_STEP;
    }
    if (!parameters_are_good(config)) {
        return HB_ERROR_PARAMETERS;
    }
    if ((config->capabilities & (uint8_t)HB_CAN_DRIVE) != 0U && !servo_is_good(config)) {
        return HB_ERROR_SERVO;
    }
    if (!delay_is_good(config)) {
        return HB_ERROR_DELAY;
    }
    if (!heating_is_good(config)) {
        return HB_ERROR_HEATING;
    }
    return HB_OK;
}
