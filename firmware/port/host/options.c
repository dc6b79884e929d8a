#include "options.h"

#include <errno.h>
#include <float.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

const char OPTIONS_HELP[] =
    "usage: hilbo-device [options]\n"
    "A simulated device on a pseudo-terminal, whose name is the first line of output.\n"
    "  --link PATH         also make a symbolic link to it\n"
    "  --rate R            realtime (default): 1 kHz; lockstep: ticks when stdin says \"tick N\"\n"
    "  --control           commands on stdin (implied by lockstep); the end of stdin ends the process:\n"
    "                        tick N      lockstep: run N ticks; answers \"tick\", the device's tick, its force (N),\n"
    "                                    and the ticks since the last heartbeat, up to the watchdog's\n"
    "                        restart     the device loses power and starts again; answers with its boot id\n"
    "                        bad N       the next N positions are no numbers\n"
    "                        late N      the next N ticks are reported as overruns\n"
    "                        late_us N   the force of the next tick comes N us later than the delay\n"
    "                        stop open   the hardware stop opens: no force reaches the handle\n"
    "                        stop closed it closes again\n"
    "                        finger KIND another finger, from the beginning\n"
    "  --strict            a late tick of this process is an overrun and holds the device\n"
    "  --seed N            of finger and noise (0)\n"
    "  --boot-id N         instead of a new one\n"
    "  --finger KIND       none, rest, ramp, hold, sine, tap, all (default)\n"
    "  --depth LOW,HIGH    how deep the hand goes, mm (2,8)\n"
    "  --hand K,B,M        stiffness N/mm, damping N.s/m, mass kg (1,10,0.01)\n"
    "  --material K0,K1,B1,ALPHA,N   a material instead of a finger (N/mm, N/mm, N.s^alpha/mm, -, taps)\n"
    "  --damping B         of the actuator, N.s/m (0.95)\n"
    "  --coulomb F         friction, N (0.02)\n"
    "  --mass M            kg (0.3)\n"
    "  --start X           position at the start, mm (-1)\n"
    "  --noise S           of the force sensor, N (0)\n"
    "  --no-sensor         no force sensor\n"
    "  --delay US          from a due tick to its force, a multiple of 50 up to 1000 us (0)\n"
    "  --not-homed         an encoder that is not absolute: the position is unknown until HOME\n"
    "  --inverted          the motor is wired the other way\n"
    "  --encoder-inverted  the encoder counts the other way\n"
    "  --line-rate BAUD    what the device says its line carries (921600)\n";

enum { MOST_NUMBERS = 5 };

/* `count` finite numbers between commas. */
static bool numbers(const char *text, double *values, int count)
{
    for (int i = 0; i < count; i++) {
        char *end = NULL;
        values[i] = strtod(text, &end);
        if (end == text || !isfinite(values[i]) || *end != (i + 1 < count ? ',' : '\0')) {
            return false;
        }
        text = end + 1;
    }
    return true;
}

static bool whole(const char *text, uint64_t most, uint64_t *value)
{
    char *end = NULL;
    errno = 0;
    const unsigned long long found = strtoull(text, &end, 0);
    *value = (uint64_t)found;
    return end != text && *end == '\0' && text[0] != '-' && errno == 0 && *value <= most;
}

static bool number_within(const char *text, double low, double high, double *value)
{
    return numbers(text, value, 1) && *value >= low && *value <= high;
}

static bool read_hand(struct options *options, const char *text)
{
    double values[MOST_NUMBERS];
    if (!numbers(text, values, 3) || values[0] < 0.0 || values[1] < 0.0 || values[2] < 0.0) {
        return false;
    }
    options->rig.world.finger.stiffness_N_per_mm = values[0];
    options->rig.world.finger.damping_N_s_per_m = values[1];
    options->rig.world.finger.mass_kg = values[2];
    return true;
}

static bool read_depth(struct options *options, const char *text)
{
    double values[MOST_NUMBERS];
    if (!numbers(text, values, 2) || values[0] > values[1]) {
        return false;
    }
    options->rig.world.finger.shallow_mm = values[0];
    options->rig.world.finger.deep_mm = values[1];
    return true;
}

static bool read_material(struct options *options, const char *text)
{
    double values[MOST_NUMBERS];
    if (!numbers(text, values, 5) || values[4] != floor(values[4]) || fabs(values[4]) > SIM_MATERIAL_MOST_TAPS) {
        return false;
    }
    struct sim_world_config *world = &options->rig.world;
    world->has_material = true;
    world->finger.press = SIM_PRESS_NONE;
    world->material = (struct sim_material_config){values[0], values[1], values[2], values[3], (int)values[4]};
    return sim_material_valid(&world->material);
}

