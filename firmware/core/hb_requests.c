#include "hb_requests.h"

#include <string.h>

#include "hb_motion.h"
#include "hb_staging.h"

static enum hb_reason hello(struct hb_device *device, const struct hb_frame *frame, struct hb_reply *reply)
{
    struct hb_hello hello;
    bool in_order = hb_unpack_hello(frame->payload, &hello);
    reply->nack.value = (float)hello.version;
    reply->nack.limit = (float)HB_PROTOCOL_VERSION;
    if (hello.version != HB_PROTOCOL_VERSION) {
        return HB_NACK_VERSION;
    }
    reply->nack.value = 0.0F;
    reply->nack.limit = 0.0F;
    if (!in_order) {
        return HB_NACK_RESERVED;
    }
    if (hello.schema != HB_SCHEMA_CRC) {
        return HB_NACK_SCHEMA;
    }
    device->greeted = true;
    device->answered = false; /* what another conversation was answered is not for this one */
    hb_stream_begin(&device->stream, 0U, 0U);
    reply->type = HB_HELLO_REPLY;
    reply->size = hb_pack_hello_reply(device->config, device->boot_id, device->tick, reply->payload);
    return HB_ACCEPTED;
}

static void name_set(const struct hb_device *device, uint8_t bank, struct hb_reply *reply)
{
    reply->set_id = device->bank[bank].set.set_id;
    reply->crc = device->crc[bank];
}

static enum hb_reason commit(struct hb_device *device, const struct hb_frame *frame, struct hb_reply *reply)
{
    struct hb_confirmation confirmation;
    if (!hb_unpack_confirmation(frame->payload, &confirmation)) {
        return HB_NACK_RESERVED;
    }
    if (confirmation.boot_id != device->boot_id) {
        return HB_NACK_BOOT_ID;
    }
    enum hb_reason reason = hb_commit(device, &confirmation, &reply->nack);
    name_set(device, device->active, reply);
    return reason;
}

static enum hb_reason stream(struct hb_device *device, const struct hb_frame *frame, struct hb_reply *reply)
{
    uint8_t divisor = frame->payload[0];
    uint8_t fields = frame->payload[1];
    if (fields > 1U) {
        return HB_NACK_RESERVED;
    }
    uint32_t smallest = hb_stream_smallest_divisor(device->config, fields);
    if (divisor > 0U && divisor < smallest) {
        reply->nack.value = (float)divisor;
        reply->nack.limit = (float)smallest;
        return HB_NACK_LINE_TOO_SLOW;
    }
    if (fields == 1U && (device->config->capabilities & (uint8_t)HB_CAN_SENSE_FORCE) == 0U) {
        return HB_NACK_NOT_CAPABLE;
    }
    hb_stream_begin(&device->stream, divisor, fields);
    return HB_ACCEPTED;
}

static enum hb_reason get_status(const struct hb_device *device, struct hb_reply *reply)
{
    const struct hb_counts *count = &device->safety.count;
    struct hb_status status = {
        .tick = device->tick,
        .boot_id = device->boot_id,
        .state = device->state,
        .hold_reason = device->cause,
        .contact = hb_in_contact(&device->safety) ? 1U : 0U,
        .position_mm = hb_position_mm(&device->safety, device->config),
        .force_N = device->safety.force_N,
        .energy_mJ = hb_energy_mJ(&device->safety),
        .counts = {count->input_held, count->saturated, count->slewed, count->controlled, count->holds, count->estops,
                   count->overruns, device->receiver.dropped},
        .stops = device->stops,
        .flags = (uint16_t)((device->safety.homed ? 1U : 0U) | (device->stop_open ? 2U : 0U)),
        .delay_us = device->longest_delay_us,
    };
    status.staging = (uint8_t)hb_staging_now(device, &status.ticks_until_ready);
    if (device->in_force) {
        status.active_id = device->bank[device->active].set.set_id;
        status.active_crc = device->crc[device->active];
    }
    if (device->staging != (uint8_t)HB_EMPTY) {
        status.staged_id = device->bank[1U - device->active].set.set_id;
        status.staged_crc = device->crc[1U - device->active];
    }
    reply->type = HB_STATUS;
    reply->size = hb_pack_status(&status, reply->payload);
    return HB_ACCEPTED;
}

static enum hb_reason get_set(const struct hb_device *device, const struct hb_frame *frame, struct hb_reply *reply)
{
    uint8_t asked = frame->payload[0];
    struct hb_set_reply set = {.bank = asked};
    if (asked > 1U) {
        return HB_NACK_RESERVED;
    }
    if (asked == 0U ? device->in_force : device->staging != (uint8_t)HB_EMPTY) {
        uint8_t bank = asked == 0U ? device->active : (uint8_t)(1U - device->active);
        set.flags = 1U;
        set.set = device->bank[bank].set;
        set.crc = device->crc[bank];
        set.minimum_damping_N_s_per_m = device->bank[bank].minimum_damping_N_s_per_m;
    }
    reply->type = HB_SET;
    reply->size = hb_pack_set(&set, reply->payload);
    return HB_ACCEPTED;
}

static enum hb_reason echo(const struct hb_frame *frame, struct hb_reply *reply)
{
    for (size_t i = 0U; i < frame->size; i += 1U) {
        reply->payload[i] = frame->payload[i];
    }
    reply->type = HB_ECHO_REPLY;
    reply->size = frame->size;
    return HB_ACCEPTED;
}

