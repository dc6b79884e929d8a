#include "hb_motion.h"

void hb_enter(struct hb_device *device, enum hb_state state, enum hb_cause cause)
{
    uint8_t payload[HB_MAX_PAYLOAD];
    uint8_t bytes[HB_MAX_FRAME];
    device->state = (uint8_t)state;
    device->cause = (uint8_t)cause;
    device->offset_N = 0.0F;
    device->starting = false;
    struct hb_notice notice = {device->tick, device->boot_id, device->state, device->cause};
    size_t size = hb_pack_notice(&notice, payload);
    size = hb_frame_write(HB_NOTICE, 0U, payload, size, bytes);
    (void)hb_output_put(&device->output, bytes, size, 0U);
}

bool hb_is_in(const struct hb_device *device, enum hb_state state)
{
    return device->state == (uint8_t)state;
}

static enum hb_reason wrong_state(const struct hb_device *device, struct hb_reply *reply)
{
    reply->nack.value = (float)device->state;
    return HB_NACK_STATE;
}

enum hb_reason hb_start(struct hb_device *device, const struct hb_frame *frame, struct hb_reply *reply)
{
    struct hb_confirmation confirmation;
    if (!hb_unpack_confirmation(frame->payload, &confirmation)) {
        return HB_NACK_RESERVED;
    }
    if (confirmation.boot_id != device->boot_id) {
        return HB_NACK_BOOT_ID;
    }
    reply->set_id = device->bank[device->active].set.set_id;
    reply->crc = device->crc[device->active];
    bool same = device->in_force && confirmation.set_id == reply->set_id && confirmation.crc == reply->crc;
    if (hb_is_in(device, HB_RUNNING) && same) {
        return HB_ACCEPTED;
    }
    if (!hb_is_in(device, HB_STOPPED)) {
        return wrong_state(device, reply);
    }
    if (device->in_force && !same) {
        return HB_NACK_SET_MISMATCH;
    }
    if (!device->in_force) {
        return HB_NACK_NO_SET;
    }
    if (device->heartbeat_age_ticks >= device->config->watchdog_ticks) {
        return HB_NACK_NO_HEARTBEAT;
    }
    if (!hb_input_is_good(&device->safety)) {
        return HB_NACK_NO_INPUT;
    }
    hb_enter(device, HB_RUNNING, HB_CAUSE_NONE);
    device->starting = true;
    device->follows = false;
    device->safety.energy = 0;
    return HB_ACCEPTED;
}

enum hb_reason hb_drive(struct hb_device *device, const struct hb_frame *frame, struct hb_reply *reply)
{
    struct hb_drive_request request;
    if (!hb_unpack_drive(frame->payload, &request) || !hb_drive_is_named(&request)) {
        return HB_NACK_RESERVED;
    }
    if (request.boot_id != device->boot_id) {
        return HB_NACK_BOOT_ID;
    }
    if ((device->config->capabilities & (uint8_t)HB_CAN_DRIVE) == 0U) {
        return HB_NACK_NOT_CAPABLE;
    }
    if (!hb_is_in(device, HB_STOPPED)) {
        return wrong_state(device, reply);
    }
    enum hb_reason reason = hb_drive_check(&request, device->config, &reply->nack.value, &reply->nack.limit);
    if (reason != HB_ACCEPTED) {
        return reason;
    }
    if (device->heartbeat_age_ticks >= device->config->watchdog_ticks) {
        return HB_NACK_NO_HEARTBEAT;
    }
    if (!hb_input_is_good(&device->safety)) {
        return HB_NACK_NO_INPUT;
    }
    hb_drive_begin(&device->drive, &request, device->config, &device->safety);
    hb_enter(device, HB_DRIVING, HB_CAUSE_NONE);
    device->safety.energy = 0;
    return HB_ACCEPTED;
}

void hb_stop(struct hb_device *device)
{
    if (hb_is_in(device, HB_RUNNING) || hb_is_in(device, HB_DRIVING)) {
        hb_ramp_begin(&device->safety);
        hb_enter(device, HB_STOPPING, HB_CAUSE_NONE);
    }
}

void hb_estop(struct hb_device *device)
{
    if (!hb_is_in(device, HB_ESTOPPED)) {
        hb_count_up(&device->safety.count.estops);
        hb_enter(device, HB_ESTOPPED, HB_CAUSE_ESTOP);
    }
}

enum hb_reason hb_clear(struct hb_device *device, const struct hb_frame *frame, struct hb_reply *reply)
{
    if (hb_unpack_boot_id(frame->payload) != device->boot_id) {
        return HB_NACK_BOOT_ID;
    }
    if (!hb_is_in(device, HB_HOLDING) && !hb_is_in(device, HB_ESTOPPED)) {
        return wrong_state(device, reply);
    }
    if (hb_is_in(device, HB_ESTOPPED) && device->safety.force_N != 0.0F) {
        reply->nack.ticks = 1U; /* the tick that puts zero force out has not come yet */
        return HB_NACK_BUSY;
    }
    if (hb_is_in(device, HB_HOLDING) && !hb_ramp_has_ended(&device->safety, device->config)) {
        reply->nack.ticks = (uint32_t)(device->config->hold_ticks - device->safety.ramp_ticks);
        return HB_NACK_BUSY;
    }
    hb_enter(device, HB_STOPPED, HB_CAUSE_NONE);
    return HB_ACCEPTED;
}

