#include "finger.h"

#include <math.h>
#include <string.h>

static const double TWO_PI = 6.283185307179586;

static const char *const NAMES[SIM_PRESS_KINDS] = {"none", "rest", "ramp", "hold", "sine", "tap", "all"};

bool sim_press_by_name(const char *name, enum sim_press *press)
{
    for (unsigned kind = 0; kind < SIM_PRESS_KINDS; kind++) {
        if (strcmp(name, NAMES[kind]) == 0) {
            *press = (enum sim_press)kind;
            return true;
        }
    }
    return false;
}

struct sim_finger_config sim_finger_defaults(void)
{
    return (struct sim_finger_config){
        .press = SIM_PRESS_ALL,
        .stiffness_N_per_mm = 1.0,
        .damping_N_s_per_m = 10.0,
        .mass_kg = 0.01,
        .away_mm = -1.0,
        .shallow_mm = 2.0,
        .deep_mm = 8.0,
    };
}

void sim_finger_start(struct sim_finger *finger, const struct sim_finger_config *config, struct sim_random random)
{
    *finger = (struct sim_finger){
        .config = *config,
        .random = random,
        .segment = {config->away_mm, config->away_mm, 0.0, 0.0},
        .depth_mm = config->shallow_mm,
    };
}

static struct sim_segment move(const struct sim_finger *finger, double to_mm, double duration_s)
{
    return (struct sim_segment){finger->segment.to_mm, to_mm, duration_s, 0.0};
}

static struct sim_segment stay(const struct sim_finger *finger, double duration_s)
{
    return move(finger, finger->segment.to_mm, duration_s);
}

static struct sim_segment into(struct sim_finger *finger, double shortest_s, double longest_s)
{
    const struct sim_finger_config *config = &finger->config;
    finger->depth_mm = sim_random_uniform(&finger->random, config->shallow_mm, config->deep_mm);
    return move(finger, finger->depth_mm, sim_random_uniform(&finger->random, shortest_s, longest_s));
}

/* Swings between here and half way out, `periods` times at 2 Hz; ends where it began. */
static struct sim_segment swing(const struct sim_finger *finger, double periods)
{
    struct sim_segment segment = move(finger, 0.5 * finger->depth_mm, periods / 2.0);
    segment.frequency_Hz = 2.0;
    return segment;
}

static struct sim_segment next_of_all(struct sim_finger *finger)
{
    const double away_mm = finger->config.away_mm;
    switch (finger->step % 10U) {
    case 0: return into(finger, 0.2, 1.0);
    case 1: return stay(finger, sim_random_uniform(&finger->random, 0.3, 1.0));
    case 2: return swing(finger, 2.0);
    case 3: return stay(finger, 0.2);
    case 4: return move(finger, away_mm, sim_random_uniform(&finger->random, 0.15, 0.5));
    case 5: return into(finger, 0.1, 0.15); /* two taps */
    case 6: return move(finger, away_mm, 0.1);
    case 7: return into(finger, 0.1, 0.15);
    case 8: return move(finger, away_mm, 0.1);
    default: return stay(finger, sim_random_uniform(&finger->random, 0.1, 0.4));
    }
}

static struct sim_segment next_segment(struct sim_finger *finger)
{
    const double away_mm = finger->config.away_mm;
    const unsigned step = finger->step;
    switch (finger->config.press) {
    case SIM_PRESS_RAMP:
        switch (step % 4U) {
        case 0: return into(finger, 0.4, 1.0);
        case 1: return stay(finger, 0.3);
        case 2: return move(finger, away_mm, 0.4);
        default: return stay(finger, 0.2);
        }
    case SIM_PRESS_HOLD: return step == 0 ? into(finger, 0.3, 0.6) : stay(finger, 1.0);
    case SIM_PRESS_SINE: return step == 0 ? into(finger, 0.3, 0.6) : swing(finger, 1.0);
    case SIM_PRESS_TAP:
        switch (step % 3U) {
        case 0: return into(finger, 0.1, 0.15);
        case 1: return move(finger, away_mm, 0.1);
        default: return stay(finger, 0.1);
        }
    case SIM_PRESS_ALL: return next_of_all(finger);
    case SIM_PRESS_NONE:
    case SIM_PRESS_REST:
    case SIM_PRESS_KINDS: break;
    }
    return stay(finger, 1.0);
}

static struct sim_hand hand_at(const struct sim_segment *segment, double elapsed_s)
{
    const double way_mm = segment->to_mm - segment->from_mm;
    if (segment->frequency_Hz > 0.0) {
        const double rate = TWO_PI * segment->frequency_Hz;
        return (struct sim_hand){
            segment->from_mm + 0.5 * way_mm * (1.0 - cos(rate * elapsed_s)),
            0.5 * way_mm * rate * sin(rate * elapsed_s),
        };
    }
    const double u = elapsed_s / segment->duration_s;
    return (struct sim_hand){
        segment->from_mm + way_mm * u * u * u * (10.0 - u * (15.0 - 6.0 * u)),
        way_mm / segment->duration_s * 30.0 * u * u * (1.0 - u) * (1.0 - u),
    };
}

struct sim_hand sim_finger_follow(struct sim_finger *finger, double step_s)
{
    finger->elapsed_s += step_s;
    while (finger->elapsed_s >= finger->segment.duration_s) {
        finger->elapsed_s -= finger->segment.duration_s;
        const bool swung = finger->segment.frequency_Hz > 0.0;
        if (swung) {
            finger->segment.to_mm = finger->segment.from_mm;
        }
        finger->segment = next_segment(finger);
        finger->step++;
    }
    return hand_at(&finger->segment, finger->elapsed_s);
}