static enum hb_reason carry_out(struct hb_device *device, const struct hb_frame *frame, struct hb_reply *reply)
{
    enum hb_reason reason = HB_ACCEPTED;
    switch (frame->type) {
    case HB_HELLO:
        return hello(device, frame, reply);
    case HB_SET_PARAMS:
        reason = hb_stage_parameters(device, frame, &reply->nack);
        name_set(device, (uint8_t)(1U - device->active), reply);
        return reason;
    case HB_SET_STATES:
        reason = hb_stage_states(device, frame);
        name_set(device, (uint8_t)(1U - device->active), reply);
        return reason;
    case HB_COMMIT:
        return commit(device, frame, reply);
    case HB_ABORT:
        device->staging = (uint8_t)HB_EMPTY;
        return HB_ACCEPTED;
    case HB_GET_STATUS:
        return get_status(device, reply);
    case HB_GET_SET:
        return get_set(device, frame, reply);
    case HB_GET_LIMITS:
        reply->type = HB_LIMITS;
        reply->size = hb_pack_limits(device->config, reply->payload);
        return HB_ACCEPTED;
    case HB_START:
        return hb_start(device, frame, reply);
    case HB_STOP:
        hb_stop(device);
        return HB_ACCEPTED;
    case HB_ESTOP:
        hb_estop(device, HB_CAUSE_ESTOP);
        return HB_ACCEPTED;
    case HB_CLEAR:
        return hb_clear(device, frame, reply);
    case HB_STREAM:
        return stream(device, frame, reply);
    case HB_DRIVE:
        return hb_drive(device, frame, reply);
    case HB_HOME:
        return hb_home_here(device, frame, reply);
    default:
        return echo(frame, reply);
    }
}

/* What can be said before the request is looked into. */
static enum hb_reason admit(const struct hb_device *device, const struct hb_frame *frame, struct hb_reply *reply)
{
    uint8_t type = frame->type;
    size_t expected = hb_request_size(type, frame->payload, frame->size);
    if (!device->greeted && type != HB_HELLO && type != HB_GET_STATUS && type != HB_STOP && type != HB_ESTOP) {
        return HB_NACK_NO_HELLO;
    }
    if (expected == HB_NO_REQUEST) {
        return HB_NACK_UNKNOWN_TYPE;
    }
    if (frame->size != expected) {
        reply->nack.value = (float)frame->size;
        reply->nack.limit = (float)expected;
        return HB_NACK_LENGTH;
    }
    return HB_ACCEPTED;
}

/* Requests that a repetition must not carry out twice. */
static bool acts_once(uint8_t type)
{
    return type == HB_SET_PARAMS || type == HB_SET_STATES || type == HB_COMMIT || type == HB_ABORT ||
           type == HB_START || type == HB_CLEAR || type == HB_STREAM || type == HB_DRIVE || type == HB_HOME;
}

static void answer(struct hb_device *device, const struct hb_frame *frame)
{
    uint8_t bytes[HB_MAX_FRAME];
    struct hb_reply reply = {.type = HB_ACK};
    enum hb_reason reason = admit(device, frame, &reply);
    if (reason == HB_ACCEPTED) {
        reason = carry_out(device, frame, &reply);
    }
    if (reason != HB_ACCEPTED) {
        reply.type = HB_NACK;
        reply.nack.request = frame->type;
        reply.nack.reason = (uint8_t)reason;
        reply.size = hb_pack_nack(&reply.nack, reply.payload);
    } else if (reply.type == HB_ACK) {
        reply.size = hb_pack_ack(frame->type, reply.set_id, reply.crc, device->stops, reply.payload);
    }
    size_t size = hb_frame_write(reply.type, frame->seq, reply.payload, reply.size, bytes);
    (void)hb_output_put(&device->output, bytes, size, 0U);
    if (acts_once(frame->type)) {
        memcpy(device->answer, bytes, size);
        device->answer_size = size;
        device->answered = true;
        device->answered_seq = frame->seq;
        device->answered_crc = frame->crc;
    }
}

/* A heartbeat is as old as the tick that its sender has heard: one that was long on its way, in either direction, feeds
 * the watchdog no more than the ticks since then leave. */
static void heartbeat(struct hb_device *device, const struct hb_frame *frame)
{
    struct hb_pair pair;
    if (frame->size != hb_request_size(HB_HEARTBEAT, frame->payload, frame->size)) {
        return;
    }
    hb_unpack_pair(frame->payload, &pair);
    uint32_t age = device->tick - pair.second; /* of a tick that has not been: more than any watchdog */
    if (pair.boot_id != device->boot_id) {
        return;
    }
    if (age < device->heartbeat_age_ticks) {
        device->heartbeat_age_ticks = age;
    }
    uint8_t payload[HB_MAX_PAYLOAD];
    uint8_t bytes[HB_MAX_FRAME];
    struct hb_notice pulse = {device->tick, device->boot_id, device->state, device->cause, device->stops};
    size_t size = hb_pack_notice(&pulse, payload);
    size = hb_frame_write(HB_PULSE, frame->seq, payload, size, bytes);
    (void)hb_output_put(&device->output, bytes, size, 2U * HB_MAX_FRAME); /* answers and notices come first */
}

void hb_handle(struct hb_device *device, const struct hb_frame *frame)
{
    if (frame->type == HB_HEARTBEAT) {
        heartbeat(device, frame);
    } else if (device->answered && frame->seq == device->answered_seq && frame->crc == device->answered_crc) {
        (void)hb_output_put(&device->output, device->answer, device->answer_size, 0U);
    } else {
        answer(device, frame);
    }
}
