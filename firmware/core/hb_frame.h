/* Frames on the line: COBS(type seq payload crc) 0x00. Knows no messages. See PROTOCOL.md, "Frames". */
#ifndef HB_FRAME_H
#define HB_FRAME_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define HB_MAX_PAYLOAD 64U
#define HB_MAX_BODY (HB_MAX_PAYLOAD + 6U)
#define HB_MAX_ENCODED (HB_MAX_BODY + 1U)   /* COBS adds one byte */
#define HB_MAX_FRAME (HB_MAX_ENCODED + 1U) /* and the 0x00 */

/* A body that has passed its CRC. */
struct hb_frame {
    uint8_t type;
    uint8_t seq;
    size_t size; /* of the payload */
    uint8_t payload[HB_MAX_PAYLOAD];
    uint32_t crc;
};

/*@ predicate hb_frame_fits(struct hb_frame *f) = f->size <= HB_MAX_PAYLOAD; */

/* Bytes since the last 0x00. All zero is a receiver that has heard nothing. */
struct hb_receiver {
    uint8_t bytes[HB_MAX_ENCODED];
    size_t size;
    bool overlong;
    uint16_t dropped; /* frames; stays at 65535 */
};

/*@ predicate hb_receiver_is_sound(struct hb_receiver *r) =
      r->size <= HB_MAX_ENCODED && (r->overlong == 0 || r->overlong == 1); */

/* CRC-32 (ISO-HDLC) of `size` more bytes; start with crc = 0. */
/*@ requires \valid_read(bytes + (0 .. size - 1));
    assigns \nothing; */
uint32_t hb_crc32(uint32_t crc, const uint8_t *bytes, size_t size);

/* COBS of at most 253 bytes without the closing 0x00; `encoded` has room for size + 1. Returns size + 1. */
/*@ requires \valid_read(bytes + (0 .. size - 1)) && \valid(encoded + (0 .. size));
    requires \separated(bytes + (0 .. size - 1), encoded + (0 .. size));
    assigns encoded[0 .. size];
    ensures size <= 253 ==> \result == size + 1;
    ensures size > 253 ==> \result == 0;
    ensures no_zero: \forall integer j; 0 <= j < \result ==> encoded[j] != 0; */
size_t hb_cobs_encode(const uint8_t *bytes, size_t size, uint8_t *encoded);

/* The inverse, into `bytes` (room for size - 1). Returns the number of bytes, or 0 where it is no COBS. */
/*@ requires \valid_read(encoded + (0 .. size - 1)) && \valid(bytes + (0 .. size - 2));
    requires \separated(bytes + (0 .. size - 2), encoded + (0 .. size - 1));
    assigns bytes[0 .. size - 2];
    ensures \result == 0 || \result == size - 1;
    ensures 2 <= size <= 254 || \result == 0; */
size_t hb_cobs_decode(const uint8_t *encoded, size_t size, uint8_t *bytes);

/* One frame with its 0x00 into `bytes` (room for HB_MAX_FRAME); size <= HB_MAX_PAYLOAD. Returns its length. */
/*@ requires \valid_read(payload + (0 .. size - 1)) && \valid(bytes + (0 .. HB_MAX_FRAME - 1));
    assigns bytes[0 .. HB_MAX_FRAME - 1];
    ensures size <= HB_MAX_PAYLOAD ==> \result == size + 8;
    ensures size > HB_MAX_PAYLOAD ==> \result == 0;
    ensures one_zero: \forall integer j; 0 <= j < \result ==> (bytes[j] == 0 <==> j == \result - 1); */
size_t hb_frame_write(uint8_t type, uint8_t seq, const uint8_t *payload, size_t size, uint8_t *bytes);

/* One byte from the line. True when it completes a good frame, which is then in `frame`. */
/*@ requires \valid(receiver) && \valid(frame) && \separated(receiver, frame) && hb_receiver_is_sound(receiver);
    assigns *receiver, *frame;
    ensures hb_receiver_is_sound(receiver);
    ensures \result ==> hb_frame_fits(frame) && byte == 0;
    ensures byte == 0 ==> receiver->size == 0; */
bool hb_receiver_push(struct hb_receiver *receiver, uint8_t byte, struct hb_frame *frame);

#ifdef __cplusplus
}
#endif

#endif
