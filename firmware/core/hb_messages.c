#include "hb_messages.h"

#include "hb_frame.h"
#include "hb_math.h"

/* Little-endian, byte by byte: no struct ever meets the wire. */
/*@ requires \valid_read(bytes + (0 .. 1));
    assigns \nothing; */
static uint16_t get_u16(const uint8_t *bytes)
{
    return (uint16_t)(bytes[0] | (uint32_t)bytes[1] << 8);
}

/*@ requires \valid_read(bytes + (0 .. 3));
    assigns \nothing; */
static uint32_t get_u32(const uint8_t *bytes)
{
    return get_u16(bytes) | (uint32_t)get_u16(bytes + 2) << 16;
}

/*@ requires \valid_read(bytes + (0 .. 3));
    assigns \nothing; */
static float get_f32(const uint8_t *bytes)
{
    return hb_float_of_bits(get_u32(bytes));
}

/*@ requires at < HB_MAX_PAYLOAD && \valid(payload + at);
    assigns payload[at];
    ensures \result == at + 1; */
static size_t put_u8(uint8_t *payload, size_t at, uint8_t value)
{
    payload[at] = value;
    return at + 1U;
}

/*@ requires at + 1 < HB_MAX_PAYLOAD && \valid(payload + (at .. at + 1));
    assigns payload[at .. at + 1];
    ensures \result == at + 2; */
static size_t put_u16(uint8_t *payload, size_t at, uint16_t value)
{
    at = put_u8(payload, at, (uint8_t)(value & 255U));
    return put_u8(payload, at, (uint8_t)(value >> 8));
}

/*@ requires at + 3 < HB_MAX_PAYLOAD && \valid(payload + (at .. at + 3));
    assigns payload[at .. at + 3];
    ensures \result == at + 4; */
static size_t put_u32(uint8_t *payload, size_t at, uint32_t value)
{
    at = put_u16(payload, at, (uint16_t)(value & 65535U));
    return put_u16(payload, at, (uint16_t)(value >> 16));
}

/*@ requires at + 3 < HB_MAX_PAYLOAD && \valid(payload + (at .. at + 3));
    assigns payload[at .. at + 3];
    ensures \result == at + 4; */
static size_t put_f32(uint8_t *payload, size_t at, float value)
{
    return put_u32(payload, at, hb_bits_of_float(value));
}

/*@ requires at + 7 < HB_MAX_PAYLOAD && \valid(payload + (at .. at + 7));
    assigns payload[at .. at + 7];
    ensures \result == at + 8; */
static size_t put_range(uint8_t *payload, size_t at, struct hb_range range)
{
    at = put_f32(payload, at, range.low);
    return put_f32(payload, at, range.high);
}

size_t hb_request_size(uint8_t type, const uint8_t *payload, size_t size)
{
    switch (type) {
    case HB_HELLO:
        return 8U;
    case HB_SET_PARAMS:
        return 28U;
    case HB_SET_STATES:
        return size < 4U || payload[3] == 0U || payload[3] > 7U ? 60U : 4U + 8U * (size_t)payload[3];
    case HB_COMMIT:
    case HB_HOME:
        return 12U;
    case HB_START:
        return 16U;
    case HB_GET_SET:
        return 1U;
    case HB_STREAM:
        return 2U;
    case HB_CLEAR:
    case HB_HEARTBEAT:
        return 8U;
    case HB_DRIVE:
        return 28U;
    case HB_ABORT:
    case HB_GET_STATUS:
    case HB_GET_LIMITS:
    case HB_STOP:
    case HB_ESTOP:
        return 0U;
    case HB_ECHO:
        return size;
    default:
        return HB_NO_REQUEST;
    }
}

bool hb_unpack_hello(const uint8_t *payload, struct hb_hello *hello)
{
    hello->version = get_u16(payload);
    hello->schema = get_u32(payload + 4);
    return get_u16(payload + 2) == 0U;
}

