/* hilbo-press: parameter sets under a simulated finger, as fast as the machine can. One press a line of stdin:
 *
 *     seed ticks frame frame ...
 *
 * The frames, in hex, go to the device one before each tick, from the first tick on; the boot id is 1, and heartbeats
 * go out by themselves. For each press one line with what the device counted:
 *
 *     state nacks input_held saturated slewed controlled holds estops overruns largest_force deepest fastest contact_ticks
 *
 * Forces in N, positions in mm, velocities in mm/s. The device is the one of hilbo-device without options. */
#include <ctype.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "rig.h"

enum { LINE_SIZE = 4096, HEARTBEAT_TICKS = 50, BOOT_ID = 1 };

struct press {
    struct sim_rig rig;
    struct hb_receiver host;
    unsigned nacks;
    double largest_N;
    double deepest_mm;
    double fastest_mm_per_s;
    unsigned long contact_ticks;
};

static void give(struct press *press, const uint8_t *bytes, size_t size)
{
    for (size_t taken = 0; taken < size;) {
        taken += hb_receive(&press->rig.device, bytes + taken, size - taken);
    }
}

static void listen(struct press *press)
{
    uint8_t bytes[256];
    struct hb_frame frame;
    for (size_t size; (size = hb_transmit(&press->rig.device, bytes, sizeof bytes)) > 0;) {
        for (size_t i = 0; i < size; i++) {
            if (hb_receiver_push(&press->host, bytes[i], &frame)) {
                press->nacks += frame.type == HB_NACK ? 1U : 0U;
            }
        }
    }
}

static void send_heartbeat(struct press *press)
{
    const uint32_t tick = press->rig.device.tick; /* of a host that hears at once */
    const uint8_t payload[8] = {BOOT_ID,        0, 0, 0, (uint8_t)(tick & 255U), (uint8_t)(tick >> 8 & 255U),
                                (uint8_t)(tick >> 16 & 255U), (uint8_t)(tick >> 24)};
    uint8_t frame[HB_MAX_FRAME];
    give(press, frame, hb_frame_write(HB_HEARTBEAT, 0, payload, sizeof payload, frame));
}

/* The next word of hex, as bytes; 0 where there is none. */
static size_t next_frame(char **text, uint8_t *bytes, size_t room)
{
    size_t size = 0;
    while (**text == ' ') {
        (*text)++;
    }
    while (isxdigit((unsigned char)(*text)[0]) && isxdigit((unsigned char)(*text)[1]) && size < room) {
        const char pair[3] = {(*text)[0], (*text)[1], '\0'};
        bytes[size++] = (uint8_t)strtoul(pair, NULL, 16);
        *text += 2;
    }
    return size;
}

static void observe(struct press *press, double force_N)
{
    const struct sim_world *world = &press->rig.world;
    press->largest_N = fmax(press->largest_N, fabs(force_N));
    press->deepest_mm = fmax(press->deepest_mm, world->position_mm);
    press->fastest_mm_per_s = fmax(press->fastest_mm_per_s, fabs(world->velocity_mm_per_s));
    press->contact_ticks += world->position_mm > 0.0 ? 1U : 0U;
}

static bool run(struct press *press, uint64_t seed, unsigned long ticks, char *frames)
{
    struct sim_rig_config config = sim_rig_defaults();
    config.world.seed = seed;
    *press = (struct press){0};
    if (sim_rig_start(&press->rig, &config, BOOT_ID) != HB_OK) {
        return false;
    }
    for (unsigned long tick = 0; tick < ticks; tick++) {
        uint8_t bytes[HB_MAX_FRAME];
        if (tick % HEARTBEAT_TICKS == 0) {
            send_heartbeat(press);
        }
        give(press, bytes, next_frame(&frames, bytes, sizeof bytes));
        listen(press);
        observe(press, (double)sim_rig_tick(&press->rig));
        listen(press);
    }
    return true;
}

static void report(const struct press *press)
{
    const struct hb_device *device = &press->rig.device;
    const struct hb_counts *count = &device->safety.count;
    (void)printf("%u %u %u %u %u %u %u %u %u %.4f %.3f %.1f %lu\n", device->state, press->nacks, count->input_held,
                 count->saturated, count->slewed, count->controlled, count->holds, count->estops, count->overruns,
                 press->largest_N, press->deepest_mm, press->fastest_mm_per_s, press->contact_ticks);
}

int main(void)
{
    static struct press press;
    static char line[LINE_SIZE];
    while (fgets(line, sizeof line, stdin) != NULL) {
        char *rest = NULL;
        const uint64_t seed = strtoull(line, &rest, 10);
        const unsigned long ticks = strtoul(rest, &rest, 10);
        if (ticks == 0 || !run(&press, seed, ticks, rest)) {
            (void)fputs("hilbo-press: a line is not \"seed ticks frame frame ...\".\n", stderr);
            return 2;
        }
        report(&press);
    }
    return EXIT_SUCCESS;
}
