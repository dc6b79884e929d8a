/* The device's core with a simulated world in place of its hardware: what every simulated port runs. */
#ifndef SIM_RIG_H
#define SIM_RIG_H

#include <stdbool.h>
#include <stdint.h>

#include "hb_device.h"
#include "world.h"

struct sim_rig_config {
    struct sim_world_config world;
    uint32_t line_rate_baud;
    bool has_sensor;
    bool is_homed;         /* at boot, as by an absolute encoder */
    uint32_t delay_us;     /* of the force, a multiple of a substep of the world */
    bool inverted;         /* the motor is wired the other way: a positive command pushes the handle in */
    bool encoder_inverted; /* the encoder counts the other way: down into the material */
};

struct sim_rig {
    struct hb_config config; /* the device keeps a pointer to it: a rig stays where it was started */
    struct hb_device device;
    struct sim_world world;
    uint32_t bad_ticks;  /* so many positions to come are no numbers */
    uint32_t late_ticks; /* so many ticks to come are reported as overruns */
    uint32_t late_us;    /* by how much more than the delay the next force comes late */
    bool stop_open;      /* the hardware stop: no force reaches the handle */
    uint32_t delay_us;   /* of the last force */
    double motor_N;      /* on the handle, positive inwards, of the last tick, until its successor comes */
    double motor_sign;   /* of the force on the handle for a positive command */
    int32_t encoder_sign;
};

struct sim_rig_config sim_rig_defaults(void);

/* What the device says of itself in this world. */
struct hb_config sim_rig_describe(const struct sim_rig_config *config);

/* Starts world and device. On an error the rig must not be used. */
enum hb_error sim_rig_start(struct sim_rig *rig, const struct sim_rig_config *config, uint32_t boot_id);

/* Starts the device again, as after a loss of power. The world goes on, without force. */
enum hb_error sim_rig_restart(struct sim_rig *rig, uint32_t boot_id);

/* One tick: encoder and sensor are read, the device decides, the world moves. Returns the device's force. */
float sim_rig_tick(struct sim_rig *rig);

#endif
