/* A hardware counter of 16 bits, extended to 32 by its differences: it is read often enough that it moves by less than
 * 32768 in between, which at 1 kHz and 10 um is 328 m/s. */
#ifndef ENCODER_H
#define ENCODER_H

#include <stdint.h>

struct encoder {
    uint16_t counter;
    int32_t counts;
};

static inline int32_t encoder_extend(struct encoder *encoder, uint16_t counter)
{
    const uint16_t up = (uint16_t)(counter - encoder->counter);
    const int32_t moved = up < 0x8000U ? (int32_t)up : (int32_t)up - 0x10000;
    encoder->counter = counter;
    encoder->counts = (int32_t)((uint32_t)encoder->counts + (uint32_t)moved);
    return encoder->counts;
}

#endif
