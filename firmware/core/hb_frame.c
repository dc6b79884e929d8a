#include "hb_frame.h"

#define LONGEST_COBS 253U

/* CRC-32 of each half byte: 16 words of flash, two look-ups a byte. */
static const uint32_t crc_of_nibble[16] = {
    0x00000000U, 0x1db71064U, 0x3b6e20c8U, 0x26d930acU, 0x76dc4190U, 0x6b6b51f4U, 0x4db26158U, 0x5005713cU,
    0xedb88320U, 0xf00f9344U, 0xd6d6a3e8U, 0xcb61b38cU, 0x9b64c2b0U, 0x86d3d2d4U, 0xa00ae278U, 0xbdbdf21cU,
};

uint32_t hb_crc32(uint32_t crc, const uint8_t *bytes, size_t size)
{
    crc = ~crc;
    /*@ loop invariant i <= size;
        loop assigns i, crc;
        loop variant size - i; */
    for (size_t i = 0U; i < size; i += 1U) {
        crc ^= bytes[i];
        crc = (crc >> 4) ^ crc_of_nibble[crc & 15U];
        crc = (crc >> 4) ^ crc_of_nibble[crc & 15U];
    }
    return ~crc;
}

size_t hb_cobs_encode(const uint8_t *bytes, size_t size, uint8_t *encoded)
{
    size_t mark = 0U; /* where the distance to the next zero goes */
    if (size > LONGEST_COBS) {
        return 0U;
    }
    /*@ loop invariant mark <= i <= size;
        loop invariant \forall integer j; 0 <= j <= i && j != mark ==> encoded[j] != 0;
        loop assigns i, mark, encoded[0 .. size];
        loop variant size - i; */
    for (size_t i = 0U; i < size; i += 1U) {
        encoded[i + 1U] = bytes[i];
        if (bytes[i] == 0U) {
            encoded[mark] = (uint8_t)(i + 1U - mark);
            mark = i + 1U;
        }
    }
    encoded[mark] = (uint8_t)(size + 1U - mark);
    return size + 1U;
}

size_t hb_cobs_decode(const uint8_t *encoded, size_t size, uint8_t *bytes)
{
    size_t mark = 0U; /* where the next zero stands */
    if (size < 2U || size > LONGEST_COBS + 1U) {
        return 0U;
    }
    /*@ loop invariant i <= size && i <= mark <= i + 255;
        loop assigns i, mark, bytes[0 .. size - 2];
        loop variant size - i; */
    for (size_t i = 0U; i < size; i += 1U) {
        if (encoded[i] == 0U) {
            return 0U;
        }
        if (i > 0U) {
            bytes[i - 1U] = i == mark ? 0U : encoded[i];
        }
        if (i == mark) {
            mark += encoded[i];
        }
    }
    return mark == size ? size - 1U : 0U;
}

size_t hb_frame_write(uint8_t type, uint8_t seq, const uint8_t *payload, size_t size, uint8_t *bytes)
{
    uint8_t body[HB_MAX_BODY];
    size_t end = 2U;
    if (size > HB_MAX_PAYLOAD) {
        return 0U;
    }
    body[0] = type;
    body[1] = seq;
    /*@ loop invariant i <= size && end == i + 2;
        loop assigns i, end, body[2 .. HB_MAX_BODY - 1];
        loop variant size - i; */
    for (size_t i = 0U; i < size; i += 1U) {
        body[end] = payload[i];
        end += 1U;
    }
    uint32_t crc = hb_crc32(0U, body, end);
    /*@ loop invariant i <= 4 && end == size + 2 + i;
        loop assigns i, end, body[2 .. HB_MAX_BODY - 1];
        loop variant 4 - i; */
    for (uint32_t i = 0U; i < 4U; i += 1U) {
        body[end] = (uint8_t)(crc >> (8U * i) & 255U);
        end += 1U;
    }
    size_t length = hb_cobs_encode(body, end, bytes);
    bytes[length] = 0U;
    return length + 1U;
}

/* The frame that the receiver holds, or false. */
/*@ requires \valid_read(receiver) && \valid(frame) && \separated(receiver, frame) && hb_receiver_is_sound(receiver);
    assigns *frame;
    ensures \result ==> hb_frame_fits(frame); */
static bool take(const struct hb_receiver *receiver, struct hb_frame *frame)
{
    uint8_t body[HB_MAX_BODY];
    size_t size = hb_cobs_decode(receiver->bytes, receiver->size, body);
    if (size < 6U) {
        return false;
    }
    size -= 4U;
    uint32_t crc = 0U;
    /*@ loop invariant i <= 4;
        loop assigns i, crc;
        loop variant 4 - i; */
    for (uint32_t i = 0U; i < 4U; i += 1U) {
        crc |= (uint32_t)body[size + i] << (8U * i);
    }
    if (crc != hb_crc32(0U, body, size)) {
        return false;
    }
    frame->type = body[0];
    frame->seq = body[1];
    frame->crc = crc;
    frame->size = size - 2U;
    /*@ loop invariant i <= frame->size == size - 2;
        loop assigns i, frame->payload[0 .. HB_MAX_PAYLOAD - 1];
        loop variant frame->size - i; */
    for (size_t i = 0U; i < frame->size; i += 1U) {
        frame->payload[i] = body[i + 2U];
    }
    return true;
}

bool hb_receiver_push(struct hb_receiver *receiver, uint8_t byte, struct hb_frame *frame)
{
    if (byte != 0U) {
        if (receiver->size < HB_MAX_ENCODED) {
            receiver->bytes[receiver->size] = byte;
            receiver->size += 1U;
        } else {
            receiver->overlong = true;
        }
        return false;
    }
    bool empty = receiver->size == 0U;
    bool good = !empty && !receiver->overlong && take(receiver, frame);
    if (!good && !empty && receiver->dropped < UINT16_MAX) {
        receiver->dropped += 1U;
    }
    receiver->size = 0U;
    receiver->overlong = false;
    return good;
}
