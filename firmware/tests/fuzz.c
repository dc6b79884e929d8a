/* The device under libFuzzer: the input is a little program of frames, good ones, spoilt ones and noise, with ticks in
 * between. A shadow receiver reads the same bytes, so that the harness knows what the host has really confirmed. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "hb_device.h"

struct input {
    const uint8_t *bytes;
    size_t left;
};

/* A set as the frames said it. */
struct told {
    uint32_t crc;
    struct hb_parameters set;
};

struct rig {
    struct hb_config config;
    struct hb_device device;
    struct hb_receiver shadow;
    struct hb_receiver answers;
    struct told staged;
    struct told confirmed;
    bool committed;
    uint32_t silent_ticks; /* since the newest tick that came with a heartbeat of the right boot id */
    uint32_t stops;        /* what makes earlier orders stale, as the harness counts it */
    bool stop_open;        /* at the last tick */
    uint32_t ramp_ticks;
    uint64_t held;   /* a bit for each of the last ticks whose position was not believed, the newest lowest; since it moves */
    bool zero_owed;  /* ESTOP was heeded, and no tick has put out zero since */
    int32_t position;
    uint8_t seq;
};

static void must(bool good, const char *what)
{
    if (!good) {
        (void)fprintf(stderr, "broken: %s\n", what);
        abort();
    }
}

static uint8_t next(struct input *input)
{
    if (input->left == 0U) {
        return 0U;
    }
    input->left -= 1U;
    input->bytes += 1U;
    return input->bytes[-1];
}

static struct hb_config config_with(uint8_t capabilities, uint32_t delay_us)
{
    return (struct hb_config){
        .line_rate_baud = 1000000U, .tick_rate_Hz = 1000U, .watchdog_ticks = 40U, .hold_ticks = 20U, .most_taps = 31U,
        .most_states = 12U, .capabilities = capabilities, .damping_N_s_per_m = 0.95F, .force_limit_N = 40.0F,
        .position_low_mm = -20.0F, .position_high_mm = 60.0F, .encoder_step_mm = 0.0127F,
        .slew_limit_N_per_s = 2000.0F, .velocity_limit_mm_per_s = 1000.0F, .plausible_step_mm = 2.0F,
        .K0_N_per_mm = {-20.0F, 40.0F}, .K1_N_per_mm = {0.5F, 40.0F}, .B1_N_s_alpha_per_mm = {0.0005F, 40.0F},
        .alpha = {0.005F, 0.995F}, .servo_stiffness_N_per_mm = 1.0F, .servo_damping_N_s_per_mm = 0.02F,
        .servo_integral_N_per_mm_s = 5.0F, .servo_speed_mm_per_s = 100.0F,
        .delay_us = delay_us, .continuous_force_N = 20.0F, .heating_s = 0.5F,
    };
}

static void start(struct rig *rig, uint8_t capabilities, uint32_t delay_us, uint32_t boot_id)
{
    memset(rig, 0, sizeof *rig);
    rig->config = config_with(capabilities, delay_us);
    must(hb_init(&rig->device, &rig->config, boot_id) == HB_OK, "config refused");
    rig->silent_ticks = rig->config.watchdog_ticks;
}

/* Restart as after a loss of power: what the host said before is worth nothing. */
static void restart(struct rig *rig)
{
    int32_t position = rig->position;
    start(rig, rig->config.capabilities, rig->config.delay_us, rig->device.boot_id + 1U);
    rig->position = position;
}

static bool is_moving(uint8_t state)
{
    return state == (uint8_t)HB_RUNNING || state == (uint8_t)HB_DRIVING;
}

static void check_state(const struct hb_device *device)
{
    must(device->state <= (uint8_t)HB_ESTOPPED && device->cause <= (uint8_t)HB_CAUSE_HEAT, "state is not legal");
    must(device->staging <= (uint8_t)HB_WARMING && device->active <= 1U, "staging is not legal");
    must(device->receiver.size <= HB_MAX_ENCODED, "receiver");
    must(device->output.first < HB_OUTPUT_BYTES && device->output.size <= HB_OUTPUT_BYTES, "output");
    must(device->state != (uint8_t)HB_RUNNING || device->in_force, "RUNNING without a set");
    must(device->staging == (uint8_t)HB_EMPTY || !device->flipped, "staged during a flip");
    for (size_t i = 0U; i < 2U; i += 1U) {
        const struct hb_renderer *bank = &device->bank[i];
        must(bank->set.length <= HB_MAX_TAPS && bank->oldest < HB_MAX_TAPS, "history");
    }
}