static bool read_whole_option(struct options *options, const char *name, const char *text, bool *known)
{
    uint64_t value = 0;
    bool good = false;
    if (strcmp(name, "--seed") == 0) {
        good = whole(text, UINT64_MAX, &value);
        options->rig.world.seed = value;
    } else if (strcmp(name, "--boot-id") == 0) {
        good = whole(text, UINT32_MAX, &value) && value > 0;
        options->boot_id = (uint32_t)value;
    } else if (strcmp(name, "--line-rate") == 0) {
        good = whole(text, UINT32_MAX, &value) && value > 0;
        options->rig.line_rate_baud = (uint32_t)value;
    } else if (strcmp(name, "--delay") == 0) {
        const struct sim_world_config *world = &options->rig.world;
        const uint64_t period_us = (uint64_t)lround(1e6 * world->tick_s);
        good = whole(text, period_us, &value) && value % (period_us / (uint64_t)world->substeps) == 0;
        options->rig.delay_us = (uint32_t)value;
    } else {
        *known = false;
    }
    return good;
}

static bool read_number_option(struct options *options, const char *name, const char *text, bool *known)
{
    struct sim_world_config *world = &options->rig.world;
    if (strcmp(name, "--damping") == 0) {
        return number_within(text, 0.0, 1000.0, &world->damping_N_s_per_m);
    }
    if (strcmp(name, "--coulomb") == 0) {
        return number_within(text, 0.0, 10.0, &world->coulomb_N);
    }
    if (strcmp(name, "--mass") == 0) {
        return number_within(text, 0.01, 100.0, &world->mass_kg);
    }
    if (strcmp(name, "--start") == 0) {
        return number_within(text, world->low_mm, world->high_mm, &world->start_mm);
    }
    if (strcmp(name, "--noise") == 0) {
        return number_within(text, 0.0, 100.0, &world->sensor_noise_N);
    }
    *known = false;
    return false;
}

static bool read_named_option(struct options *options, const char *name, const char *text, bool *known)
{
    if (strcmp(name, "--link") == 0) {
        options->link = text;
        return true;
    }
    if (strcmp(name, "--rate") == 0) {
        options->lockstep = strcmp(text, "lockstep") == 0;
        options->control = options->control || options->lockstep;
        return options->lockstep || strcmp(text, "realtime") == 0;
    }
    if (strcmp(name, "--finger") == 0) {
        return sim_press_by_name(text, &options->rig.world.finger.press);
    }
    if (strcmp(name, "--depth") == 0) {
        return read_depth(options, text);
    }
    if (strcmp(name, "--hand") == 0) {
        return read_hand(options, text);
    }
    if (strcmp(name, "--material") == 0) {
        return read_material(options, text);
    }
    *known = false;
    return false;
}

static bool read_switch(struct options *options, const char *name)
{
    if (strcmp(name, "--strict") == 0) {
        options->strict = true;
    } else if (strcmp(name, "--control") == 0) {
        options->control = true;
    } else if (strcmp(name, "--no-sensor") == 0) {
        options->rig.has_sensor = false;
    } else if (strcmp(name, "--not-homed") == 0) {
        options->rig.is_homed = false;
    } else if (strcmp(name, "--inverted") == 0) {
        options->rig.inverted = true;
    } else if (strcmp(name, "--encoder-inverted") == 0) {
        options->rig.encoder_inverted = true;
    } else if (strcmp(name, "--help") == 0) {
        options->help = true;
    } else {
        return false;
    }
    return true;
}

static bool read_value(struct options *options, const char *name, const char *text)
{
    bool (*const readers[])(struct options *, const char *, const char *, bool *) = {
        read_whole_option,
        read_number_option,
        read_named_option,
    };
    for (size_t i = 0; i < sizeof readers / sizeof readers[0]; i++) {
        bool known = true;
        const bool good = readers[i](options, name, text, &known);
        if (known) {
            if (!good) {
                (void)fprintf(stderr, "hilbo-device: %s %s makes no sense; --help says what does.\n", name, text);
            }
            return good;
        }
    }
    (void)fprintf(stderr, "hilbo-device: there is no option %s; --help lists them.\n", name);
    return false;
}

bool options_read(struct options *options, int count, char **arguments)
{
    *options = (struct options){.rig = sim_rig_defaults()};
    for (int i = 1; i < count; i++) {
        if (read_switch(options, arguments[i])) {
            continue;
        }
        if (i + 1 == count) {
            (void)fprintf(stderr, "hilbo-device: %s is no option, or lacks its value; --help lists them.\n", arguments[i]);
            return false;
        }
        if (!read_value(options, arguments[i], arguments[i + 1])) {
            return false;
        }
        i++;
    }
    return true;
}
