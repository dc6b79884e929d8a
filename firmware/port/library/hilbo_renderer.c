#include "hilbo_renderer.h"

#include <math.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

#include "hb_device.h"
#include "hb_motion.h"
#include "hb_staging.h"
#include "lock.h"
#include "orders.h"
#include "schedule.h"

#ifndef HB_FIRMWARE_HASH
#define HB_FIRMWARE_HASH 0 /* the build sets it: CRC-32 of the core's sources */
#endif

_Static_assert((int)HILBO_MOST_EXPONENTIALS == (int)HB_MAX_STATES, "the header names the core's maximum");

struct hilbo_renderer {
    struct hb_config config;
    struct hb_device device; /* touched under the lock only, like all that follows */
    struct orders orders;
    struct schedule schedule;
    uint32_t latency_us;
    enum hilbo_fate fate;
    bool clock_failed; /* why it is in ESTOP */
    uint32_t missed;
    uint32_t early;
    uint32_t late_us;
    uint32_t latest_us;
    struct lock lock;
    atomic_bool estop; /* asked for, and not yet carried out; the one thing that is set without the lock */
};

static struct hb_range range_of(struct hilbo_range range)
{
    return (struct hb_range){(float)range.low, (float)range.high};
}

static uint16_t in_16_bits(uint32_t value)
{
    return (uint16_t)(value < UINT16_MAX ? value : UINT16_MAX); /* which is refused */
}

/* Positions count from the surface: a program calibrates its device before it hands them over, so that there is no HOME.
 * There is no line either. */
static struct hb_config config_of(const struct hilbo_device_numbers *numbers)
{
    const int capabilities = HB_IS_HOMED_AT_BOOT | (numbers->simulated != 0U ? HB_IS_SIMULATED : 0) |
                             (numbers->passivity_controller != 0U ? HB_CAN_CONTROL_PASSIVITY : 0);
    return (struct hb_config){
        .firmware = HB_FIRMWARE_HASH,
        .line_rate_baud = 1000000,
        .tick_rate_Hz = in_16_bits(numbers->tick_rate_Hz),
        .watchdog_ticks = in_16_bits(numbers->watchdog_ticks),
        .hold_ticks = in_16_bits(numbers->hold_ticks),
        .most_taps = HB_MAX_TAPS,
        .most_states = HB_MAX_STATES,
        .capabilities = (uint8_t)capabilities,
        .delay_us = numbers->delay_us,
        .damping_N_s_per_m = (float)numbers->damping_N_s_per_m,
        .force_limit_N = (float)numbers->force_limit_N,
        .continuous_force_N = (float)numbers->continuous_force_N,
        .heating_s = (float)numbers->heating_s,
        .position_low_mm = (float)numbers->position_low_mm,
        .position_high_mm = (float)numbers->position_high_mm,
        .encoder_step_mm = (float)numbers->position_step_mm,
        .slew_limit_N_per_s = (float)numbers->slew_limit_N_per_s,
        .velocity_limit_mm_per_s = (float)numbers->velocity_limit_mm_per_s,
        .plausible_step_mm = (float)numbers->plausible_step_mm,
        .K0_N_per_mm = range_of(numbers->K0_N_per_mm),
        .K1_N_per_mm = range_of(numbers->K1_N_per_mm),
        .B1_N_s_alpha_per_mm = range_of(numbers->B1_N_s_alpha_per_mm),
        .alpha = range_of(numbers->alpha),
    };
}

static const char *start(struct hilbo_renderer *renderer, const struct hilbo_device_numbers *numbers)
{
    renderer->config = config_of(numbers);
    renderer->latency_us = numbers->latency_us;
    renderer->orders.device = &renderer->device;
    atomic_init(&renderer->estop, false);
    const enum hb_error error = hb_init(&renderer->device, &renderer->config, 1U);
    if (error != HB_OK) {
        return hb_error_sentence(error);
    }
    if (numbers->latency_us > numbers->delay_us) {
        return "delay_us must be at least latency_us: it has the lateness that is tolerated on top.";
    }
    renderer->schedule.period_s = 1.0 / (double)numbers->tick_rate_Hz;
    (void)orders_hello(&renderer->orders);
    return lock_make(&renderer->lock) ? NULL : "The system gives no lock.";
}

