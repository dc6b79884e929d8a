/* Frames over a bad line: each byte may be dropped, flipped in one bit, or preceded by a random one.
 * Usage: noise FRAMES RATE SEED. Prints: sent hit lost wrong unrecovered. `wrong` counts frames that came out and were
 * never sent, `unrecovered` those that were whole, behind a 0x00 that was whole, and did not come out. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "hb_frame.h"

static uint64_t random_bits(uint64_t *state)
{
    *state ^= *state << 13;
    *state ^= *state >> 7;
    *state ^= *state << 17;
    return *state * UINT64_C(2685821657736338717);
}

static double uniform(uint64_t *state)
{
    return (double)(random_bits(state) >> 11) / 9007199254740992.0;
}

/* Frame number i is decided by i alone. */
static size_t frame_of(uint32_t i, uint8_t *payload)
{
    uint64_t state = UINT64_C(0x9e3779b97f4a7c15) * ((uint64_t)i + 1U);
    size_t size = 4U + (size_t)(random_bits(&state) % (HB_MAX_PAYLOAD - 3U));
    for (size_t k = 0U; k < size; k += 1U) {
        uint8_t byte = (uint8_t)(random_bits(&state) >> 56);
        payload[k] = k < 4U ? (uint8_t)(i >> (8U * k) & 255U) : (uint8_t)(byte < 128U ? 0U : byte);
    }
    return size;
}

/* The number of the frame that has come out, or UINT32_MAX where it is none that was sent. */
static uint32_t identify(const struct hb_frame *frame, uint32_t sent)
{
    uint8_t payload[HB_MAX_PAYLOAD];
    uint32_t i = 0U;
    for (uint32_t k = 0U; k < 4U && frame->size >= 4U; k += 1U) {
        i |= (uint32_t)frame->payload[k] << (8U * k);
    }
    bool same = frame->size >= 4U && i < sent && frame->type == (uint8_t)(i & 15U) &&
                frame->seq == (uint8_t)(i >> 8 & 255U) && frame->size == frame_of(i, payload) &&
                memcmp(frame->payload, payload, frame->size) == 0;
    return same ? i : UINT32_MAX;
}

int main(int count, char **arguments)
{
    if (count != 4) {
        (void)printf("usage: noise FRAMES RATE SEED\n");
        return 2;
    }
    uint32_t frames = (uint32_t)strtoul(arguments[1], NULL, 10);
    double rate = strtod(arguments[2], NULL);
    uint64_t state = UINT64_C(88172645463325252) + strtoul(arguments[3], NULL, 10);
    struct hb_receiver receiver = {{0U}, 0U, false, 0U};
    struct hb_frame frame;
    unsigned long hit = 0U;
    unsigned long received = 0U;
    unsigned long wrong = 0U;
    unsigned long unrecovered = 0U;
    bool closed = true; /* the 0x00 before this frame arrived */
    for (uint32_t i = 0U; i < frames; i += 1U) {
        uint8_t payload[HB_MAX_PAYLOAD];
        uint8_t wire[HB_MAX_FRAME];
        size_t size = hb_frame_write((uint8_t)(i & 15U), (uint8_t)(i >> 8 & 255U), payload, frame_of(i, payload), wire);
        bool whole = true;
        bool came = false;
        bool last = true;
        for (size_t k = 0U; k < size; k += 1U) {
            uint8_t bytes[2] = {(uint8_t)(random_bits(&state) >> 56), wire[k]};
            size_t from = 1U;
            size_t to = 2U;
            if (uniform(&state) < rate) {
                uint64_t what = random_bits(&state) >> 32;
                from = what % 3U == 0U ? 0U : 1U;
                to = what % 3U == 1U ? 1U : 2U;
                bytes[1] = what % 3U == 2U ? (uint8_t)(bytes[1] ^ 1U << (what / 3U % 8U)) : bytes[1];
                whole = false;
                last = k + 1U < size || (to == 2U && bytes[1] == 0U);
            }
            for (size_t at = from; at < to; at += 1U) {
                if (hb_receiver_push(&receiver, bytes[at], &frame)) {
                    uint32_t number = identify(&frame, i + 1U);
                    wrong += number == UINT32_MAX ? 1U : 0U;
                    came = came || number == i;
                }
            }
        }
        hit += whole ? 0U : 1U;
        received += came ? 1U : 0U;
        unrecovered += whole && closed && !came ? 1U : 0U;
        closed = last;
    }
    (void)printf("%lu %lu %lu %lu %lu\n", (unsigned long)frames, hit, frames - received, wrong, unrecovered);
    return 0;
}
