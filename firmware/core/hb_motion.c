#include "hb_motion.h"

#include "hb_math.h"
#include "hb_staging.h"

void hb_enter(struct hb_device *device, enum hb_state state, enum hb_cause cause)
{
    uint8_t payload[HB_MAX_PAYLOAD];
    uint8_t bytes[HB_MAX_FRAME];
    device->state = (uint8_t)state;
    device->cause = (uint8_t)cause;
    device->offset_N = 0.0F;
    struct hb_notice notice = {device->tick, device->boot_id, device->state, device->cause, device->stops};
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

/* For this start of the device, and made after its last stop. */
static enum hb_reason check_time(const struct hb_device *device, uint32_t boot_id, uint32_t stop,
                                 struct hb_reply *reply)
{
    if (boot_id != device->boot_id) {
        return HB_NACK_BOOT_ID;
    }
    if (stop != device->stops) {
        reply->nack.ticks = device->stops;
        return HB_NACK_STALE;
    }
    return HB_ACCEPTED;
}

/* What every motion needs: a host that hears the device, and an encoder. While the hardware stop is open the device is
 * in ESTOP. */
static enum hb_reason check_readiness(const struct hb_device *device)
{
    if (device->heartbeat_age_ticks >= device->config->watchdog_ticks) {
        return HB_NACK_NO_HEARTBEAT;
    }
    if (!hb_input_is_good(&device->safety)) {
        return HB_NACK_NO_INPUT;
    }
    return HB_ACCEPTED;
}

enum hb_reason hb_start(struct hb_device *device, const struct hb_frame *frame, struct hb_reply *reply)
{
    struct hb_confirmation confirmation;
    if (!hb_unpack_confirmation(frame->payload, &confirmation)) {
        return HB_NACK_RESERVED;
    }
    enum hb_reason reason = check_time(device, confirmation.boot_id, hb_unpack_stop(frame->payload + 12), reply);
    if (reason != HB_ACCEPTED) {
        return reason;
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
    reason = check_readiness(device);
    if (reason != HB_ACCEPTED) {
        return reason;
    }
    if (!device->safety.homed) {
        return HB_NACK_NOT_HOMED;
    }
    if (hb_in_contact(&device->safety)) {
        return HB_NACK_IN_CONTACT; /* its force would give energy that the hand has not put in */
    }
    hb_enter(device, HB_RUNNING, HB_CAUSE_NONE); /* its energy counts from the next touch */
    return HB_ACCEPTED;
}

enum hb_reason hb_drive(struct hb_device *device, const struct hb_frame *frame, struct hb_reply *reply)
{
    struct hb_drive_request request;
    if (!hb_unpack_drive(frame->payload, &request) || !hb_drive_is_named(&request)) {
        return HB_NACK_RESERVED;
    }
    enum hb_reason reason = check_time(device, request.boot_id, request.stop, reply);
    if (reason != HB_ACCEPTED) {
        return reason;
    }
    if ((device->config->capabilities & (uint8_t)HB_CAN_DRIVE) == 0U) {
        return HB_NACK_NOT_CAPABLE;
    }
    uint32_t crc = hb_crc32(0U, frame->payload, frame->size);
    if (hb_is_in(device, HB_DRIVING) && crc == device->drive_crc) {
        return HB_ACCEPTED;
    }
    if (!hb_is_in(device, HB_STOPPED)) {
        return wrong_state(device, reply);
    }
    reason = hb_drive_check(&request, device->config, &reply->nack.value, &reply->nack.limit);
    if (reason == HB_ACCEPTED) {
        reason = check_readiness(device);
    }
    if (reason != HB_ACCEPTED) {
        return reason;
    }
    if (!device->safety.homed && request.shape != (uint8_t)HB_DRIVE_NUDGE) {
        return HB_NACK_NOT_HOMED;
    }
    hb_drive_begin(&device->drive, &request, device->config, &device->safety);
    hb_enter(device, HB_DRIVING, HB_CAUSE_NONE);
    device->drive_crc = crc;
    device->safety.energy = 0;
    return HB_ACCEPTED;
}

enum hb_reason hb_home_here(struct hb_device *device, const struct hb_frame *frame, struct hb_reply *reply)
{
    const struct hb_config *config = device->config;
    struct hb_home_request request;
    hb_unpack_home(frame->payload, &request);
    enum hb_reason reason = check_time(device, request.boot_id, request.stop, reply);
    if (reason != HB_ACCEPTED) {
        return reason;
    }
    if (!hb_is_in(device, HB_STOPPED)) {
        return wrong_state(device, reply);
    }
    if (!hb_is_finite(request.position_mm)) {
        return HB_NACK_NOT_FINITE;
    }
    if (request.position_mm < config->position_low_mm || request.position_mm > config->position_high_mm) {
        reply->nack.value = request.position_mm;
        reply->nack.limit = request.position_mm < 0.0F ? config->position_low_mm : config->position_high_mm;
        return HB_NACK_DRIVE_RANGE;
    }
    if (!hb_input_is_good(&device->safety)) {
        return HB_NACK_NO_INPUT;
    }
    hb_home(&device->safety, config, request.position_mm);
    device->stops += 1U; /* an order that was made for the old positions is stale */
    hb_rest_histories(device);
    return HB_ACCEPTED;
}

/* Counted in every state: an order that was made before does nothing after it. */
void hb_stop(struct hb_device *device)
{
    device->stops += 1U;
    if (hb_is_in(device, HB_RUNNING) || hb_is_in(device, HB_DRIVING)) {
        hb_ramp_begin(&device->safety);
        hb_enter(device, HB_STOPPING, HB_CAUSE_NONE);
    }
}

void hb_estop(struct hb_device *device, enum hb_cause cause)
{
    device->stops += 1U;
    if (!hb_is_in(device, HB_ESTOPPED) || cause == HB_CAUSE_SWITCH) {
        hb_count_up(&device->safety.count.estops);
        hb_enter(device, HB_ESTOPPED, cause);
    }
}

enum hb_reason hb_clear(struct hb_device *device, const struct hb_frame *frame, struct hb_reply *reply)
{
    struct hb_pair pair;
    hb_unpack_pair(frame->payload, &pair);
    enum hb_reason reason = check_time(device, pair.boot_id, pair.second, reply);
    if (reason != HB_ACCEPTED) {
        return reason;
    }
    if (!hb_is_in(device, HB_HOLDING) && !hb_is_in(device, HB_ESTOPPED)) {
        return HB_ACCEPTED; /* that stop has ended */
    }
    if (device->stop_open) {
        return HB_NACK_STOP_OPEN;
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
