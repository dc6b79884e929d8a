/* A finger that presses: where the hand wants to be, as a seeded sequence of segments.
 *
 * The hand moves along `sim_finger_follow`; between hand and handle is a spring and a damper, and the fingertip's mass
 * goes with the handle (see world.h). Moves have the profile of least jerk, and every segment starts and ends at
 * rest, so that the hand's velocity never jumps. */
#ifndef SIM_FINGER_H
#define SIM_FINGER_H

#include <stdbool.h>

#include "random.h"

enum sim_press {
    SIM_PRESS_NONE, /* nothing touches the device */
    SIM_PRESS_REST, /* the finger lies on the handle and the hand does not move */
    SIM_PRESS_RAMP, /* in, a short stay, out */
    SIM_PRESS_HOLD, /* in, and stays for good */
    SIM_PRESS_SINE, /* in, then 2 Hz for good */
    SIM_PRESS_TAP,  /* quick presses, one after another */
    SIM_PRESS_ALL,  /* ramps, stays, 2 Hz, taps and pauses, in turn */
    SIM_PRESS_KINDS
};

struct sim_finger_config {
    enum sim_press press;
    double stiffness_N_per_mm;
    double damping_N_s_per_m;
    double mass_kg;
    double away_mm;    /* where the hand waits, out of contact */
    double shallow_mm; /* depths are drawn between these two; where the hand goes, not the handle */
    double deep_mm;
};

struct sim_segment {
    double from_mm;
    double to_mm;
    double duration_s;
    double frequency_Hz; /* 0: a move from one to the other; else swings between them, whole periods */
};

struct sim_finger {
    struct sim_finger_config config;
    struct sim_random random;
    struct sim_segment segment;
    double elapsed_s; /* within the segment */
    unsigned step;    /* number of the segment */
    double depth_mm;
};

struct sim_hand {
    double position_mm;
    double velocity_mm_per_s;
};

/* "none", "rest", "ramp", "hold", "sine", "tap", "all"; false where the name is none of them. */
bool sim_press_by_name(const char *name, enum sim_press *press);

struct sim_finger_config sim_finger_defaults(void);

void sim_finger_start(struct sim_finger *finger, const struct sim_finger_config *config, struct sim_random random);

/* The hand after `step_s` more. */
struct sim_hand sim_finger_follow(struct sim_finger *finger, double step_s);

#endif