static bool same_set(const struct hb_parameters *a, const struct hb_parameters *b)
{
    return a->set_id == b->set_id && a->memory == b->memory && a->length == b->length &&
           a->K0_N_per_mm == b->K0_N_per_mm && a->K1_N_per_mm == b->K1_N_per_mm &&
           a->B1_N_s_alpha_per_mm == b->B1_N_s_alpha_per_mm && a->alpha == b->alpha &&
           a->force_limit_N == b->force_limit_N;
}

/* What ends a motion is counted, and an order that names another count does nothing. */
static void check_orders(struct rig *rig, const struct hb_frame *frame, const struct hb_pair *pair,
                         const struct hb_device *before)
{
    const struct hb_device *device = &rig->device;
    if ((frame->type == (uint8_t)HB_STOP || frame->type == (uint8_t)HB_ESTOP) && frame->size == 0U) {
        rig->stops += 1U;
    }
    if (frame->type == (uint8_t)HB_HOME && device->stops != before->stops) {
        must(before->state == (uint8_t)HB_STOPPED && pair->second == rig->stops, "homed by an older order");
        rig->stops += 1U;
    }
    must(device->stops == rig->stops, "stops are not counted");
    bool latched = before->state == (uint8_t)HB_ESTOPPED || before->state == (uint8_t)HB_HOLDING;
    bool freed = latched && device->state == (uint8_t)HB_STOPPED;
    must(!freed || (frame->type == (uint8_t)HB_CLEAR && pair->second == rig->stops), "cleared by an older order");
    must(!freed || !rig->stop_open, "cleared with an open stop");
    bool begins = is_moving(device->state) && !is_moving(before->state);
    size_t at = frame->type == (uint8_t)HB_START ? 12U : 24U;
    must(!begins || (frame->size >= at + 4U && hb_unpack_stop(frame->payload + at) == rig->stops), "an older order acted");
    must(device->safety.zero_counts == before->safety.zero_counts || frame->type == (uint8_t)HB_HOME, "homed unasked");
}

/* What a frame that has arrived whole lets the device do. */
static void check_frame(struct rig *rig, const struct hb_frame *frame, const struct hb_device *before)
{
    const struct hb_device *device = &rig->device;
    struct hb_confirmation confirmation = {0U, 0U, 0U};
    struct hb_pair pair = {0U, 0U};
    bool confirms = frame->size >= 12U && hb_unpack_confirmation(frame->payload, &confirmation) &&
                    confirmation.boot_id == device->boot_id;
    if (frame->size >= 8U) {
        hb_unpack_pair(frame->payload, &pair);
    }
    if (frame->type == (uint8_t)HB_HEARTBEAT && frame->size == 8U && pair.boot_id == device->boot_id &&
        device->tick - pair.second < rig->silent_ticks) {
        rig->silent_ticks = device->tick - pair.second;
    }
    check_orders(rig, frame, &pair, before);
    if (frame->type == (uint8_t)HB_SET_PARAMS && frame->size == 28U && device->staging != (uint8_t)HB_EMPTY &&
        device->crc[1U - device->active] == hb_crc32(0U, frame->payload, frame->size)) {
        (void)hb_unpack_parameters(frame->payload, &rig->staged.set);
        rig->staged.crc = device->crc[1U - device->active];
    }
    if (frame->type == (uint8_t)HB_SET_STATES && device->states_known != before->states_known) {
        rig->staged.crc = hb_crc32(rig->staged.crc, frame->payload, frame->size);
    }
    if (device->in_force != before->in_force || device->active != before->active) {
        must(frame->type == (uint8_t)HB_COMMIT && confirms, "in force without COMMIT");
        must(confirmation.crc == rig->staged.crc && confirmation.set_id == rig->staged.set.set_id,
             "in force under another name");
        rig->confirmed = rig->staged;
        rig->committed = true;
    }
    if (device->state == (uint8_t)HB_RUNNING && before->state != (uint8_t)HB_RUNNING) {
        must(frame->type == (uint8_t)HB_START && confirms && confirmation.crc == rig->confirmed.crc,
             "RUNNING without START");
    }
    if (is_moving(device->state) && !is_moving(before->state)) {
        must(device->safety.known, "moves before a position is known");
        must(device->safety.homed || device->drive.request.shape == (uint8_t)HB_DRIVE_NUDGE, "moves before it is homed");
        must(device->state != (uint8_t)HB_RUNNING || device->safety.counts <= 0, "starts in contact");
        must(!rig->zero_owed, "moves before ESTOP has put out zero");
        must((rig->held & 1U) == 0U, "moves on a bad position");
    }
    if (device->state == (uint8_t)HB_DRIVING && before->state != (uint8_t)HB_DRIVING) {
        must(frame->type == (uint8_t)HB_DRIVE, "DRIVING without DRIVE");
    }
    if (frame->type == (uint8_t)HB_ESTOP && frame->size == 0U) {
        must(device->state == (uint8_t)HB_ESTOPPED, "ESTOP not heeded");
        rig->zero_owed = rig->zero_owed || device->safety.force_N != 0.0F;
    }
}

