/* The core as a shared library for tests: flat arguments, loops that would be slow in Python, a view of the state. */
#include "shim.h"

#include <math.h>

#include "hb_math.h"
#include "hb_passivity.h"
#include "hb_renderer.h"

struct shim {
    struct hb_config config;
    struct hb_device device;
};

size_t shim_size(void)
{
    return sizeof(struct shim);
}

size_t shim_device_size(void)
{
    return sizeof(struct hb_device);
}

int shim_init(struct shim *shim, const double *n, uint32_t boot_id)
{
    struct hb_config *c = &shim->config;
    c->firmware = (uint32_t)n[0];
    c->line_rate_baud = (uint32_t)n[1];
    c->tick_rate_Hz = (uint16_t)n[2];
    c->watchdog_ticks = (uint16_t)n[3];
    c->hold_ticks = (uint16_t)n[4];
    c->most_taps = (uint16_t)n[5];
    c->most_states = (uint8_t)n[6];
    c->capabilities = (uint8_t)n[7];
    c->damping_N_s_per_m = (float)n[8];
    c->force_limit_N = (float)n[9];
    c->position_low_mm = (float)n[10];
    c->position_high_mm = (float)n[11];
    c->encoder_step_mm = (float)n[12];
    c->slew_limit_N_per_s = (float)n[13];
    c->velocity_limit_mm_per_s = (float)n[14];
    c->plausible_step_mm = (float)n[15];
    c->K0_N_per_mm = (struct hb_range){(float)n[16], (float)n[17]};
    c->K1_N_per_mm = (struct hb_range){(float)n[18], (float)n[19]};
    c->B1_N_s_alpha_per_mm = (struct hb_range){(float)n[20], (float)n[21]};
    c->alpha = (struct hb_range){(float)n[22], (float)n[23]};
    c->servo_stiffness_N_per_mm = (float)n[24];
    c->servo_damping_N_s_per_mm = (float)n[25];
    c->servo_integral_N_per_mm_s = (float)n[26];
    c->servo_speed_mm_per_s = (float)n[27];
    c->delay_us = (uint32_t)n[28];
    c->continuous_force_N = (float)n[29];
    c->heating_s = (float)n[30];
    return (int)hb_init(&shim->device, c, boot_id);
}

const char *shim_sentence(int error)
{
    return hb_error_sentence((enum hb_error)error);
}

void shim_receive(struct shim *shim, const uint8_t *bytes, size_t size)
{
    size_t taken = 0U;
    while (taken < size) {
        taken += hb_receive(&shim->device, bytes + taken, size - taken);
    }
}

size_t shim_receive_once(struct shim *shim, const uint8_t *bytes, size_t size)
{
    return hb_receive(&shim->device, bytes, size);
}

size_t shim_transmit(struct shim *shim, uint8_t *bytes, size_t room)
{
    return hb_transmit(&shim->device, bytes, room);
}

static struct hb_parameters parameters(const double *n)
{
    return (struct hb_parameters){
        .set_id = 1U,
        .memory = (uint8_t)n[0],
        .length = (uint16_t)n[1],
        .tick_rate_Hz = (uint16_t)n[2],
        .K0_N_per_mm = (float)n[3],
        .K1_N_per_mm = (float)n[4],
        .B1_N_s_alpha_per_mm = (float)n[5],
        .alpha = (float)n[6],
        .force_limit_N = 1000.0F,
    };
}

float shim_tick(struct shim *shim, int32_t counts, int valid, int overrun, float sensed_N)
{
    struct hb_input input = {counts, valid != 0, overrun != 0, false, shim->config.delay_us, sensed_N};
    return hb_tick(&shim->device, &input);
}

/* A tick on a good position whose predecessor's force was out after so long, with the hardware stop open or closed. */
float shim_tick_of_board(struct shim *shim, int32_t counts, uint32_t delay_us, int stop_open)
{
    struct hb_input input = {counts, true, false, stop_open != 0, delay_us, 0.0F};
    return hb_tick(&shim->device, &input);
}