bool hb_unpack_parameters(const uint8_t *payload, struct hb_parameters *set)
{
    set->set_id = get_u16(payload);
    set->memory = payload[2];
    set->length = get_u16(payload + 4);
    set->tick_rate_Hz = get_u16(payload + 6);
    set->K0_N_per_mm = get_f32(payload + 8);
    set->K1_N_per_mm = get_f32(payload + 12);
    set->B1_N_s_alpha_per_mm = get_f32(payload + 16);
    set->alpha = get_f32(payload + 20);
    set->force_limit_N = get_f32(payload + 24);
    return payload[3] == 0U;
}

void hb_unpack_states(const uint8_t *payload, struct hb_states *states)
{
    states->set_id = get_u16(payload);
    states->first = payload[2];
    states->count = payload[3];
    /*@ loop invariant i <= states->count && i <= 7;
        loop assigns i, states->weight[0 .. 6], states->loss[0 .. 6];
        loop variant 7 - i; */
    for (size_t i = 0U; i < states->count && i < 7U; i += 1U) {
        states->weight[i] = get_f32(payload + 4U + 8U * i);
        states->loss[i] = get_f32(payload + 8U + 8U * i);
    }
}

bool hb_unpack_confirmation(const uint8_t *payload, struct hb_confirmation *confirmation)
{
    confirmation->set_id = get_u16(payload);
    confirmation->crc = get_u32(payload + 4);
    confirmation->boot_id = get_u32(payload + 8);
    return get_u16(payload + 2) == 0U;
}

bool hb_unpack_drive(const uint8_t *payload, struct hb_drive_request *drive)
{
    drive->mode = payload[0];
    drive->shape = payload[1];
    drive->offset = get_f32(payload + 4);
    drive->amplitude = get_f32(payload + 8);
    drive->period_ticks = get_u32(payload + 12);
    drive->duration_ticks = get_u32(payload + 16);
    drive->boot_id = get_u32(payload + 20);
    drive->stop = get_u32(payload + 24);
    return get_u16(payload + 2) == 0U;
}

uint32_t hb_unpack_stop(const uint8_t *payload)
{
    return get_u32(payload);
}

void hb_unpack_pair(const uint8_t *payload, struct hb_pair *pair)
{
    pair->boot_id = get_u32(payload);
    pair->second = get_u32(payload + 4);
}

void hb_unpack_home(const uint8_t *payload, struct hb_home_request *home)
{
    home->boot_id = get_u32(payload);
    home->stop = get_u32(payload + 4);
    home->position_mm = get_f32(payload + 8);
}

size_t hb_pack_hello_reply(const struct hb_config *config, uint32_t boot_id, uint32_t tick, uint8_t *payload)
{
    size_t at = put_u16(payload, 0U, HB_PROTOCOL_VERSION);
    at = put_u16(payload, at, config->tick_rate_Hz);
    at = put_u32(payload, at, HB_SCHEMA_CRC);
    at = put_u32(payload, at, config->firmware);
    at = put_u32(payload, at, boot_id);
    at = put_u32(payload, at, config->line_rate_baud);
    at = put_f32(payload, at, config->damping_N_s_per_m);
    at = put_f32(payload, at, config->force_limit_N);
    at = put_f32(payload, at, config->position_low_mm);
    at = put_f32(payload, at, config->position_high_mm);
    at = put_f32(payload, at, config->encoder_step_mm);
    at = put_f32(payload, at, config->slew_limit_N_per_s);
    at = put_f32(payload, at, config->velocity_limit_mm_per_s);
    at = put_u16(payload, at, config->watchdog_ticks);
    at = put_u16(payload, at, config->hold_ticks);
    at = put_u16(payload, at, config->most_taps);
    at = put_u8(payload, at, config->most_states);
    at = put_u8(payload, at, config->capabilities);
    return put_u32(payload, at, tick);
}

size_t hb_pack_limits(const struct hb_config *config, uint8_t *payload)
{
    size_t at = put_range(payload, 0U, config->K0_N_per_mm);
    at = put_range(payload, at, config->K1_N_per_mm);
    at = put_range(payload, at, config->B1_N_s_alpha_per_mm);
    at = put_range(payload, at, config->alpha);
    at = put_u32(payload, at, config->delay_us);
    at = put_f32(payload, at, config->continuous_force_N);
    return put_f32(payload, at, config->heating_s);
}

