/* What a host sends to the device, sent to a core in this process: the same frames, and so the same checks. */
#ifndef LIBRARY_ORDERS_H
#define LIBRARY_ORDERS_H

#include "hb_device.h"
#include "hilbo_renderer.h"

struct orders {
    struct hb_device *device;
    uint8_t seq;
    uint16_t set_id; /* of the newest set */
    struct hb_nack refusal; /* the last one; reason 0: none yet */
};

/* HELLO. All return 0, or the reason of the refusal, which `refusal` then has with its numbers. */
int orders_hello(struct orders *orders);
int orders_set(struct orders *orders, const struct hilbo_parameters *set);
int orders_commit(struct orders *orders);
int orders_start(struct orders *orders, uint32_t stops);
int orders_clear(struct orders *orders, uint32_t stops);
void orders_stop(struct orders *orders);
void orders_estop(struct orders *orders);
void orders_heartbeat(struct orders *orders);

/* Refused by the library itself. */
int orders_refuse(struct orders *orders, uint8_t request, enum hb_reason reason, uint32_t ticks);

/* The last refusal as a sentence. */
void orders_sentence(const struct orders *orders, char *text, size_t room);

#endif