/* The damping that a set needs at a delay, as the device finds it angle by angle. */
double shim_delayed_damping(const double *set, const float *weight, const float *loss, uint32_t delay_us)
{
    static struct hb_renderer renderer;
    struct hb_parameters given = parameters(set);
    struct hb_config config = {.tick_rate_Hz = given.tick_rate_Hz, .delay_us = delay_us, .damping_N_s_per_m = 1.0F};
    struct hb_delay_check check;
    hb_renderer_prepare(&renderer, &given);
    for (size_t k = 0U; given.memory == (uint8_t)HB_FULL && k < given.length; k += 1U) {
        hb_renderer_set_state(&renderer, k, weight[k], loss[k]);
    }
    hb_delay_begin(&check, &config);
    while (hb_delay_ticks_left(&check) > 0U) {
        hb_delay_step(&check, &renderer, &config);
    }
    (void)hb_delay_is_passive(&check, &renderer, &config);
    return (double)renderer.minimum_damping_N_s_per_m;
}

uint32_t shim_flags(const struct shim *shim)
{
    return shim->device.safety.flags;
}

double shim_offset_N(const struct shim *shim)
{
    return (double)shim->device.offset_N;
}

/* What a host knows that has heard everything. */
uint32_t shim_stops(const struct shim *shim)
{
    return shim->device.stops;
}

int shim_state(const struct shim *shim)
{
    return shim->device.state;
}

uint32_t shim_now(const struct shim *shim)
{
    return shim->device.tick;
}

uint32_t shim_warm_left(const struct shim *shim)
{
    return shim->device.warm_left;
}

/* `beating`: as if a heartbeat came before every tick. */
void shim_run(struct shim *shim, const int32_t *counts, size_t size, int beating, float *forces, uint16_t *flags)
{
    for (size_t i = 0U; i < size; i += 1U) {
        if (beating != 0) {
            shim->device.heartbeat_age_ticks = 0U;
        }
        forces[i] = shim_tick(shim, counts[i], 1, 0, 0.0F);
        flags[i] = shim->device.safety.flags;
    }
}

/* The renderer alone: forces (either sign) at positions x >= 0, from rest. 0 where the exponentials are refused. */
int shim_render(const double *set, const float *weight, const float *loss, const float *x_mm, size_t size,
                float *forces)
{
    static struct hb_renderer renderer;
    struct hb_parameters given = parameters(set);
    hb_renderer_prepare(&renderer, &given);
    for (size_t k = 0U; given.memory == (uint8_t)HB_FULL && k < given.length; k += 1U) {
        hb_renderer_set_state(&renderer, k, weight[k], loss[k]);
    }
    if (given.memory == (uint8_t)HB_FULL && !hb_renderer_accept_states(&renderer)) {
        return 0;
    }
    hb_renderer_rest(&renderer, 0.0F);
    for (size_t i = 0U; i < size; i += 1U) {
        forces[i] = hb_renderer_step(&renderer, x_mm[i]);
    }
    return 1;
}

/* What the device finds of a set: b_min, H(1), warm-up, beta. */
void shim_closed_forms(const double *set, double *found)
{
    static struct hb_renderer renderer;
    struct hb_parameters given = parameters(set);
    hb_renderer_prepare(&renderer, &given);
    found[0] = (double)renderer.minimum_damping_N_s_per_m;
    found[1] = (double)renderer.static_stiffness_N_per_mm;
    found[2] = (double)renderer.warm_ticks;
    found[3] = (double)renderer.beta_N_per_mm;
    found[4] = renderer.static_is_passive ? 1.0 : 0.0;
}

float shim_power(uint32_t base, float exponent)
{
    return hb_power(base, exponent);
}

/* Largest error of hb_power, in units of the last place of the result, over every `stride`-th float in [low, high]. */
double shim_power_error(uint32_t base, float low, float high, uint32_t stride)
{
    double worst = 0.0;
    uint32_t last = hb_bits_of_float(high);
    for (uint32_t bits = hb_bits_of_float(low); bits <= last; bits += stride) {
        float exponent = hb_float_of_bits(bits);
        double exact = pow((double)base, (double)exponent);
        int power = 0;
        (void)frexp(exact, &power);
        double error = fabs((double)hb_power(base, exponent) - exact) / ldexp(1.0, power - 24);
        worst = error > worst ? error : worst;
    }
    return worst;
}