struct hilbo_renderer *hilbo_open(const struct hilbo_device_numbers *numbers, const char **why)
{
    struct hilbo_renderer *renderer = NULL;
    const char *wrong = "The program and the library are of different versions of hilbo_renderer.h; build both anew.";
    if (numbers->size == sizeof *numbers) {
        renderer = calloc(1, sizeof *renderer);
        wrong = renderer == NULL ? "There is no memory left." : start(renderer, numbers);
    }
    if (why != NULL) {
        *why = wrong == NULL ? "The numbers are in order." : wrong;
    }
    if (wrong != NULL) {
        free(renderer);
        renderer = NULL;
    }
    return renderer;
}

void hilbo_close(struct hilbo_renderer *renderer)
{
    if (renderer != NULL) {
        lock_end(&renderer->lock);
        free(renderer);
    }
}

/* An ESTOP that was asked for comes before all that follows it. */
static void enter(struct hilbo_renderer *renderer)
{
    lock_take(&renderer->lock);
    if (atomic_exchange(&renderer->estop, false)) {
        renderer->clock_failed = false;
        orders_estop(&renderer->orders);
    }
}

int hilbo_set(struct hilbo_renderer *renderer, const struct hilbo_parameters *set)
{
    enter(renderer);
    const int reason = orders_set(&renderer->orders, set);
    renderer->fate = reason == 0 ? HILBO_WAITING : HILBO_REFUSED;
    lock_leave(&renderer->lock);
    return reason;
}

/* Out of contact, and without a delay to check, before the first tick too. */
static void commit(struct hilbo_renderer *renderer)
{
    uint32_t ticks = 0;
    if (renderer->fate != HILBO_WAITING || hb_staging_now(&renderer->device, &ticks) != HB_READY ||
        hb_busy_ticks(&renderer->device) > 0U) {
        return;
    }
    renderer->fate = orders_commit(&renderer->orders) == 0 ? HILBO_IN_FORCE : HILBO_REFUSED;
}

int hilbo_start(struct hilbo_renderer *renderer, uint32_t stops)
{
    uint32_t ticks = 0;
    int reason = 0;
    enter(renderer);
    commit(renderer);
    if (renderer->fate == HILBO_WAITING) {
        (void)hb_staging_now(&renderer->device, &ticks);
        reason = orders_refuse(&renderer->orders, (uint8_t)HB_START, HB_NACK_NOT_READY, ticks);
    } else {
        reason = orders_start(&renderer->orders, stops); /* of the newest set, so that a refused one is a mismatch */
    }
    lock_leave(&renderer->lock);
    return reason;
}

int hilbo_clear(struct hilbo_renderer *renderer, uint32_t stops)
{
    enter(renderer);
    const int reason = orders_clear(&renderer->orders, stops);
    lock_leave(&renderer->lock);
    return reason;
}

void hilbo_stop(struct hilbo_renderer *renderer)
{
    enter(renderer);
    orders_stop(&renderer->orders);
    lock_leave(&renderer->lock);
}

void hilbo_estop(struct hilbo_renderer *renderer)
{
    atomic_store(&renderer->estop, true);
}

void hilbo_heartbeat(struct hilbo_renderer *renderer)
{
    enter(renderer);
    orders_heartbeat(&renderer->orders);
    lock_leave(&renderer->lock);
}

static struct hb_input input_at(const struct hilbo_renderer *renderer, double position_mm, uint32_t late_us)
{
    const double counts = round(position_mm / (double)renderer->config.encoder_step_mm);
    const bool valid = fabs(counts) <= 1e9; /* no NaN is */
    return (struct hb_input){
        .position_counts = valid ? (int32_t)counts : 0,
        .position_valid = valid,
        .delay_us = renderer->latency_us + late_us,
        .sensed_N = NAN,
    };
}

/* No call came in these periods. What was put out before them ramps down as in any HOLD, by the time that has passed;
 * when the ramp is over, more of them change nothing. */
static void miss(struct hilbo_renderer *renderer, uint32_t missed)
{
    const struct hb_input input = {.position_valid = false, .overrun = true, .sensed_N = NAN};
    for (uint32_t i = 0; i < missed && i < renderer->config.hold_ticks; i++) {
        (void)hb_tick(&renderer->device, &input);
    }
    renderer->missed += missed;
}

/* As the core does where its own positions are too fast. */
static void check_velocity(struct hilbo_renderer *renderer, double velocity_mm_per_s)
{
    struct hb_device *device = &renderer->device;
    const double limit_mm_per_s = (double)renderer->config.velocity_limit_mm_per_s;
    if (hb_is_in(device, HB_RUNNING) && fabs(velocity_mm_per_s) > limit_mm_per_s) { /* no NaN is */
        hb_count_up(&device->safety.count.holds);
        hb_ramp_begin(&device->safety);
        device->stops += 1U;
        hb_enter(device, HB_HOLDING, HB_CAUSE_VELOCITY);
    }
}

