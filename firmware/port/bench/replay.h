/* A recorded input, played to the core: the same file must give the same bits on every machine.
 *
 *     file   = "HBR1" record* 0x00
 *     record = 0x01 size:u8 byte*size             bytes from the host, now
 *            | 0x02 count:u16 position:i16*count  so many ticks, with these encoder counts
 *
 * The boot id is 1; numbers are little-endian. */
#ifndef BENCH_REPLAY_H
#define BENCH_REPLAY_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "hb_device.h"

struct replay {
    struct hb_config config;
    struct hb_device device;
    uint32_t ticks;
    uint32_t force_crc; /* CRC-32 of all forces, 4 bytes each */
    uint32_t sent_crc;  /* CRC-32 of all that the device sent */
    uint32_t sent_bytes;
};

/* What becomes of each force; false ends the replay. */
typedef bool (*replay_sink)(void *context, uint32_t force_bits);

/* False where the file is none, or the sink had enough. */
bool replay_run(struct replay *replay, const uint8_t *file, size_t size, replay_sink sink, void *context);

#endif