static uint64_t frames_ended; /* good ones and bad ones: 0x00 bytes */

static void feed(struct rig *rig, const uint8_t *bytes, size_t size)
{
    static struct hb_device before;
    struct hb_frame frame;
    for (size_t i = 0U; i < size; i += 1U) {
        bool whole = hb_receiver_push(&rig->shadow, bytes[i], &frame);
        frames_ended += bytes[i] == 0U ? 1U : 0U;
        if (whole) {
            before = rig->device;
        }
        uint8_t state = rig->device.state;
        must(hb_receive(&rig->device, &bytes[i], 1U) == 1U, "a byte was not taken");
        if (whole) {
            check_frame(rig, &frame, &before);
        } else {
            must(rig->device.state == state, "half a frame changed the state");
        }
        check_state(&rig->device);
    }
}

/* Everything that goes out is a whole frame. */
static void drain(struct rig *rig, size_t room)
{
    uint8_t bytes[256];
    struct hb_frame frame;
    size_t size = hb_transmit(&rig->device, bytes, room);
    must(size <= room, "more than there is room for");
    for (size_t i = 0U; i < size; i += 1U) {
        if (hb_receiver_push(&rig->answers, bytes[i], &frame)) {
            must(frame.type >= (uint8_t)HB_HELLO_REPLY && frame.type <= (uint8_t)HB_PULSE, "unknown answer");
        }
    }
    must(rig->answers.dropped == 0U, "a broken frame went out");
}

/* What is felt of a bank alone at the next tick. */
static float felt_N(const struct hb_device *before, uint8_t bank, float x_mm)
{
    static struct hb_renderer alone;
    alone = before->bank[bank];
    float most_N = fminf(alone.set.force_limit_N, before->config->force_limit_N);
    return fmaxf(fminf(hb_renderer_step(&alone, x_mm), most_N), 0.0F);
}

/* While a set is rendered: nothing out of contact; in contact the force of the set, at a switch between those of both
 * sets, at START between 0 and the set's; or less, one step of the slew limit on the way there. The passivity controller
 * may give less, and more by the device's own damping. */
static void check_rendering(const struct hb_device *before, const struct hb_device *after)
{
    const struct hb_safety *safety = &after->safety;
    float step_N = 2.0F + 1e-4F;
    if (safety->counts <= 0) {
        must(safety->force_N == 0.0F, "force in free air");
        return;
    }
    float x_mm = (float)safety->counts * after->config->encoder_step_mm;
    float new_N = felt_N(before, before->active, x_mm);
    bool switching = before->flipped || before->offset_N != 0.0F;
    float old_N = switching ? felt_N(before, 1U - before->active, x_mm) : new_N;
    bool controls = (after->config->capabilities & (uint8_t)HB_CAN_CONTROL_PASSIVITY) != 0U;
    float damped_N = 0.95F * fabsf((float)safety->step_counts * 0.0127F) / (float)safety->step_ticks;
    float low_N = controls ? 0.0F : fminf(old_N, new_N);
    float high_N = fmaxf(old_N, new_N) + (controls ? damped_N : 0.0F);
    must(safety->force_N <= high_N + 1e-4F, "more than either set");
    must(safety->force_N >= fminf(low_N, before->safety.force_N + step_N) - 1e-4F, "less than either set");
}

