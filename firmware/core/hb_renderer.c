#include "hb_renderer.h"

#include "hb_math.h"
#include "hb_messages.h"
#include "hb_passivity.h"

/* Elongations below this count as 0: a history without contact ends, and no subnormal number ever slows a tick. */
#define SMALLEST_MM (1.0F / 18446744073709551616.0F) /* 2^-64 */
#define SUM_TOLERANCE 1e-5F
#define NYQUIST_TOLERANCE 1e-4F

/* Three mean delays of the rendering's positive kernel, beside the taps themselves. */
/*@ requires \valid_read(renderer);
    assigns \nothing; */
static uint32_t warm_ticks(const struct hb_renderer *renderer, float moment)
{
    float mean_delay_ticks = renderer->beta_N_per_mm * moment * renderer->rest_share / renderer->set.K1_N_per_mm;
    float taps = renderer->set.memory == HB_SHORT ? (float)renderer->set.length : 0.0F;
    float ticks = taps + 3.0F * mean_delay_ticks;
    if (!(ticks < (float)HB_MAX_WARM_TICKS)) {
        return HB_MAX_WARM_TICKS;
    }
    uint32_t whole = (uint32_t)ticks;
    return (float)whole < ticks ? whole + 1U : whole;
}

void hb_renderer_prepare(struct hb_renderer *renderer, const struct hb_parameters *set)
{
    renderer->set = *set;
    struct hb_sums sums = hb_memory_sums(set, renderer->tap);
    float K1 = set->K1_N_per_mm;
    float beta = set->B1_N_s_alpha_per_mm * hb_power(set->tick_rate_Hz, set->alpha);
    renderer->beta_N_per_mm = beta;
    renderer->gain = K1 / (K1 + beta);
    renderer->stiffness_N_per_mm = hb_series(K1, beta);
    renderer->forgotten = sums.at_dc;
    renderer->rest_share = K1 / (K1 + beta * sums.at_dc);
    renderer->static_stiffness_N_per_mm = hb_static_stiffness(set, beta, sums);
    renderer->static_is_passive = hb_static_stiffness_is_passive(set, beta, sums);
    renderer->minimum_damping_N_s_per_m = hb_minimum_damping(set, beta, sums);
    renderer->warm_ticks = warm_ticks(renderer, sums.moment);
}

void hb_renderer_set_state(struct hb_renderer *renderer, size_t index, float weight, float loss)
{
    if (index < HB_MAX_STATES) {
        renderer->weight[index] = weight;
        renderer->loss[index] = loss;
    }
}

bool hb_renderer_accept_states(struct hb_renderer *renderer)
{
    float sum = 0.0F;
    float nyquist = 0.0F;
    float moment = 0.0F;
    float slower = 1.0F;
    /*@ loop invariant k <= renderer->set.length;
        loop assigns k, sum, nyquist, moment, slower;
        loop variant renderer->set.length - k; */
    for (size_t k = 0U; k < renderer->set.length; k += 1U) {
        float weight = renderer->weight[k];
        float loss = renderer->loss[k];
        if (!(weight > 0.0F && weight <= 1.0F && loss > 0.0F && loss <= slower)) {
            return false;
        }
        slower = loss;
        sum = sum + weight;
        nyquist = nyquist + weight * 2.0F / (2.0F - loss);
        moment = moment + weight / loss;
    }
    renderer->warm_ticks = warm_ticks(renderer, moment);
    float expected = hb_power(2U, renderer->set.alpha);
    return hb_absolute(sum - 1.0F) <= SUM_TOLERANCE && hb_absolute(nyquist - expected) <= NYQUIST_TOLERANCE;
}

void hb_renderer_rest(struct hb_renderer *renderer, float x_mm)
{
    float y_mm = renderer->rest_share * x_mm;
    size_t length = renderer->set.length;
    renderer->y_mm = y_mm;
    renderer->y_rest_mm = 0.0F;
    if (renderer->set.memory == HB_FULL) {
        /*@ loop invariant k <= length;
            loop assigns k, renderer->mean_mm[0 .. HB_MAX_STATES - 1], renderer->rest_mm[0 .. HB_MAX_STATES - 1];
            loop variant length - k; */
        for (size_t k = 0U; k < length; k += 1U) {
            renderer->mean_mm[k] = y_mm;
            renderer->rest_mm[k] = 0.0F;
        }
    } else {
        /*@ loop invariant i <= 2 * length;
            loop assigns i, renderer->history_mm[0 .. 2 * HB_MAX_TAPS - 1];
            loop variant 2 * length - i; */
        for (size_t i = 0U; i < 2U * length; i += 1U) {
            renderer->history_mm[i] = y_mm;
        }
    }
    renderer->oldest = 0U;
    renderer->quiet = y_mm == 0.0F ? length : 0U;
}

