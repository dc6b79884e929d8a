#include "hb_device.h"

#include <string.h>

#include "hb_math.h"
#include "hb_motion.h"
#include "hb_requests.h"
#include "hb_staging.h"

_Static_assert(HB_MAX_TAPS % 2U == 1U && HB_MAX_TAPS <= 65535U, "HB_MAX_TAPS must be odd and fit into 16 bits");
_Static_assert(HB_MAX_STATES >= 1U && HB_MAX_STATES <= 255U, "HB_MAX_STATES must be 1 to 255");
_Static_assert(HB_OUTPUT_BYTES >= 3U * HB_MAX_FRAME, "HB_OUTPUT_BYTES must hold two answers and one telemetry frame");

enum hb_error hb_init(struct hb_device *device, const struct hb_config *config, uint32_t boot_id)
{
    enum hb_error error = hb_config_check(config);
    memset(device, 0, sizeof *device); /* in place: a literal of this size may pass over the stack */
    device->boot_id = boot_id;
    device->state = (uint8_t)HB_ESTOPPED;
    device->cause = (uint8_t)HB_CAUSE_BOOT;
    if (error == HB_OK && boot_id == 0U) {
        error = HB_ERROR_BOOT_ID;
    }
    if (error == HB_OK && hb_rounds_once()) {
        error = HB_ERROR_CONTRACTION;
    }
    if (error == HB_OK) {
        device->config = config;
        device->heartbeat_age_ticks = config->watchdog_ticks;
        hb_safety_begin(&device->safety, config);
        hb_enter(device, HB_STOPPED, HB_CAUSE_BOOT);
    }
    return error;
}

size_t hb_receive(struct hb_device *device, const uint8_t *bytes, size_t size)
{
    struct hb_frame frame;
    if (device->config == NULL) {
        return size;
    }
    for (size_t i = 0U; i < size; i += 1U) {
        if (hb_receiver_push(&device->receiver, bytes[i], &frame)) {
            hb_handle(device, &frame);
            return i + 1U;
        }
    }
    return size;
}

size_t hb_transmit(struct hb_device *device, uint8_t *bytes, size_t room)
{
    return hb_output_take(&device->output, bytes, room);
}

/* The largest force of a bank's set on this device. */
static float limit(const struct hb_device *device, uint8_t bank)
{
    float set_limit_N = device->bank[bank].set.force_limit_N;
    return set_limit_N < device->config->force_limit_N ? set_limit_N : device->config->force_limit_N;
}

/* What is felt of a bank's force. */
static float felt(const struct hb_device *device, uint8_t bank, float force_N)
{
    return force_N > 0.0F ? hb_clamp(force_N, 0.0F, limit(device, bank)) : 0.0F;
}

/* The offset, taken back as fast as the slew limit allows beside the model's own movement to `felt_N`; and no further
 * from 0 than `gap_N`, so that the force stays between those of the two sets while the hand moves. */
static void fade(struct hb_device *device, float felt_N, float gap_N)
{
    const struct hb_config *config = device->config;
    float step_N = config->slew_limit_N_per_s / (float)config->tick_rate_Hz;
    float moved_N = felt_N + device->offset_N - device->safety.force_N;
    float along_N = device->offset_N > 0.0F ? -moved_N : moved_N;
    float offset_N = hb_towards_zero(device->offset_N, hb_clamp(step_N - along_N, 0.0F, step_N));
    device->offset_N = gap_N > 0.0F ? hb_clamp(offset_N, 0.0F, gap_N) : hb_clamp(offset_N, gap_N, 0.0F);
}

/* The force with what is left of the offset. From beyond the limit of the new set it only falls: there the largest value
 * itself is returned, because the offset is a rounded difference and the sum may be above that value by a last place. */
static float below_limit(struct hb_device *device, float felt_N)
{
    float most_N = limit(device, device->active);
    most_N = device->safety.force_N > most_N ? device->safety.force_N : most_N;
    float force_N = felt_N + device->offset_N;
    if (force_N > most_N) {
        device->offset_N = most_N - felt_N;
        force_N = most_N;
    }
    return force_N;
}