size_t hb_pack_ack(uint8_t request, uint16_t set_id, uint32_t crc, uint32_t stops, uint8_t *payload)
{
    size_t at = put_u8(payload, 0U, request);
    at = put_u8(payload, at, 0U);
    at = put_u16(payload, at, set_id);
    at = put_u32(payload, at, crc);
    return put_u32(payload, at, stops);
}

size_t hb_pack_nack(const struct hb_nack *nack, uint8_t *payload)
{
    size_t at = put_u8(payload, 0U, nack->request);
    at = put_u8(payload, at, nack->reason);
    at = put_u16(payload, at, 0U);
    at = put_u32(payload, at, nack->ticks);
    at = put_f32(payload, at, nack->value);
    return put_f32(payload, at, nack->limit);
}

size_t hb_pack_status(const struct hb_status *status, uint8_t *payload)
{
    size_t at = put_u32(payload, 0U, status->tick);
    at = put_u32(payload, at, status->boot_id);
    at = put_u8(payload, at, status->state);
    at = put_u8(payload, at, status->hold_reason);
    at = put_u8(payload, at, status->staging);
    at = put_u8(payload, at, status->contact);
    at = put_u16(payload, at, status->active_id);
    at = put_u16(payload, at, status->staged_id);
    at = put_u32(payload, at, status->active_crc);
    at = put_u32(payload, at, status->staged_crc);
    at = put_u32(payload, at, status->ticks_until_ready);
    at = put_f32(payload, at, status->position_mm);
    at = put_f32(payload, at, status->force_N);
    at = put_f32(payload, at, status->energy_mJ);
    /*@ loop invariant i <= 8 && at == 40 + 2 * i;
        loop assigns i, at, payload[40 .. 55];
        loop variant 8 - i; */
    for (size_t i = 0U; i < 8U; i += 1U) {
        at = put_u16(payload, at, status->counts[i]);
    }
    at = put_u32(payload, at, status->stops);
    at = put_u16(payload, at, status->flags);
    return put_u16(payload, at, status->delay_us);
}

size_t hb_pack_set(const struct hb_set_reply *reply, uint8_t *payload)
{
    size_t at = put_u8(payload, 0U, reply->bank);
    at = put_u8(payload, at, 0U);
    at = put_u16(payload, at, reply->set.set_id);
    at = put_u8(payload, at, reply->set.memory);
    at = put_u8(payload, at, reply->flags);
    at = put_u16(payload, at, reply->set.length);
    at = put_f32(payload, at, reply->set.K0_N_per_mm);
    at = put_f32(payload, at, reply->set.K1_N_per_mm);
    at = put_f32(payload, at, reply->set.B1_N_s_alpha_per_mm);
    at = put_f32(payload, at, reply->set.alpha);
    at = put_f32(payload, at, reply->set.force_limit_N);
    at = put_u32(payload, at, reply->crc);
    return put_f32(payload, at, reply->minimum_damping_N_s_per_m);
}

size_t hb_pack_notice(const struct hb_notice *notice, uint8_t *payload)
{
    size_t at = put_u32(payload, 0U, notice->tick);
    at = put_u32(payload, at, notice->boot_id);
    at = put_u8(payload, at, notice->state);
    at = put_u8(payload, at, notice->reason);
    at = put_u16(payload, at, 0U);
    return put_u32(payload, at, notice->stops);
}

size_t hb_pack_telemetry_head(uint32_t tick, uint8_t divisor, uint8_t fields, uint16_t lost, uint8_t *payload)
{
    size_t at = put_u32(payload, 0U, tick);
    at = put_u8(payload, at, divisor);
    at = put_u8(payload, at, fields);
    return put_u16(payload, at, lost);
}

size_t hb_pack_sample(const struct hb_sample *sample, bool with_sensed, uint8_t *payload)
{
    size_t at = put_u16(payload, 0U, (uint16_t)((uint32_t)sample->position_counts & 65535U));
    at = put_u16(payload, at, sample->flags);
    at = put_f32(payload, at, sample->force_N);
    return with_sensed ? put_f32(payload, at, sample->sensed_N) : at;
}
