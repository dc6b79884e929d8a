/* A recorded input, played to the core: the same file must give the same bits on every machine.
 *
 *     file   = "HBR1" record* 0x00
 *     record = 0x01 size:u8 byte*size             bytes from the host, now
 *            | 0x02 count:u16 position:i16*count  so many ticks, with these encoder counts
 *            | 0x03 size:u8 letter*size           a section of that name begins
 *
 * The boot id is 1; numbers are little-endian. Where there is a counter, it is read before and after each tick, and before
 * and after each piece of a frame that the core takes, and each section's smallest and largest differences are kept. */
#ifndef BENCH_REPLAY_H
#define BENCH_REPLAY_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "hb_device.h"

struct replay_cost {
    uint32_t runs;
    uint32_t least;
    uint32_t most;
    uint64_t total;
};

struct replay_section {
    char name[64];
    struct replay_cost ticks;
    struct replay_cost bytes; /* whole calls of hb_receive */
};

struct replay_hooks {
    void *context;
    bool (*force)(void *context, uint32_t bits);                          /* false ends the replay */
    void (*section)(void *context, const struct replay_section *section); /* a section is over; or NULL */
    uint32_t (*elapsed)(void); /* something's count since the last call; or NULL */
};

struct replay {
    struct replay_hooks hooks;
    struct hb_config config;
    struct hb_device device;
    struct replay_section section;
    uint32_t overhead; /* of a measurement of nothing */
    uint32_t ticks;
    uint32_t force_crc; /* CRC-32 of all forces, 4 bytes each */
    uint32_t sent_crc;  /* CRC-32 of all that the device sent */
    uint32_t sent_bytes;
};

/* False where the file is none, or the hook had enough. */
bool replay_run(struct replay *replay, const uint8_t *file, size_t size, const struct replay_hooks *hooks);

#endif