static uint64_t ticks_checked;

static void say_ticks(void)
{
    (void)fprintf(stderr, "%llu frames, %llu ticks checked\n", (unsigned long long)frames_ended,
                  (unsigned long long)ticks_checked);
}

static void check_input(struct rig *rig)
{
    bool held = (rig->device.safety.flags & (uint16_t)HB_FLAG_INPUT_HELD) != 0U;
    rig->held = (rig->held << 1) | (held ? 1U : 0U);
    uint32_t bad = 0U;
    for (uint32_t i = 0U; i < 33U; i += 1U) {
        bad += (uint32_t)(rig->held >> i) & 1U;
    }
    must(!is_moving(rig->device.state) || ((rig->held & 7U) != 7U && bad <= 5U), "moves without an encoder");
    rig->held &= is_moving(rig->device.state) ? UINT64_MAX : 1U;
}

static void tick(struct rig *rig, uint8_t flags)
{
    static struct hb_device earlier;
    struct hb_device *device = &rig->device;
    float before_N = device->safety.force_N;
    uint8_t state = device->state;
    earlier = *device;
    uint32_t delay_us = (flags & 8U) != 0U ? rig->config.delay_us + 1U : rig->config.delay_us;
    struct hb_input input = {rig->position,       (flags & 1U) == 0U, (flags & 2U) != 0U, (flags & 48U) == 48U, delay_us,
                             (flags & 4U) != 0U ? NAN : 1.0F};
    float force_N = hb_tick(device, &input);
    bool opens = input.stop_open && !rig->stop_open;
    rig->stop_open = input.stop_open;
    rig->stops += opens || (is_moving(state) && !is_moving(device->state)) ? 1U : 0U;
    must(device->stops == rig->stops, "stops are not counted at a tick");
    must(!input.stop_open || (device->state == (uint8_t)HB_ESTOPPED && force_N == 0.0F), "moves with an open stop");
    must(!is_moving(device->state) || input.delay_us <= rig->config.delay_us, "moves though late");
    rig->silent_ticks += rig->silent_ticks < rig->config.watchdog_ticks ? 1U : 0U;
    must(isfinite(force_N) && fabsf(force_N) <= rig->config.force_limit_N, "force is not finite, or beyond its limit");
    check_state(device);
    ticks_checked += 1U;
    check_input(rig);
    if (state == (uint8_t)HB_RUNNING && device->state == (uint8_t)HB_RUNNING) {
        check_rendering(&earlier, device);
    }
    must(!rig->zero_owed || force_N == 0.0F, "ESTOP is not zero at the next tick");
    rig->zero_owed = false;
    if (is_moving(device->state)) {
        must(device->state == state, "moves by itself");
        must(rig->silent_ticks < rig->config.watchdog_ticks, "moves without a host");
        bool drives = device->state == (uint8_t)HB_DRIVING;
        must((drives ? fabsf(force_N - before_N) : force_N - before_N) <= 2.0F + 1e-4F, "slew");
        float limit_N = device->bank[device->active].set.force_limit_N;
        must(state != (uint8_t)HB_RUNNING || fabsf(force_N) <= fmaxf(limit_N, fabsf(before_N)), "limit of the set");
        rig->ramp_ticks = 0U;
    } else if (device->state == (uint8_t)HB_HOLDING || device->state == (uint8_t)HB_STOPPING) {
        rig->ramp_ticks += 1U;
        must(fabsf(force_N) <= fabsf(before_N), "grows on its way to zero");
        must(force_N == 0.0F || rig->ramp_ticks < rig->config.hold_ticks, "on its way to zero for too long");
    } else {
        must(force_N == 0.0F, "force at rest");
    }
    if (device->in_force) {
        must(rig->committed && device->crc[device->active] == rig->confirmed.crc &&
                 same_set(&device->bank[device->active].set, &rig->confirmed.set),
             "renders what nobody confirmed");
    }
}

