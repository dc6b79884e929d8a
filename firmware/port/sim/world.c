#include "world.h"

#include <math.h>

struct sim_world_config sim_world_defaults(void)
{
    return (struct sim_world_config){
        .seed = 0,
        .tick_s = 1e-3,
        .substeps = 20,
        .mass_kg = 0.3,
        .damping_N_s_per_m = 0.95,
        .coulomb_N = 0.02,
        .low_mm = -5.0,
        .high_mm = 20.0,
        .encoder_step_mm = 0.0127,
        .start_mm = -1.0,
        .sensor_noise_N = 0.0,
        .finger = sim_finger_defaults(),
        .has_material = false,
    };
}

void sim_world_start(struct sim_world *world, const struct sim_world_config *config)
{
    *world = (struct sim_world){
        .config = *config,
        .random = {config->seed},
        .position_mm = config->start_mm,
    };
    const struct sim_random own = {sim_random_bits(&world->random)};
    sim_finger_start(&world->finger, &config->finger, own);
    if (config->has_material) {
        sim_material_start(&world->material, &config->material, config->tick_s);
    }
}

void sim_world_press(struct sim_world *world, enum sim_press press)
{
    struct sim_finger *finger = &world->finger;
    world->config.finger.press = press;
    sim_finger_start(finger, &world->config.finger, finger->random);
    finger->segment.to_mm = world->position_mm;
}

static bool has_finger(const struct sim_world *world)
{
    return world->config.finger.press != SIM_PRESS_NONE;
}

/* Velocity after a step in which friction can stop it but not turn it round. */
static double rubbed(double velocity_mm_per_s, double loss_mm_per_s)
{
    const double speed = fabs(velocity_mm_per_s) - loss_mm_per_s;
    return speed > 0.0 ? copysign(speed, velocity_mm_per_s) : 0.0;
}

static void substep(struct sim_world *world, double motor_N, double step_s)
{
    const struct sim_world_config *config = &world->config;
    double force_N = motor_N;
    double damping = config->damping_N_s_per_m;
    double mass_kg = config->mass_kg;
    world->contact_N = 0.0;
    if (has_finger(world)) {
        const struct sim_hand hand = sim_finger_follow(&world->finger, step_s);
        const double spring_N = config->finger.stiffness_N_per_mm * (hand.position_mm - world->position_mm);
        const double damper = config->finger.damping_N_s_per_m;
        world->contact_N = spring_N + 1e-3 * damper * (hand.velocity_mm_per_s - world->velocity_mm_per_s);
        force_N += spring_N + 1e-3 * damper * hand.velocity_mm_per_s;
        damping += damper;
        mass_kg += config->finger.mass_kg;
    }
    if (config->has_material) {
        const double resists_N = sim_material_force_N(&world->material, world->position_mm);
        world->contact_N -= resists_N;
        force_N -= resists_N;
    }
    const double kick = step_s / mass_kg; /* s/kg; m/s for a N */
    const double pushed = world->velocity_mm_per_s + 1e3 * kick * force_N;
    world->velocity_mm_per_s = rubbed(pushed, 1e3 * kick * config->coulomb_N) / (1.0 + kick * damping);
    world->position_mm += step_s * world->velocity_mm_per_s;
    const double stopped = fmin(fmax(world->position_mm, config->low_mm), config->high_mm);
    if (stopped != world->position_mm) {
        world->position_mm = stopped;
        world->velocity_mm_per_s = 0.0;
    }
}

void sim_world_tick(struct sim_world *world, double motor_N)
{
    sim_world_tick_late(world, motor_N, motor_N, 0.0);
}

void sim_world_tick_late(struct sim_world *world, double old_N, double motor_N, double share)
{
    const double step_s = world->config.tick_s / (double)world->config.substeps;
    const long late = lround(share * (double)world->config.substeps);
    for (int i = 0; i < world->config.substeps; i++) {
        substep(world, i < late ? old_N : motor_N, step_s);
    }
    if (world->config.has_material) {
        /* The reading belongs to the tick's own sample, so before the past moves on. */
        world->contact_N = -sim_material_force_N(&world->material, world->position_mm);
        sim_material_tick(&world->material, world->position_mm);
    }
}

int32_t sim_world_counts(const struct sim_world *world)
{
    return (int32_t)lround(world->position_mm / world->config.encoder_step_mm);
}

double sim_world_sensed_N(struct sim_world *world)
{
    const double noise_N = world->config.sensor_noise_N;
    return world->contact_N + (noise_N > 0.0 ? noise_N * sim_random_normal(&world->random) : 0.0);
}
