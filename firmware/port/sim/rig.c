#include "rig.h"

#include <math.h>

#ifndef HB_FIRMWARE_HASH
#define HB_FIRMWARE_HASH 0 /* the build sets it: CRC-32 of the core's sources */
#endif

struct sim_rig_config sim_rig_defaults(void)
{
    return (struct sim_rig_config){
        .world = sim_world_defaults(),
        .line_rate_baud = 921600,
        .has_sensor = true,
        .is_homed = true,
        .delay_us = 0,
        .inverted = false,
        .encoder_inverted = false,
    };
}

/* The device as its maker would describe it. The servo has the stiffness of a firm hand, critical damping at 0.3 kg
 * being 0.05 N.s/mm; less than that, since one encoder count a tick is a velocity of 12.7 mm/s. */
struct hb_config sim_rig_describe(const struct sim_rig_config *config)
{
    const struct sim_world_config *world = &config->world;
    const int capabilities = HB_CAN_DRIVE | HB_IS_SIMULATED | (config->has_sensor ? HB_CAN_SENSE_FORCE : 0) |
                             (config->is_homed ? HB_IS_HOMED_AT_BOOT : 0);
    return (struct hb_config){
        .firmware = HB_FIRMWARE_HASH,
        .line_rate_baud = config->line_rate_baud,
        .tick_rate_Hz = (uint16_t)lround(1.0 / world->tick_s),
        .watchdog_ticks = 250,
        .hold_ticks = 20,
        .most_taps = HB_MAX_TAPS,
        .most_states = HB_MAX_STATES,
        .capabilities = (uint8_t)capabilities,
        .delay_us = config->delay_us,
        .damping_N_s_per_m = (float)world->damping_N_s_per_m,
        .force_limit_N = 20.0F,
        .continuous_force_N = 20.0F,
        .heating_s = 10.0F,
        .position_low_mm = (float)(world->low_mm - 0.1), /* the encoder may round a stop outwards */
        .position_high_mm = (float)(world->high_mm + 0.1),
        .encoder_step_mm = (float)world->encoder_step_mm,
        .slew_limit_N_per_s = 500.0F,
        .velocity_limit_mm_per_s = 1000.0F,
        .plausible_step_mm = 2.0F,
        .K0_N_per_mm = {-64.0F, 64.0F},
        .K1_N_per_mm = {1e-3F, 64.0F},
        .B1_N_s_alpha_per_mm = {1e-4F, 64.0F},
        .alpha = {0.005F, 0.995F},
        .servo_stiffness_N_per_mm = 2.0F,
        .servo_damping_N_s_per_mm = 0.03F,
        .servo_integral_N_per_mm_s = 20.0F,
        .servo_speed_mm_per_s = 100.0F,
    };
}

enum hb_error sim_rig_start(struct sim_rig *rig, const struct sim_rig_config *config, uint32_t boot_id)
{
    rig->config = sim_rig_describe(config);
    rig->bad_ticks = rig->late_ticks = rig->late_us = 0;
    rig->stop_open = false;
    rig->delay_us = 0;
    rig->motor_N = 0.0;
    rig->motor_sign = config->inverted ? 1.0 : -1.0;
    rig->encoder_sign = config->encoder_inverted ? -1 : 1;
    sim_world_start(&rig->world, &config->world);
    return sim_rig_restart(rig, boot_id);
}

enum hb_error sim_rig_restart(struct sim_rig *rig, uint32_t boot_id)
{
    return hb_init(&rig->device, &rig->config, boot_id);
}

static bool counted_down(uint32_t *left)
{
    const bool any = *left > 0;
    *left -= any ? 1U : 0U;
    return any;
}

/* The old force acts until the new one is out; an open stop lets neither through. */
static void move_world(struct sim_rig *rig, double force_N, uint32_t delay_us)
{
    const double period_us = 1e6 * rig->world.config.tick_s;
    const double share = (double)delay_us < period_us ? (double)delay_us / period_us : 1.0;
    const double before_N = rig->motor_N;
    rig->motor_N = rig->motor_sign * force_N;
    const bool open = rig->stop_open;
    sim_world_tick_late(&rig->world, open ? 0.0 : before_N, open ? 0.0 : rig->motor_N, share);
}

float sim_rig_tick(struct sim_rig *rig)
{
    const uint32_t delay_us = rig->config.delay_us + rig->late_us;
    rig->late_us = 0;
    const struct hb_input input = {
        .position_counts = rig->encoder_sign * sim_world_counts(&rig->world),
        .position_valid = !counted_down(&rig->bad_ticks),
        .overrun = counted_down(&rig->late_ticks),
        .stop_open = rig->stop_open,
        .delay_us = rig->delay_us,
        .sensed_N = (rig->config.capabilities & HB_CAN_SENSE_FORCE) != 0 ? (float)sim_world_sensed_N(&rig->world) : NAN,
    };
    const float force_N = hb_tick(&rig->device, &input);
    move_world(rig, (double)force_N, delay_us);
    rig->delay_us = delay_us;
    return force_N;
}
