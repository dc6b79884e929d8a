/* Bytes between one side that puts and one that takes, of which one is an interrupt. A byte without room is lost: its
 * frame's CRC will tell. Each index is written by one side alone, and neither is ever taken back. */
#ifndef ARM_RING_H
#define ARM_RING_H

#include <stdbool.h>
#include <stdint.h>

#define RING_SIZE 256U /* a power of two, so that the indices may pass their largest number */

struct ring {
    volatile uint8_t bytes[RING_SIZE];
    volatile uint32_t put; /* written by the side that puts */
    volatile uint32_t got; /* written by the side that takes */
};

static inline bool ring_is_empty(const struct ring *ring)
{
    return ring->got == ring->put;
}

static inline uint32_t ring_room(const struct ring *ring)
{
    return RING_SIZE - (ring->put - ring->got);
}

static inline void ring_put(struct ring *ring, uint8_t byte)
{
    const uint32_t put = ring->put;
    if (put - ring->got < RING_SIZE) {
        ring->bytes[put % RING_SIZE] = byte;
        ring->put = put + 1U;
    }
}

/* False where there is none. */
static inline bool ring_take(struct ring *ring, uint8_t *byte)
{
    const uint32_t got = ring->got;
    if (got == ring->put) {
        return false;
    }
    *byte = ring->bytes[got % RING_SIZE];
    ring->got = got + 1U;
    return true;
}

#endif
