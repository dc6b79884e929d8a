#include "replay.h"

#include <string.h>

#include "rig.h"

enum { END = 0, BYTES = 1, TICKS = 2, SECTION = 3 };

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

static void restart_count(const struct replay *replay)
{
    if (replay->hooks.elapsed != NULL) {
        (void)replay->hooks.elapsed();
    }
}

static void add_count(const struct replay *replay, struct replay_cost *cost)
{
    if (replay->hooks.elapsed == NULL) {
        return;
    }
    const uint32_t count = replay->hooks.elapsed() - replay->overhead;
    cost->least = cost->runs == 0 || count < cost->least ? count : cost->least;
    cost->most = count > cost->most ? count : cost->most;
    cost->total += count;
    cost->runs++;
}

static void drain(struct replay *replay)
{
    uint8_t sent[64];
    for (size_t some; (some = hb_transmit(&replay->device, sent, sizeof sent)) > 0;) {
        replay->sent_crc = hb_crc32(replay->sent_crc, sent, some);
        replay->sent_bytes += (uint32_t)some;
    }
}

static void receive(struct replay *replay, const uint8_t *bytes, size_t size)
{
    for (size_t taken = 0; taken < size;) {
        restart_count(replay);
        taken += hb_receive(&replay->device, bytes + taken, size - taken);
        add_count(replay, &replay->section.bytes);
        drain(replay);
    }
}

static bool tick(struct replay *replay, int32_t counts)
{
    const struct hb_input input = {.position_counts = counts, .position_valid = true, .sensed_N = 0.0F};
    restart_count(replay);
    const float force_N = hb_tick(&replay->device, &input);
    add_count(replay, &replay->section.ticks);
    uint32_t bits = 0;
    memcpy(&bits, &force_N, sizeof bits);
    const uint8_t bytes[4] = {(uint8_t)bits, (uint8_t)(bits >> 8), (uint8_t)(bits >> 16), (uint8_t)(bits >> 24)};
    replay->force_crc = hb_crc32(replay->force_crc, bytes, sizeof bytes);
    replay->ticks++;
    drain(replay);
    return replay->hooks.force(replay->hooks.context, bits);
}

static bool run_ticks(struct replay *replay, struct reader *reader)
{
    for (unsigned left = take_u16(reader); left > 0; left--) {
        const unsigned raw = take_u16(reader);
        const int32_t counts = raw < 0x8000U ? (int32_t)raw : (int32_t)raw - 0x10000;
        if (!reader->good || !tick(replay, counts)) {
            return false;
        }
    }
    return reader->good;
}

static void end_section(struct replay *replay)
{
    if (replay->hooks.section != NULL && replay->section.name[0] != '\0') {
        replay->hooks.section(replay->hooks.context, &replay->section);
    }
    replay->section = (struct replay_section){0};
}

static void begin_section(struct replay *replay, const uint8_t *name, size_t size)
{
    end_section(replay);
    const size_t most = sizeof replay->section.name - 1U;
    memcpy(replay->section.name, name, size < most ? size : most);
}

static bool run_records(struct replay *replay, struct reader *reader)
{
    for (;;) {
        const unsigned kind = take_u8(reader);
        if (kind == TICKS) {
            if (!run_ticks(replay, reader)) {
                return false;
            }
        } else if (kind == BYTES || kind == SECTION) {
            const size_t size = take_u8(reader);
            const uint8_t *bytes = take(reader, size);
            if (bytes == NULL) {
                return false;
            }
            (kind == BYTES ? receive : begin_section)(replay, bytes, size);
        } else {
            return reader->good && kind == END;
        }
    }
}

bool replay_run(struct replay *replay, const uint8_t *file, size_t size, const struct replay_hooks *hooks)
{
    const struct sim_rig_config rig = sim_rig_defaults();
    *replay = (struct replay){.hooks = *hooks, .config = sim_rig_describe(&rig)};
    if (hb_init(&replay->device, &replay->config, 1) != HB_OK) {
        return false;
    }
    restart_count(replay);
    add_count(replay, &replay->section.ticks);
    replay->overhead = replay->section.ticks.least;
    replay->section = (struct replay_section){0};
    struct reader reader = {file, size, true};
    const uint8_t *magic = take(&reader, 4);
    if (magic == NULL || memcmp(magic, "HBR1", 4) != 0) {
        return false;
    }
    const bool good = run_records(replay, &reader);
    end_section(replay);
    return good;
}
