#include "hb_safety.h"

#include "hb_math.h"

#define ENERGY_SCALE 1048576.0F                /* 2^20: units of energy in a mJ */
#define MOST_COUNTS 32767                      /* of a position, which telemetry tells in 16 bits */
#define LARGEST_ENERGY (INT64_C(1) << 60)      /* the observer stays there: centuries of pressing */

void hb_count_up(uint16_t *counter)
{
    if (*counter < UINT16_MAX) {
        *counter = (uint16_t)(*counter + 1U);
    }
}

void hb_safety_begin(struct hb_safety *safety, const struct hb_config *config)
{
    safety->homed = (config->capabilities & (uint8_t)HB_IS_HOMED_AT_BOOT) != 0U;
    safety->placed = safety->homed;
    safety->heat_share = 1.0F / (config->heating_s * (float)config->tick_rate_Hz);
}

void hb_home(struct hb_safety *safety, const struct hb_config *config, float position_mm)
{
    float steps = position_mm / config->encoder_step_mm;
    int32_t counts = (int32_t)(steps < 0.0F ? steps - 0.5F : steps + 0.5F);
    float rounded_mm = (float)counts * config->encoder_step_mm;
    if (rounded_mm > config->position_high_mm) {
        counts -= 1; /* rounded out of the stroke, where every position would be bad */
    } else if (rounded_mm < config->position_low_mm) {
        counts += 1;
    }
    safety->zero_counts += safety->counts - counts;
    safety->counts = counts;
    safety->homed = true;
}

/* Before the device is homed, the stroke is unknown: any position that telemetry can tell is within it. */
static bool is_within_stroke(const struct hb_safety *safety, const struct hb_config *config, int32_t counts)
{
    float position_mm = (float)counts * config->encoder_step_mm;
    return !safety->homed || (position_mm >= config->position_low_mm && position_mm <= config->position_high_mm);
}

static bool is_plausible(const struct hb_safety *safety, const struct hb_config *config, int32_t counts)
{
    if (!is_within_stroke(safety, config, counts)) {
        return false;
    }
    if (!safety->known) {
        return true;
    }
    float step_mm = (float)(counts - safety->counts) * config->encoder_step_mm;
    return hb_absolute(step_mm) <= config->plausible_step_mm * (float)(safety->bad + 1U);
}

static void believe(struct hb_safety *safety, int32_t counts)
{
    safety->step_counts = safety->known ? counts - safety->counts : 0;
    safety->step_ticks = (uint16_t)(safety->bad + 1U);
    safety->counts = counts;
    safety->known = true;
    safety->lost = false;
    safety->bad = 0U;
    safety->loss = safety->loss > 0U ? (uint16_t)(safety->loss - 1U) : 0U;
}

bool hb_check_input(struct hb_safety *safety, const struct hb_config *config, const struct hb_input *input)
{
    if (!safety->placed && input->position_valid) {
        safety->zero_counts = input->position_counts;
        safety->placed = true;
    }
    int64_t counts = input->position_counts - safety->zero_counts;
    bool told = counts >= -MOST_COUNTS && counts <= MOST_COUNTS; /* no stroke reaches further */
    if (input->position_valid && told && is_plausible(safety, config, (int32_t)counts)) {
        believe(safety, (int32_t)counts);
        return true;
    }
    hb_count_up(&safety->count.input_held);
    safety->flags |= (uint16_t)HB_FLAG_INPUT_HELD;
    safety->step_counts = 0;
    safety->step_ticks = 1U;
    safety->bad = (uint16_t)(safety->bad + 1U);
    safety->loss = (uint16_t)(safety->loss + HB_LOSS_OF_BAD);
    if (safety->loss < HB_LOSS_LIMIT) {
        return true;
    }
    safety->bad = 0U;
    safety->loss = HB_LOSS_LIMIT;
    safety->known = false; /* the next position within the stroke is a new beginning */
    safety->lost = true;
    /* An incremental encoder may have missed counts meanwhile: where the surface is must be told again. */
    safety->homed = safety->homed && (config->capabilities & (uint8_t)HB_IS_HOMED_AT_BOOT) != 0U;
    return false;
}

bool hb_input_is_good(const struct hb_safety *safety)
{
    return safety->known && safety->bad == 0U && !safety->lost;
}