static size_t put(uint8_t *payload, size_t at, uint32_t value, size_t size)
{
    for (size_t i = 0U; i < size; i += 1U) {
        payload[at + i] = (uint8_t)(value >> (8U * i));
    }
    return at + size;
}

static size_t put_float(uint8_t *payload, size_t at, float value)
{
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    return put(payload, at, bits, 4U);
}

static size_t good_set(struct input *input, uint8_t *payload)
{
    uint8_t choice = next(input);
    size_t at = put(payload, 0U, 1U + (choice & 3U), 2U);
    bool full = (choice & 4U) != 0U;
    at = put(payload, at, full ? 1U : 0U, 2U);
    at = put(payload, at, full ? 1U + (choice >> 7) : 1U + 2U * (uint32_t)(choice >> 4), 2U);
    at = put(payload, at, 1000U, 2U);
    at = put_float(payload, at, 0.02F * (float)next(input) - 1.0F);
    at = put_float(payload, at, 0.5F + 0.02F * (float)next(input));
    at = put_float(payload, at, 0.01F + 0.01F * (float)next(input));
    at = put_float(payload, at, full && choice < 128U ? 0.5F : 0.01F + 0.002F * (float)next(input));
    return put_float(payload, at, 0.2F * (float)next(input));
}

/* p = 1 alone is the memory of alpha with 2^alpha = 2/(2 - loss). */
static size_t good_states(const struct hb_device *device, struct input *input, uint8_t *payload)
{
    const struct hb_renderer *idle = &device->bank[1U - device->active];
    size_t at = put(payload, 0U, idle->set.set_id, 2U);
    at = put(payload, at, device->states_known, 1U);
    at = put(payload, at, 1U, 1U);
    if (idle->set.length == 1U) {
        at = put_float(payload, at, 1.0F);
        return put_float(payload, at, 2.0F - 2.0F * powf(2.0F, -idle->set.alpha));
    }
    at = put_float(payload, at, (float)next(input) / 255.0F);
    return put_float(payload, at, (float)next(input) / 255.0F);
}

static size_t confirmation(const struct hb_device *device, uint8_t bank, uint8_t *payload)
{
    size_t at = put(payload, 0U, device->bank[bank].set.set_id, 4U);
    at = put(payload, at, device->crc[bank], 4U);
    return put(payload, at, device->boot_id, 4U);
}

/* The last stop, or now and then one before or after it. */
static uint32_t stop_of(const struct hb_device *device, struct input *input)
{
    uint8_t choice = next(input);
    return choice < 224U ? device->stops : device->stops + choice - 240U;
}

static size_t good_drive(const struct hb_device *device, struct input *input, uint8_t *payload)
{
    size_t at = put(payload, 0U, next(input) & 1U, 1U);
    at = put(payload, at, next(input) & 3U, 3U);
    at = put_float(payload, at, (float)next(input) * 0.1F - 10.0F);
    at = put_float(payload, at, (float)next(input) * 0.1F);
    at = put(payload, at, 4U + next(input), 4U);
    at = put(payload, at, 1U + next(input), 4U);
    return put(payload, put(payload, at, device->boot_id, 4U), stop_of(device, input), 4U);
}