/* The force while RUNNING and in contact, up to and with the slew limit. `old_N`: of the set that was in force before,
 * while the device goes on from it. */
static float run(struct hb_device *device, float model_N, float old_N)
{
    const struct hb_config *config = device->config;
    struct hb_safety *safety = &device->safety;
    float felt_N = felt(device, device->active, model_N);
    float gap_N = felt(device, (uint8_t)(1U - device->active), old_N) - felt_N;
    if (model_N > felt_N) {
        hb_mark_saturated(safety);
    }
    if (device->flipped) {
        device->offset_N = gap_N;
    }
    float before_N = below_limit(device, felt_N);
    bool switching = device->offset_N != 0.0F;
    if (switching) {
        safety->flags |= (uint16_t)HB_FLAG_SWITCHING;
        if (!device->flipped) {
            fade(device, felt_N, gap_N);
        }
    }
    float force_N = below_limit(device, felt_N);
    if ((config->capabilities & (uint8_t)HB_CAN_CONTROL_PASSIVITY) != 0U) {
        float most_N = limit(device, device->active);
        force_N = hb_clamp(hb_control(safety, config, force_N), 0.0F, force_N > most_N ? force_N : most_N);
    }
    if (force_N < safety->force_N) {
        return force_N; /* a force that was held up would give back more than the hand has put in */
    }
    return hb_slew(safety, config, force_N, switching ? before_N : force_N);
}

/* The command while RUNNING: nothing is felt out of contact, and what is left of a difference ends there. */
static float render(struct hb_device *device, float model_N, float old_N)
{
    float force_N = 0.0F;
    if (hb_in_contact(&device->safety)) {
        force_N = run(device, model_N, old_N);
    } else {
        device->offset_N = 0.0F;
    }
    return force_N;
}

static float drive(struct hb_device *device)
{
    float force_N = hb_drive_step(&device->drive, device->config, &device->safety);
    force_N = hb_saturate(&device->safety, force_N, device->config->force_limit_N);
    return hb_slew(&device->safety, device->config, force_N, force_N);
}

static void note_delay(struct hb_device *device, uint32_t delay_us)
{
    if (delay_us > device->longest_delay_us) {
        device->longest_delay_us = delay_us < UINT16_MAX ? (uint16_t)delay_us : UINT16_MAX;
    }
}

/* A tick was missed, or the last force came out later than sets are checked for. */
static bool is_late(const struct hb_device *device, const struct hb_input *input)
{
    return input->overrun || input->delay_us > device->config->delay_us;
}

/* A device that moves by itself meets its stops with nobody's hand between. */
static float fastest(const struct hb_device *device)
{
    float limit_mm_per_s = device->config->velocity_limit_mm_per_s;
    if (hb_is_in(device, HB_DRIVING)) {
        float driven_mm_per_s = HB_DRIVEN_SPEED * device->config->servo_speed_mm_per_s;
        limit_mm_per_s = driven_mm_per_s < limit_mm_per_s ? driven_mm_per_s : limit_mm_per_s;
    }
    return limit_mm_per_s;
}

static enum hb_cause fault(const struct hb_device *device, bool input_lost, bool late, bool hot, bool finite)
{
    if (device->heartbeat_age_ticks >= device->config->watchdog_ticks) {
        return HB_CAUSE_WATCHDOG;
    }
    if (input_lost || (hb_is_in(device, HB_DRIVING) && hb_drive_is_stuck(&device->drive, device->config))) {
        return HB_CAUSE_INPUT;
    }
    if (hb_is_too_fast(&device->safety, device->config, fastest(device))) {
        return HB_CAUSE_VELOCITY;
    }
    if (late) {
        return HB_CAUSE_OVERRUN;
    }
    if (hot) {
        return HB_CAUSE_HEAT;
    }
    return finite ? HB_CAUSE_NONE : HB_CAUSE_MODEL;
}

