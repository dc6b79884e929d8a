#include "material.h"

#include <math.h>

bool sim_material_valid(const struct sim_material_config *config)
{
    return isfinite(config->K0_N_per_mm) && config->K1_N_per_mm > 0.0 && isfinite(config->K1_N_per_mm) &&
           config->B1_N_s_alpha_per_mm > 0.0 && isfinite(config->B1_N_s_alpha_per_mm) && config->alpha > 0.0 &&
           config->alpha < 1.0 && config->taps >= 1 && config->taps <= SIM_MATERIAL_MOST_TAPS;
}

void sim_material_start(struct sim_material *material, const struct sim_material_config *config, double tick_s)
{
    *material = (struct sim_material){.config = *config};
    const double beta = config->B1_N_s_alpha_per_mm * pow(tick_s, -config->alpha);
    const double share = beta / (config->K1_N_per_mm + beta);
    material->gain = config->K1_N_per_mm / (config->K1_N_per_mm + beta);
    double partial_sum = 1.0; /* S_{i-1}; |c_i| = alpha / i S_{i-1} */
    for (int i = 1; i <= config->taps; i++) {
        const double part = config->alpha / (double)i;
        material->weights[i - 1] = share * part * partial_sum;
        partial_sum *= 1.0 - part;
    }
}

static double touched(double position_mm)
{
    return position_mm > 0.0 ? position_mm : 0.0;
}

double sim_material_force_N(const struct sim_material *material, double position_mm)
{
    const double x = touched(position_mm);
    const double y = material->gain * x + material->past_mm;
    const double force_N = material->config.K0_N_per_mm * x + material->config.K1_N_per_mm * (x - y);
    return force_N > 0.0 ? force_N : 0.0;
}

/* Where the surface is when nothing presses on it: it comes back by itself, more slowly than a handle can leave it. */
static double surface_mm(const struct sim_material *material)
{
    const struct sim_material_config *config = &material->config;
    const double stiffness = config->K0_N_per_mm + config->K1_N_per_mm * (1.0 - material->gain);
    return stiffness > 0.0 ? fmax(config->K1_N_per_mm * material->past_mm / stiffness, 0.0) : 0.0;
}

void sim_material_tick(struct sim_material *material, double position_mm)
{
    const int taps = material->config.taps;
    const double pressed_mm = fmax(position_mm, surface_mm(material));
    material->newest = (material->newest + 1) % taps;
    material->elongation_mm[material->newest] = material->gain * touched(pressed_mm) + material->past_mm;
    double past_mm = 0.0;
    for (int i = 0, place = material->newest; i < taps; i++, place = (place > 0 ? place : taps) - 1) {
        past_mm += material->weights[i] * material->elongation_mm[place];
    }
    material->past_mm = past_mm;
}