/* From the last y to s, short memory: one dot product, oldest first. */
/*@ requires \valid_read(renderer) && hb_renderer_is_sound(renderer) && renderer->set.memory != 1;
    assigns \nothing; */
static float short_behind(const struct hb_renderer *renderer)
{
    const float *row = &renderer->history_mm[renderer->oldest];
    float last_mm = renderer->y_mm;
    float behind_mm = 0.0F;
    /*@ loop invariant i <= renderer->set.length;
        loop assigns i, behind_mm;
        loop variant renderer->set.length - i; */
    for (size_t i = 0U; i < renderer->set.length; i += 1U) {
        behind_mm = behind_mm + renderer->tap[i] * (row[i] - last_mm);
    }
    return behind_mm - renderer->forgotten * last_mm;
}

/*@ requires \valid(renderer) && hb_renderer_is_sound(renderer) && renderer->set.memory != 1;
    assigns renderer->history_mm[0 .. 2 * HB_MAX_TAPS - 1], renderer->oldest, renderer->quiet;
    ensures hb_renderer_is_sound(renderer); */
static void short_push(struct hb_renderer *renderer)
{
    size_t length = renderer->set.length;
    renderer->history_mm[renderer->oldest] = renderer->y_mm;
    renderer->history_mm[renderer->oldest + length] = renderer->y_mm;
    renderer->oldest = renderer->oldest + 1U < length ? renderer->oldest + 1U : 0U;
    if (renderer->y_mm != 0.0F) {
        renderer->quiet = 0U;
    } else if (renderer->quiet < length) {
        renderer->quiet += 1U;
    }
}

/* The same for full memory. */
/*@ requires \valid_read(renderer) && hb_renderer_is_sound(renderer) && renderer->set.memory == 1;
    assigns \nothing; */
static float full_behind(const struct hb_renderer *renderer)
{
    float behind_mm = 0.0F;
    /*@ loop invariant k <= renderer->set.length;
        loop assigns k, behind_mm;
        loop variant renderer->set.length - k; */
    for (size_t k = 0U; k < renderer->set.length; k += 1U) {
        float rest_mm = renderer->rest_mm[k] - renderer->y_rest_mm;
        behind_mm = behind_mm + renderer->weight[k] * ((renderer->mean_mm[k] - renderer->y_mm) + rest_mm);
    }
    return behind_mm;
}

/* m += loss (y - m), where a slow mean moves by less than its own last place. */
/*@ requires \valid(renderer) && hb_renderer_is_sound(renderer) && renderer->set.memory == 1;
    assigns renderer->quiet, renderer->mean_mm[0 .. HB_MAX_STATES - 1], renderer->rest_mm[0 .. HB_MAX_STATES - 1];
    ensures hb_renderer_is_sound(renderer); */
static void full_push(struct hb_renderer *renderer)
{
    float y_mm = renderer->y_mm;
    size_t zeros = 0U;
    /*@ loop invariant zeros <= k <= renderer->set.length;
        loop assigns k, zeros, renderer->mean_mm[0 .. HB_MAX_STATES - 1], renderer->rest_mm[0 .. HB_MAX_STATES - 1];
        loop variant renderer->set.length - k; */
    for (size_t k = 0U; k < renderer->set.length; k += 1U) {
        float mean = renderer->mean_mm[k];
        float rest = renderer->rest_mm[k];
        float change = rest + renderer->loss[k] * ((y_mm - mean) + (renderer->y_rest_mm - rest));
        float next = mean + change;
        rest = change - (next - mean);
        if (hb_absolute(next) < SMALLEST_MM) {
            next = 0.0F;
            rest = 0.0F;
            zeros += 1U;
        }
        renderer->mean_mm[k] = next;
        renderer->rest_mm[k] = rest;
    }
    renderer->quiet = y_mm == 0.0F ? zeros : 0U;
}

float hb_renderer_step(struct hb_renderer *renderer, float x_mm)
{
    if (x_mm == 0.0F && renderer->quiet == renderer->set.length) {
        return 0.0F; /* no contact, and none remembered: what follows would give the same, and change nothing */
    }
    bool full = renderer->set.memory == HB_FULL;
    float before_mm = renderer->y_mm;
    float behind_mm = full ? full_behind(renderer) : short_behind(renderer);
    float spring_mm = x_mm - (before_mm + behind_mm);
    float change_mm = renderer->y_rest_mm + (behind_mm + renderer->gain * spring_mm);
    float y_mm = before_mm + change_mm;
    float y_rest_mm = change_mm - (y_mm - before_mm);
    bool gone = hb_absolute(y_mm) < SMALLEST_MM;
    renderer->y_mm = gone ? 0.0F : y_mm;
    renderer->y_rest_mm = gone ? 0.0F : y_rest_mm;
    if (full) {
        full_push(renderer);
    } else {
        short_push(renderer);
    }
    return renderer->set.K0_N_per_mm * x_mm + renderer->stiffness_N_per_mm * spring_mm;
}
