/* Closed forms of the sampled model: what the sums of the Grünwald-Letnikov coefficients say about passivity.
 *
 *     S = C(1), C(-1), M1 = -sum i c_i;   H(1) = K0 + series(K1, beta S),   b_min = T/2 (K0 + series(K1, beta C(-1)))
 *
 * with series(p, q) = p q/(p + q). docs/methods/mechanics.md says what of this is proved, and why N must be odd. */
#ifndef HB_PASSIVITY_H
#define HB_PASSIVITY_H

#include <stdbool.h>

#include "hb_renderer.h"

#ifdef __cplusplus
extern "C" {
#endif

struct hb_sums {
    float at_dc;      /* C(1) */
    float at_nyquist; /* C(-1) */
    float moment;     /* M1 in ticks; of full memory 0 here, because it depends on the exponentials */
};

/* Of a set's memory: for short memory with N >= 1 taps, |c_N| ... |c_1| go to `tap` (room for N). */
/*@ requires \valid_read(set) && (set->memory != 1 ==> \valid(tap + (0 .. set->length - 1)));
    requires \separated(set, tap + (0 .. set->length - 1));
    assigns tap[0 .. set->length - 1]; */
struct hb_sums hb_memory_sums(const struct hb_parameters *set, float *tap);

/* K1 and a pot in series. */
/*@ assigns \nothing; */
float hb_series(float K1_N_per_mm, float pot_N_per_mm);

/* H(1), N/mm. */
/*@ requires \valid_read(set);
    assigns \nothing; */
float hb_static_stiffness(const struct hb_parameters *set, float beta_N_per_mm, struct hb_sums sums);

/* The static stiffness is not negative. In float32 H(1) may be off by 2^-16 of K1's share, and a set that was meant to
 * have H(1) = 0 passes. */
/*@ requires \valid_read(set);
    assigns \nothing; */
bool hb_static_stiffness_is_passive(const struct hb_parameters *set, float beta_N_per_mm, struct hb_sums sums);

/* Smallest device damping (N s/m) with which the rendering is passive. */
/*@ requires \valid_read(set);
    assigns \nothing; */
float hb_minimum_damping(const struct hb_parameters *set, float beta_N_per_mm, struct hb_sums sums);

#ifdef __cplusplus
}
#endif

#endif