/* The command that the state asks for, once a fault has had its say. */
static float command(struct hb_device *device, float wanted_N, enum hb_cause cause)
{
    struct hb_safety *safety = &device->safety;
    bool moves = hb_is_in(device, HB_RUNNING) || hb_is_in(device, HB_DRIVING);
    if (moves && cause != HB_CAUSE_NONE) {
        hb_count_up(&safety->count.holds);
        hb_ramp_begin(safety);
        device->stops += 1U;
        hb_enter(device, HB_HOLDING, cause);
    } else if (hb_is_in(device, HB_DRIVING) && hb_drive_has_ended(&device->drive, device->config, safety)) {
        if (device->drive.request.shape == (uint8_t)HB_DRIVE_NUDGE) {
            safety->force_N = 0.0F; /* the ramp has work of its own, beyond what the nudge was given */
        }
        hb_ramp_begin(safety);
        device->stops += 1U;
        hb_enter(device, HB_STOPPING, HB_CAUSE_NONE);
    } else if (moves) {
        return wanted_N;
    }
    if (hb_is_in(device, HB_HOLDING)) {
        return hb_ramp(safety, device->config);
    }
    if (hb_is_in(device, HB_STOPPING)) {
        float force_N = hb_ramp(safety, device->config);
        if (hb_ramp_has_ended(safety, device->config)) {
            hb_enter(device, HB_STOPPED, HB_CAUSE_NONE);
        }
        return force_N;
    }
    return 0.0F;
}

static uint32_t flag_of_state(uint8_t state)
{
    switch (state) {
    case HB_RUNNING:
        return (uint32_t)HB_FLAG_RUNNING;
    case HB_DRIVING:
        return (uint32_t)HB_FLAG_DRIVING;
    case HB_HOLDING:
        return (uint32_t)HB_FLAG_HOLD;
    case HB_ESTOPPED:
        return (uint32_t)HB_FLAG_ESTOP;
    default:
        return 0U;
    }
}

static uint16_t state_flags(const struct hb_device *device)
{
    uint32_t contact = hb_in_contact(&device->safety) ? (uint32_t)HB_FLAG_CONTACT : 0U;
    return (uint16_t)(device->safety.flags | contact | flag_of_state(device->state));
}

float hb_tick(struct hb_device *device, const struct hb_input *input)
{
    const struct hb_config *config = device->config;
    struct hb_safety *safety = &device->safety;
    if (config == NULL) {
        return 0.0F;
    }
    device->tick += 1U;
    safety->flags = 0U;
    if (device->heartbeat_age_ticks < config->watchdog_ticks) {
        device->heartbeat_age_ticks += 1U;
    }
    note_delay(device, input->delay_us);
    bool late = is_late(device, input);
    if (late) {
        hb_count_up(&safety->count.overruns);
    }
    if (input->stop_open != device->stop_open) {
        device->stop_open = input->stop_open;
        if (input->stop_open) {
            hb_estop(device, HB_CAUSE_SWITCH);
        }
    }
    bool hot = hb_is_too_hot(safety, config);
    bool input_lost = !hb_check_input(safety, config, input);
    float old_N = 0.0F;
    float model_N = hb_render(device, hb_penetration_mm(safety, config), &old_N);
    bool finite = hb_is_finite(model_N) && hb_is_finite(old_N);
    hb_observe(safety, config);
    float wanted_N = 0.0F;
    if (hb_is_in(device, HB_RUNNING)) {
        wanted_N = render(device, model_N, old_N);
    } else if (hb_is_in(device, HB_DRIVING)) {
        wanted_N = drive(device);
    }
    device->flipped = false;
    safety->force_N = command(device, wanted_N, fault(device, input_lost, late, hot, finite));
    safety->flags = state_flags(device);
    struct hb_sample sample = {(int16_t)safety->counts, safety->flags, safety->force_N, input->sensed_N};
    hb_stream_tick(&device->stream, &device->output, device->tick, &sample);
    return safety->force_N;
}
