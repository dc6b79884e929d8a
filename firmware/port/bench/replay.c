#include "replay.h"

#include <string.h>

#include "rig.h"

enum { END = 0, BYTES = 1, TICKS = 2 };

struct reader {
    const uint8_t *next;
    size_t left;
    bool good;
};

static const uint8_t *take(struct reader *reader, size_t size)
{
    const uint8_t *here = reader->next;
    reader->good = reader->good && size <= reader->left;
    if (!reader->good) {
        return NULL;
    }
    reader->next += size;
    reader->left -= size;
    return here;
}

static unsigned take_u8(struct reader *reader)
{
    const uint8_t *byte = take(reader, 1);
    return byte == NULL ? END : *byte;
}

static unsigned take_u16(struct reader *reader)
{
    const uint8_t *bytes = take(reader, 2);
    return bytes == NULL ? 0U : (unsigned)bytes[0] | (unsigned)bytes[1] << 8;
}

static void receive(struct replay *replay, const uint8_t *bytes, size_t size)
{
    uint8_t sent[64];
    for (size_t taken = 0; taken < size;) {
        taken += hb_receive(&replay->device, bytes + taken, size - taken);
    }
    for (size_t some; (some = hb_transmit(&replay->device, sent, sizeof sent)) > 0;) {
        replay->sent_crc = hb_crc32(replay->sent_crc, sent, some);
        replay->sent_bytes += (uint32_t)some;
    }
}

static bool tick(struct replay *replay, int32_t counts, replay_sink sink, void *context)
{
    const struct hb_input input = {.position_counts = counts, .position_valid = true, .sensed_N = 0.0F};
    const float force_N = hb_tick(&replay->device, &input);
    uint32_t bits = 0;
    memcpy(&bits, &force_N, sizeof bits);
    const uint8_t bytes[4] = {(uint8_t)bits, (uint8_t)(bits >> 8), (uint8_t)(bits >> 16), (uint8_t)(bits >> 24)};
    replay->force_crc = hb_crc32(replay->force_crc, bytes, sizeof bytes);
    replay->ticks++;
    receive(replay, NULL, 0);
    return sink(context, bits);
}

static bool run_ticks(struct replay *replay, struct reader *reader, replay_sink sink, void *context)
{
    for (unsigned left = take_u16(reader); left > 0; left--) {
        const unsigned raw = take_u16(reader);
        const int32_t counts = raw < 0x8000U ? (int32_t)raw : (int32_t)raw - 0x10000;
        if (!reader->good || !tick(replay, counts, sink, context)) {
            return false;
        }
    }
    return reader->good;
}

bool replay_run(struct replay *replay, const uint8_t *file, size_t size, replay_sink sink, void *context)
{
    const struct sim_rig_config rig = sim_rig_defaults();
    *replay = (struct replay){.config = sim_rig_describe(&rig)};
    if (hb_init(&replay->device, &replay->config, 1) != HB_OK) {
        return false;
    }
    struct reader reader = {file, size, true};
    const uint8_t *magic = take(&reader, 4);
    if (magic == NULL || memcmp(magic, "HBR1", 4) != 0) {
        return false;
    }
    for (;;) {
        const unsigned kind = take_u8(&reader);
        if (kind == BYTES) {
            const size_t count = take_u8(&reader);
            const uint8_t *bytes = take(&reader, count);
            if (bytes != NULL) {
                receive(replay, bytes, count);
            }
        } else if (kind != TICKS || !run_ticks(replay, &reader, sink, context)) {
            return reader.good && kind == END;
        }
    }
}