static double tick(struct hilbo_renderer *renderer, double position_mm, double velocity_mm_per_s, uint32_t late_us)
{
    const struct hb_input input = input_at(renderer, position_mm, late_us);
    renderer->late_us = late_us;
    renderer->latest_us = late_us > renderer->latest_us ? late_us : renderer->latest_us;
    check_velocity(renderer, velocity_mm_per_s);
    const double force_N = (double)hb_tick(&renderer->device, &input);
    commit(renderer);
    return force_N;
}

double hilbo_tick(struct hilbo_renderer *renderer, double position_mm, double velocity_mm_per_s, double time_s)
{
    enter(renderer);
    double force_N = 0.0;
    const struct arrival arrival = schedule_arrive(&renderer->schedule, time_s);
    if (arrival.moment == MOMENT_EARLY) {
        renderer->early += 1U;
        force_N = hb_is_in(&renderer->device, HB_ESTOPPED) ? 0.0 : (double)renderer->device.safety.force_N;
    } else {
        if (arrival.moment == MOMENT_WRONG) {
            renderer->clock_failed = true;
            orders_estop(&renderer->orders);
        }
        miss(renderer, arrival.missed);
        force_N = tick(renderer, position_mm, velocity_mm_per_s, arrival.late_us);
    }
    lock_leave(&renderer->lock);
    return force_N;
}

static uint32_t cause_of(const struct hilbo_renderer *renderer)
{
    const bool clock = renderer->clock_failed && hb_is_in(&renderer->device, HB_ESTOPPED);
    return clock ? (uint32_t)HILBO_CAUSE_CLOCK : renderer->device.cause;
}

void hilbo_get_state(struct hilbo_renderer *renderer, struct hilbo_state *state)
{
    enter(renderer);
    const struct hb_device *device = &renderer->device;
    const struct hb_counts *count = &device->safety.count;
    *state = (struct hilbo_state){
        .state = device->state,
        .cause = cause_of(renderer),
        .stops = device->stops,
        .set = (uint32_t)renderer->fate,
        .contact = hb_in_contact(&device->safety) ? 1U : 0U,
        .ticks = device->tick,
        .missed = renderer->missed,
        .early = renderer->early,
        .late_us = renderer->late_us,
        .latest_us = renderer->latest_us,
        .time_s = renderer->schedule.last_s,
        .position_mm = (double)hb_position_mm(&device->safety, &renderer->config),
        .force_N = (double)device->safety.force_N,
        .input_held = count->input_held,
        .saturated = count->saturated,
        .slewed = count->slewed,
        .controlled = count->controlled,
        .holds = count->holds,
        .estops = count->estops,
        .overruns = count->overruns,
    };
    (void)hb_staging_now(device, &state->wait_ticks);
    if (device->in_force) {
        state->minimum_damping_N_s_per_m = (double)device->bank[device->active].minimum_damping_N_s_per_m;
    }
    lock_leave(&renderer->lock);
}

void hilbo_sentence(struct hilbo_renderer *renderer, char *text, size_t room)
{
    enter(renderer);
    const struct orders orders = renderer->orders;
    lock_leave(&renderer->lock);
    orders_sentence(&orders, text, room);
}

double hilbo_K0_of(const struct hilbo_parameters *set, uint32_t tick_rate_Hz, double K_eff_N_per_mm)
{
    struct hb_renderer renderer;
    const bool is_short = set->exponentials == 0U && set->taps <= HB_MAX_TAPS;
    const struct hb_parameters parameters = {
        .set_id = 1U,
        .memory = (uint8_t)HB_SHORT,
        .length = is_short ? (uint16_t)set->taps : 0U,
        .tick_rate_Hz = in_16_bits(tick_rate_Hz),
        .K1_N_per_mm = (float)set->K1_N_per_mm,
        .B1_N_s_alpha_per_mm = (float)set->B1_N_s_alpha_per_mm,
        .alpha = (float)set->alpha,
    };
    if (!is_short || parameters.length == 0U) {
        return K_eff_N_per_mm;
    }
    hb_renderer_prepare(&renderer, &parameters);
    return K_eff_N_per_mm - (double)renderer.static_stiffness_N_per_mm;
}
