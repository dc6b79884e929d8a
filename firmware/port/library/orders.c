#include "orders.h"

#include "hb_math.h"

struct payload {
    uint8_t bytes[HB_MAX_PAYLOAD];
    size_t size;
};

static void put(struct payload *payload, uint32_t value, size_t size)
{
    for (size_t i = 0; i < size; i++) {
        payload->bytes[payload->size++] = (uint8_t)(value >> (8U * i));
    }
}

static void put_float(struct payload *payload, double value)
{
    put(payload, hb_bits_of_float((float)value), 4);
}

static uint32_t got(const uint8_t *bytes)
{
    return (uint32_t)bytes[0] | (uint32_t)bytes[1] << 8 | (uint32_t)bytes[2] << 16 | (uint32_t)bytes[3] << 24;
}

static void drain(struct orders *orders)
{
    uint8_t bytes[HB_MAX_FRAME];
    while (hb_transmit(orders->device, bytes, sizeof bytes) > 0U) {
    }
}

static void send(struct orders *orders, enum hb_type type, const struct payload *payload)
{
    uint8_t bytes[HB_MAX_FRAME];
    orders->seq = (uint8_t)(orders->seq + 1U);
    const size_t size = hb_frame_write((uint8_t)type, orders->seq, payload->bytes, payload->size, bytes);
    for (size_t taken = 0; taken < size;) {
        taken += hb_receive(orders->device, bytes + taken, size - taken);
    }
}

static int refused(struct orders *orders, const uint8_t *nack)
{
    orders->refusal = (struct hb_nack){
        .request = nack[0],
        .reason = nack[1],
        .ticks = got(nack + 4),
        .value = hb_float_of_bits(got(nack + 8)),
        .limit = hb_float_of_bits(got(nack + 12)),
    };
    return nack[1];
}

/* A request and its answer: 0, or the reason of a NACK. */
static int ask(struct orders *orders, enum hb_type type, const struct payload *payload)
{
    struct hb_receiver receiver = {.size = 0};
    struct hb_frame frame;
    uint8_t bytes[HB_MAX_FRAME];
    drain(orders); /* notices: hilbo_state has what they say */
    send(orders, type, payload);
    for (size_t size; (size = hb_transmit(orders->device, bytes, sizeof bytes)) > 0U;) {
        for (size_t i = 0; i < size; i++) {
            if (hb_receiver_push(&receiver, bytes[i], &frame) && frame.seq == orders->seq && frame.type == HB_NACK) {
                return refused(orders, frame.payload);
            }
        }
    }
    return 0;
}

int orders_refuse(struct orders *orders, uint8_t request, enum hb_reason reason, uint32_t ticks)
{
    orders->refusal = (struct hb_nack){.request = request, .reason = (uint8_t)reason, .ticks = ticks};
    return (int)reason;
}

int orders_hello(struct orders *orders)
{
    struct payload payload = {.size = 0};
    put(&payload, HB_PROTOCOL_VERSION, 4);
    put(&payload, HB_SCHEMA_CRC, 4);
    return ask(orders, HB_HELLO, &payload);
}

/* Numbers that 16 bits do not hold become the largest that they do, which is refused. */
static uint32_t at_most_16_bits(uint32_t value)
{
    return value < UINT16_MAX ? value : UINT16_MAX;
}

static int parameters(struct orders *orders, const struct hilbo_parameters *set)
{
    struct payload payload = {.size = 0};
    const bool full = set->exponentials > 0U;
    if (full && set->taps > 0U) {
        return orders_refuse(orders, (uint8_t)HB_SET_PARAMS, HB_NACK_RESERVED, 0U);
    }
    put(&payload, orders->set_id, 2);
    put(&payload, full ? (uint32_t)HB_FULL : (uint32_t)HB_SHORT, 2);
    put(&payload, at_most_16_bits(full ? set->exponentials : set->taps), 2);
    put(&payload, orders->device->config->tick_rate_Hz, 2);
    put_float(&payload, set->K0_N_per_mm);
    put_float(&payload, set->K1_N_per_mm);
    put_float(&payload, set->B1_N_s_alpha_per_mm);
    put_float(&payload, set->alpha);
    put_float(&payload, set->force_limit_N);
    return ask(orders, HB_SET_PARAMS, &payload);
}

int orders_set(struct orders *orders, const struct hilbo_parameters *set)
{
    orders->set_id = orders->set_id < UINT16_MAX ? (uint16_t)(orders->set_id + 1U) : 1U;
    int reason = parameters(orders, set);
    for (uint32_t first = 0; reason == 0 && first < set->exponentials; first += 7U) {
        struct payload payload = {.size = 0};
        const uint32_t left = set->exponentials - first, count = left < 7U ? left : 7U;
        put(&payload, orders->set_id, 2);
        put(&payload, first, 1);
        put(&payload, count, 1);
        for (uint32_t k = first; k < first + count; k++) {
            put_float(&payload, set->weight[k]);
            put_float(&payload, set->loss[k]);
        }
        reason = ask(orders, HB_SET_STATES, &payload);
    }
    return reason;
}

/* COMMIT and START name the set of a bank. */
static void name(struct payload *payload, const struct orders *orders, uint8_t bank)
{
    put(payload, orders->set_id, 4);
    put(payload, orders->device->crc[bank], 4);
    put(payload, orders->device->boot_id, 4);
}

int orders_commit(struct orders *orders)
{
    struct payload payload = {.size = 0};
    name(&payload, orders, (uint8_t)(1U - orders->device->active));
    return ask(orders, HB_COMMIT, &payload);
}

int orders_start(struct orders *orders, uint32_t stops)
{
    struct payload payload = {.size = 0};
    name(&payload, orders, orders->device->active);
    put(&payload, stops, 4);
    return ask(orders, HB_START, &payload);
}

int orders_clear(struct orders *orders, uint32_t stops)
{
    struct payload payload = {.size = 0};
    put(&payload, orders->device->boot_id, 4);
    put(&payload, stops, 4);
    return ask(orders, HB_CLEAR, &payload);
}

void orders_stop(struct orders *orders)
{
    (void)ask(orders, HB_STOP, &(struct payload){.size = 0});
}

void orders_estop(struct orders *orders)
{
    (void)ask(orders, HB_ESTOP, &(struct payload){.size = 0});
}

void orders_heartbeat(struct orders *orders)
{
    struct payload payload = {.size = 0};
    drain(orders);
    put(&payload, orders->device->boot_id, 4);
    put(&payload, orders->device->tick, 4);
    send(orders, HB_HEARTBEAT, &payload);
}
