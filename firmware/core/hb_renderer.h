/* The viscoelastic model, one tick at a time: one parameter set with its own history.
 *
 *     k = K1 beta/(K1 + beta), g = K1/(K1 + beta), beta = B1 T^-alpha
 *     F = K0 x + k (x - s),   y = s + g (x - s),   s = what the past of y contributes:
 *     short memory: sum over N past samples |c_i| y_{n-i}, oldest first;   full memory: sum of p_k m_k, fading means
 *
 * s is computed as the last y and what it lies behind, sum |c_i| (y_{n-i} - y_{n-1}) - S y_{n-1}: taps that should add
 * up to 1 - S, and do not by a rounding, would be a spring of their own where beta is large. For the same reason what
 * an addition to y loses is kept. A minute of holding still is then as good as a minute of motion.
 *
 * float32 in a fixed order: the same bits on every machine with IEEE arithmetic. */
#ifndef HB_RENDERER_H
#define HB_RENDERER_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "hb_config.h"

#ifdef __cplusplus
extern "C" {
#endif

/* What SET_PARAMS says. */
struct hb_parameters {
    uint16_t set_id;
    uint8_t memory;  /* enum hb_memory */
    uint16_t length; /* N, or number of exponentials */
    uint16_t tick_rate_Hz;
    float K0_N_per_mm;
    float K1_N_per_mm;
    float B1_N_s_alpha_per_mm;
    float alpha;
    float force_limit_N;
};

/* One bank. All zero is an empty one. */
struct hb_renderer {
    struct hb_parameters set;
    float beta_N_per_mm;
    float gain;                         /* g */
    float stiffness_N_per_mm;           /* k */
    float rest_share;                   /* y of the equilibrium at 1 mm */
    float static_stiffness_N_per_mm;    /* H(1) */
    bool static_is_passive;             /* it is not negative, to rounding */
    float minimum_damping_N_s_per_m;    /* with which the rendering is passive */
    uint32_t warm_ticks;                /* until a history that starts at an equilibrium is its own */
    float forgotten;                    /* S, what the taps lack to a sum of 1 */
    float y_mm;                         /* the last y, */
    float y_rest_mm;                    /* and what its last addition lost to rounding */
    float tap[HB_MAX_TAPS];             /* short: |c_N| ... |c_1| */
    float history_mm[2U * HB_MAX_TAPS]; /* short: every y twice, N apart, so that the last N always lie in a row */
    size_t oldest;                      /* short: where that row begins */
    size_t quiet;                       /* short: how many y in a row have been 0, up to N */
    float weight[HB_MAX_STATES];        /* full: p_k */
    float loss[HB_MAX_STATES];          /* full: 1 - lambda_k */
    float mean_mm[HB_MAX_STATES];       /* full: m_k, */
    float rest_mm[HB_MAX_STATES];       /* full: and what theirs lost */
};

/* What each set that is staged or in force keeps true; memory 1 is HB_FULL. */
/*@ predicate hb_set_fits(struct hb_parameters *s) = s->length <= (s->memory == 1 ? HB_MAX_STATES : HB_MAX_TAPS);
    predicate hb_renderer_is_sound(struct hb_renderer *r) =
      hb_set_fits(&r->set) && (r->oldest < r->set.length || r->oldest == 0) && r->quiet <= r->set.length; */

/* Everything that the parameters decide, for a set within its limits; full memory still lacks its exponentials. The
 * history is left undefined: hb_renderer_rest comes next. */
/*@ requires \valid(renderer) && \valid_read(set) && \separated(renderer, set) && hb_set_fits(set);
    assigns *renderer;
    ensures hb_set_fits(&renderer->set);
    ensures renderer->set.memory == set->memory && renderer->set.length == set->length;
    ensures renderer->static_is_passive == 0 || renderer->static_is_passive == 1; */
void hb_renderer_prepare(struct hb_renderer *renderer, const struct hb_parameters *set);

/* One exponential of full memory, index < length, fastest first. */
/*@ requires \valid(renderer);
    assigns renderer->weight[0 .. HB_MAX_STATES - 1], renderer->loss[0 .. HB_MAX_STATES - 1]; */
void hb_renderer_set_state(struct hb_renderer *renderer, size_t index, float weight, float loss);

/* The exponentials are positive, in order, and their sums are those of alpha. To be asked when all have been set; also
 * brings `warm_ticks` up to date. */
/*@ requires \valid(renderer) && renderer->set.length <= HB_MAX_STATES;
    assigns renderer->warm_ticks; */
bool hb_renderer_accept_states(struct hb_renderer *renderer);

/* The history of having been held at x for ever. */
/*@ requires \valid(renderer) && hb_set_fits(&renderer->set);
    assigns renderer->y_mm, renderer->y_rest_mm, renderer->history_mm[0 .. 2 * HB_MAX_TAPS - 1], renderer->oldest,
      renderer->quiet, renderer->mean_mm[0 .. HB_MAX_STATES - 1], renderer->rest_mm[0 .. HB_MAX_STATES - 1];
    ensures hb_renderer_is_sound(renderer); */
void hb_renderer_rest(struct hb_renderer *renderer, float x_mm);

/* One tick at x >= 0: the model's force, of either sign. */
/*@ requires \valid(renderer) && hb_renderer_is_sound(renderer);
    assigns renderer->y_mm, renderer->y_rest_mm, renderer->history_mm[0 .. 2 * HB_MAX_TAPS - 1], renderer->oldest,
      renderer->quiet, renderer->mean_mm[0 .. HB_MAX_STATES - 1], renderer->rest_mm[0 .. HB_MAX_STATES - 1];
    ensures hb_renderer_is_sound(renderer); */
float hb_renderer_step(struct hb_renderer *renderer, float x_mm);

#ifdef __cplusplus
}
#endif

#endif