/* The payload that a careful host would send. */
static size_t good_payload(const struct hb_device *device, uint8_t type, struct input *input, uint8_t *payload)
{
    size_t at = 0U;
    switch (type) {
    case HB_HELLO:
        return put(payload, put(payload, 0U, HB_PROTOCOL_VERSION, 4U), HB_SCHEMA_CRC, 4U);
    case HB_SET_PARAMS:
        return good_set(input, payload);
    case HB_SET_STATES:
        return good_states(device, input, payload);
    case HB_COMMIT:
        return confirmation(device, (uint8_t)(1U - device->active), payload);
    case HB_START:
        return put(payload, confirmation(device, device->active, payload), stop_of(device, input), 4U);
    case HB_CLEAR:
        return put(payload, put(payload, 0U, device->boot_id, 4U), stop_of(device, input), 4U);
    case HB_HEARTBEAT:
        return put(payload, put(payload, 0U, device->boot_id, 4U), device->tick - (next(input) >> 2), 4U);
    case HB_HOME:
        at = put(payload, put(payload, 0U, device->boot_id, 4U), stop_of(device, input), 4U);
        return put_float(payload, at, 0.1F * (float)(int8_t)next(input));
    case HB_GET_SET:
        return put(payload, 0U, next(input) & 1U, 1U);
    case HB_STREAM:
        return put(payload, put(payload, 0U, next(input), 1U), next(input) & 1U, 1U);
    case HB_DRIVE:
        return good_drive(device, input, payload);
    case HB_ECHO:
        return next(input) & 63U;
    default:
        return 0U;
    }
}

/* A frame with a right checksum; `spoil` bytes of its payload are changed, or its length. */
static void send(struct rig *rig, uint8_t type, struct input *input, uint8_t spoil)
{
    uint8_t payload[HB_MAX_PAYLOAD] = {0U};
    uint8_t bytes[HB_MAX_FRAME];
    size_t size = good_payload(&rig->device, type, input, payload);
    for (uint8_t i = 0U; i < spoil; i += 1U) {
        payload[next(input) % HB_MAX_PAYLOAD] ^= next(input);
    }
    if (spoil == 3U) {
        size = next(input) % (HB_MAX_PAYLOAD + 1U);
    }
    rig->seq = (uint8_t)(rig->seq + (spoil == 2U ? 0U : 1U));
    size = hb_frame_write(type, rig->seq, payload, size, bytes);
    feed(rig, bytes, size);
}

static void noise(struct rig *rig, struct input *input)
{
    size_t size = next(input) & 127U;
    size = size < input->left ? size : input->left;
    feed(rig, input->bytes, size);
    input->bytes += size;
    input->left -= size;
}

static void move(struct rig *rig, struct input *input)
{
    uint8_t many = next(input);
    int32_t step = (int32_t)(int8_t)next(input) / 4;
    for (uint32_t i = 0U; i <= (many & 63U); i += 1U) {
        rig->position += rig->position > -1500 - step && rig->position < 4700 - step ? step : 0;
        tick(rig, 0U);
        if ((many & 64U) != 0U && i % 16U == 0U) {
            send(rig, HB_HEARTBEAT, input, 0U);
        }
    }
    drain(rig, 256U);
}

/* Anything the encoder could say. */
static void jolt(struct rig *rig, struct input *input)
{
    int32_t position = rig->position;
    uint8_t flags = next(input);
    uint32_t bits = (uint32_t)next(input) << 24 | (uint32_t)next(input) << 16 | (uint32_t)next(input) << 8;
    rig->position = (flags & 128U) != 0U ? (int32_t)bits : (int32_t)bits / 65536;
    tick(rig, flags);
    rig->position = (flags & 64U) != 0U ? rig->position : position;
}

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t size);

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t size)
{
    static struct rig rig;
    struct input input = {bytes, size};
    static bool begun;
    if (!begun) {
        begun = atexit(say_ticks) == 0;
    }
    uint8_t kind = next(&input);
    start(&rig, (kind & 23U) | 8U, (kind & 32U) != 0U ? 100U : 0U, 7U);
    while (input.left > 0U) {
        uint8_t action = next(&input);
        uint8_t type = action & 31U;
        switch (action >> 5) {
        case 0U:
        case 1U:
            send(&rig, type, &input, 0U);
            break;
        case 2U:
            send(&rig, type, &input, (uint8_t)(1U + next(&input) % 3U));
            break;
        case 3U:
            noise(&rig, &input);
            break;
        case 4U:
            jolt(&rig, &input);
            break;
        case 5U:
            drain(&rig, type * 8U);
            break;
        case 6U:
            if (type == 0U) {
                restart(&rig);
            }
            break;
        default:
            move(&rig, &input);
        }
    }
    return 0;
}
