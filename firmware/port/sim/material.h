/* A viscoelastic material that the device presses by itself: the sampled FO-SLS, resisting for x > 0.
 *
 * At the ticks n it is exactly the model that `hilbo identify` fits (docs/methods/mechanics.md), in double precision:
 *     y_n = g x_n + sum w_i y_{n-i},  F_n = K0 x_n + K1 (x_n - y_n),  x = max(position, 0),  F = max(F, 0).
 * Between two ticks the past stays, so that the force follows the position with the instantaneous stiffness. */
#ifndef SIM_MATERIAL_H
#define SIM_MATERIAL_H

#include <stdbool.h>

enum { SIM_MATERIAL_MOST_TAPS = 2001 };

struct sim_material_config {
    double K0_N_per_mm;
    double K1_N_per_mm;
    double B1_N_s_alpha_per_mm;
    double alpha;
    int taps;
};

struct sim_material {
    struct sim_material_config config;
    double gain;                                /* g */
    double past_mm;                             /* sum w_i y_{n-i} for the tick to come */
    double weights[SIM_MATERIAL_MOST_TAPS];     /* w_1 ... */
    double elongation_mm[SIM_MATERIAL_MOST_TAPS]; /* y, a ring */
    int newest;
};

/* True where the parameters make sense: K1, B1 > 0, 0 < alpha < 1, 1 <= taps <= most. */
bool sim_material_valid(const struct sim_material_config *config);

void sim_material_start(struct sim_material *material, const struct sim_material_config *config, double tick_s);

/* Force against the position, N. */
double sim_material_force_N(const struct sim_material *material, double position_mm);

/* A tick is over at this position. */
void sim_material_tick(struct sim_material *material, double position_mm);

#endif