float hb_position_mm(const struct hb_safety *safety, const struct hb_config *config)
{
    return (float)safety->counts * config->encoder_step_mm;
}

bool hb_in_contact(const struct hb_safety *safety)
{
    return safety->counts > 0;
}

float hb_penetration_mm(const struct hb_safety *safety, const struct hb_config *config)
{
    return hb_in_contact(safety) ? hb_position_mm(safety, config) : 0.0F;
}

void hb_observe(struct hb_safety *safety, const struct hb_config *config)
{
    bool touches = hb_in_contact(safety);
    if (touches && !safety->touching) {
        safety->energy = 0;
    }
    safety->touching = touches;
    float step_mm = (float)safety->step_counts * config->encoder_step_mm;
    int64_t taken = (int64_t)(safety->force_N * step_mm * ENERGY_SCALE);
    int64_t energy = safety->energy + taken;
    if (energy < LARGEST_ENERGY && energy > -LARGEST_ENERGY) {
        safety->energy = energy;
    }
}

float hb_energy_mJ(const struct hb_safety *safety)
{
    return (float)safety->energy / ENERGY_SCALE;
}

float hb_control(struct hb_safety *safety, const struct hb_config *config, float force_N)
{
    float step_mm = (float)safety->step_counts * config->encoder_step_mm;
    if (safety->energy >= 0 || safety->step_counts == 0) {
        return force_N;
    }
    hb_count_up(&safety->count.controlled);
    safety->flags |= (uint16_t)HB_FLAG_CONTROLLED;
    float rate_Hz = (float)config->tick_rate_Hz / (float)safety->step_ticks;
    float most_N = config->damping_N_s_per_m * hb_absolute(step_mm) * rate_Hz / 1000.0F;
    float added_N = hb_clamp(-hb_energy_mJ(safety) / step_mm, -force_N, most_N);
    return force_N + added_N;
}

void hb_mark_saturated(struct hb_safety *safety)
{
    hb_count_up(&safety->count.saturated);
    safety->flags |= (uint16_t)HB_FLAG_SATURATED;
}

float hb_saturate(struct hb_safety *safety, float force_N, float limit_N)
{
    if (hb_absolute(force_N) <= limit_N) {
        return force_N;
    }
    hb_mark_saturated(safety);
    return hb_clamp(force_N, -limit_N, limit_N);
}

float hb_slew(struct hb_safety *safety, const struct hb_config *config, float force_N, float expected_N)
{
    float step_N = config->slew_limit_N_per_s / (float)config->tick_rate_Hz;
    if (hb_absolute(expected_N - safety->force_N) > step_N) {
        hb_count_up(&safety->count.slewed);
        safety->flags |= (uint16_t)HB_FLAG_SLEWED;
    }
    return hb_clamp(force_N, safety->force_N - step_N, safety->force_N + step_N);
}

bool hb_is_too_hot(struct hb_safety *safety, const struct hb_config *config)
{
    safety->heat_N2 += safety->heat_share * (safety->force_N * safety->force_N - safety->heat_N2);
    return safety->heat_N2 > config->continuous_force_N * config->continuous_force_N;
}

bool hb_is_too_fast(const struct hb_safety *safety, const struct hb_config *config, float limit_mm_per_s)
{
    float step_mm = hb_absolute((float)safety->step_counts * config->encoder_step_mm);
    return step_mm * (float)config->tick_rate_Hz > limit_mm_per_s * (float)safety->step_ticks;
}

void hb_ramp_begin(struct hb_safety *safety)
{
    safety->ramp_N = safety->force_N;
    safety->ramp_ticks = 0U;
}

float hb_ramp(struct hb_safety *safety, const struct hb_config *config)
{
    if (safety->ramp_ticks < config->hold_ticks) {
        safety->ramp_ticks = (uint16_t)(safety->ramp_ticks + 1U);
    }
    uint16_t left = (uint16_t)(config->hold_ticks - safety->ramp_ticks);
    return safety->ramp_N * ((float)left / (float)config->hold_ticks);
}

bool hb_ramp_has_ended(const struct hb_safety *safety, const struct hb_config *config)
{
    return safety->ramp_ticks >= config->hold_ticks;
}
