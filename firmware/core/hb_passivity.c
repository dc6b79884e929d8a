#include "hb_passivity.h"

#include "hb_math.h"
#include "hb_messages.h"

#define ROUNDING (1.0F / 65536.0F)

struct hb_sums hb_memory_sums(const struct hb_parameters *set, float *tap)
{
    struct hb_sums sums = {.at_dc = 1.0F, .at_nyquist = 1.0F, .moment = 0.0F};
    if (set->memory == HB_FULL) {
        return (struct hb_sums){.at_dc = 0.0F, .at_nyquist = hb_power(2U, set->alpha), .moment = 0.0F};
    }
    /*@ loop invariant 1 <= i <= set->length + 1;
        loop assigns i, sums, tap[0 .. set->length - 1];
        loop variant set->length + 1 - i; */
    for (size_t i = 1U; i <= set->length; i += 1U) {
        float share = set->alpha / (float)i;
        float weight = share * sums.at_dc; /* |c_i| */
        tap[set->length - i] = weight;
        sums.at_dc = sums.at_dc * (1.0F - share);
        sums.at_nyquist = i % 2U == 1U ? sums.at_nyquist + weight : sums.at_nyquist - weight;
        sums.moment = sums.moment + (float)i * weight;
    }
    return sums;
}

float hb_series(float K1_N_per_mm, float pot_N_per_mm)
{
    return K1_N_per_mm * pot_N_per_mm / (K1_N_per_mm + pot_N_per_mm);
}

float hb_static_stiffness(const struct hb_parameters *set, float beta_N_per_mm, struct hb_sums sums)
{
    return set->K0_N_per_mm + hb_series(set->K1_N_per_mm, beta_N_per_mm * sums.at_dc);
}

bool hb_static_stiffness_is_passive(const struct hb_parameters *set, float beta_N_per_mm, struct hb_sums sums)
{
    float share = hb_series(set->K1_N_per_mm, beta_N_per_mm * sums.at_dc);
    return hb_static_stiffness(set, beta_N_per_mm, sums) >= -ROUNDING * share;
}

float hb_minimum_damping(const struct hb_parameters *set, float beta_N_per_mm, struct hb_sums sums)
{
    float stiffness = set->K0_N_per_mm + hb_series(set->K1_N_per_mm, beta_N_per_mm * sums.at_nyquist);
    return 500.0F * stiffness / (float)set->tick_rate_Hz;
}
