/* What a simulated device moves and feels: an actuator with mass, damping and Coulomb friction, an encoder, a force
 * sensor, and what touches the handle (nothing, a finger, or a material).
 *
 *     m dv/dt = F_motor + F_hand - F_material - b v - F_C sign(v),  between two mechanical stops
 *
 * The motor's force is held over a tick, which is divided into `substeps`. Damping and friction are taken implicitly
 * (sticking is exact), springs explicitly. Deterministic: one seed, one world. Units: mm, s, N, kg, damping N.s/m.
 * Positions and forces are positive inwards: towards where a finger presses and where the material is. */
#ifndef SIM_WORLD_H
#define SIM_WORLD_H

#include <stdbool.h>
#include <stdint.h>

#include "finger.h"
#include "material.h"
#include "random.h"

struct sim_world_config {
    uint64_t seed;
    double tick_s;
    int substeps;
    double mass_kg;
    double damping_N_s_per_m;
    double coulomb_N;
    double low_mm; /* mechanical stops */
    double high_mm;
    double encoder_step_mm;
    double start_mm;
    double sensor_noise_N; /* standard deviation; 0: none */
    struct sim_finger_config finger;
    bool has_material;
    struct sim_material_config material;
};

struct sim_world {
    struct sim_world_config config;
    struct sim_random random;
    struct sim_finger finger;
    struct sim_material material;
    double position_mm;
    double velocity_mm_per_s;
    double contact_N; /* what touches the handle pushes it inwards by this */
};

struct sim_world_config sim_world_defaults(void);

void sim_world_start(struct sim_world *world, const struct sim_world_config *config);

/* Another finger, which takes hold of the handle where it is. */
void sim_world_press(struct sim_world *world, enum sim_press press);

/* One tick with the motor's force held. */
void sim_world_tick(struct sim_world *world, double motor_N);

/* One tick in which the motor's old force is held for a share of the period, to the nearest substep, and then the new. */
void sim_world_tick_late(struct sim_world *world, double old_N, double motor_N, double share);

/* What the encoder counts now. */
int32_t sim_world_counts(const struct sim_world *world);

/* What the force sensor says now; draws its noise. */
double sim_world_sensed_N(struct sim_world *world);

#endif
