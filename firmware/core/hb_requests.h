/* What the device does with a frame that has arrived whole. */
#ifndef HB_REQUESTS_H
#define HB_REQUESTS_H

#include "hb_device.h"

#ifdef __cplusplus
extern "C" {
#endif

/* The answer as it grows: an ACK with set_id and crc, unless a reason or another type is given. */
struct hb_reply {
    uint8_t type;
    uint16_t set_id;
    uint32_t crc;
    struct hb_nack nack;
    size_t size;
    uint8_t payload[HB_MAX_PAYLOAD];
};

/* Carry out a request, or answer it as before, and put the answer out. */
void hb_handle(struct hb_device *device, const struct hb_frame *frame);

#ifdef __cplusplus
}
#endif

#endif
