/* The command line of hilbo-device. */
#ifndef HOST_OPTIONS_H
#define HOST_OPTIONS_H

#include <stdbool.h>
#include <stdint.h>

#include "rig.h"

struct options {
    struct sim_rig_config rig;
    uint32_t boot_id; /* 0: a new one at each start */
    bool lockstep;    /* ticks when stdin asks for them, instead of at 1 kHz */
    bool strict;      /* a late tick is an overrun */
    bool control;     /* commands on stdin; its end ends the process */
    bool help;
    const char *link;
};

/* False, with one sentence on stderr, where an argument cannot be understood. */
bool options_read(struct options *options, int count, char **arguments);

/* What --help prints. */
extern const char OPTIONS_HELP[];

#endif
