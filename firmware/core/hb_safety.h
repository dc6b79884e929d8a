/* The safety chain of one tick, and what it has to remember. The device calls the links in this order:
 *
 *     input check - model - passivity observer and controller - saturation - slew limit - velocity, overrun, heating
 *
 * Whatever acts is counted and flagged. Input, velocity, overrun and heating lead to HOLD, which the device decides.
 * While a model is rendered there is no force out of contact, and a force that falls is not slew-limited. */
#ifndef HB_SAFETY_H
#define HB_SAFETY_H

#include <stdbool.h>
#include <stdint.h>

#include "hb_config.h"
#include "hb_messages.h"

#ifdef __cplusplus
extern "C" {
#endif

/* What the port knows at a tick. */
struct hb_input {
    int32_t position_counts; /* of the encoder, positive into the material; 0 at the surface where it is absolute */
    bool position_valid;     /* false where the encoder gave no number: counts as bad input */
    bool overrun;            /* a tick was missed */
    bool stop_open;          /* the hardware stop is open: ESTOP, for as long as it is */
    uint32_t delay_us;       /* from when the last tick was due until its force was out */
    float sensed_N;          /* what pushes the handle towards positive positions; NaN where nothing was read.
                              * Only passed on to telemetry. */
};

/* How often each safeguard acted since the start; each stays at 65535. */
struct hb_counts {
    uint16_t input_held;
    uint16_t saturated;
    uint16_t slewed;
    uint16_t controlled;
    uint16_t holds;
    uint16_t estops;
    uint16_t overruns;
};

struct hb_safety {
    bool homed;          /* `zero_counts` is the surface */
    bool placed;         /* `zero_counts` is a position that was seen */
    int64_t zero_counts; /* what the encoder counts at position 0 */
    int32_t counts;      /* the last position that was believed, from there */
    int32_t step_counts; /* how it changed, over `step_ticks`; 0 while a position is held */
    uint16_t step_ticks;
    bool known;       /* there has been a position to compare with */
    bool lost;        /* the input was lost, and no good position has come since */
    uint16_t bad;     /* bad positions in a row */
    uint16_t loss;    /* HB_LOSS_OF_BAD more for each bad position, 1 less for each good one */
    bool touching;    /* in contact at the last tick */
    int64_t energy;   /* that went into the device during this touch, 2^-20 mJ */
    float heat_N2;    /* the square of the command, averaged over the time constant of heating */
    float heat_share; /* of one tick in that average */
    float force_N;    /* the last command */
    float ramp_N;     /* the command when HOLD or STOP began */
    uint16_t ramp_ticks; /* since then, up to hold_ticks */
    uint16_t flags;   /* of this tick, enum hb_flag */
    struct hb_counts count;
};

/* The input is lost at three bad positions in a row, and where more than one in eleven is bad for long: a position that
 * is held makes the period of control longer than the one that passivity was certified for. */
#define HB_LOSS_OF_BAD 10U
#define HB_LOSS_LIMIT 30U

/* One more, unless it is 65535. */
void hb_count_up(uint16_t *counter);

/* At boot. */
void hb_safety_begin(struct hb_safety *safety, const struct hb_config *config);

/* The handle stands at `position_mm`, which is within the stroke: from now on positions count from there. */
void hb_home(struct hb_safety *safety, const struct hb_config *config, float position_mm);

/* Believe the position, or keep the last one. False when the input is lost. */
bool hb_check_input(struct hb_safety *safety, const struct hb_config *config, const struct hb_input *input);

/* There has been a position, and the last one was good. */
bool hb_input_is_good(const struct hb_safety *safety);

/* The position that is believed (mm), and the part of it that the model sees: x >= 0. */
float hb_position_mm(const struct hb_safety *safety, const struct hb_config *config);
float hb_penetration_mm(const struct hb_safety *safety, const struct hb_config *config);
bool hb_in_contact(const struct hb_safety *safety);

/* The energy that the last command took from the hand during the last period; begins anew with every touch. */
void hb_observe(struct hb_safety *safety, const struct hb_config *config);
float hb_energy_mJ(const struct hb_safety *safety);

/* In contact: with the force added that brings a negative energy back to 0 in one period of the same motion. It adds no
 * more than the device's own damping once more, which passivity allows a sampled damper; it takes as much as there is. */
float hb_control(struct hb_safety *safety, const struct hb_config *config, float force_N);

/* More was asked for than a limit allows. */
void hb_mark_saturated(struct hb_safety *safety);

/* Within +-limit_N. */
float hb_saturate(struct hb_safety *safety, float force_N, float limit_N);

/* Within one tick's change of the last command. `expected_N` is counted against, where the device itself is about to
 * take a difference back: it differs from `force_N` by what this tick took. */
float hb_slew(struct hb_safety *safety, const struct hb_config *config, float force_N, float expected_N);

/* One tick of heating by the last command; true above the continuous limit. */
bool hb_is_too_hot(struct hb_safety *safety, const struct hb_config *config);

/* The believed position moved faster than a limit. */
bool hb_is_too_fast(const struct hb_safety *safety, const struct hb_config *config, float limit_mm_per_s);

/* Begin the way to zero force, and go one tick along it; at the end the force is 0 exactly. */
void hb_ramp_begin(struct hb_safety *safety);
float hb_ramp(struct hb_safety *safety, const struct hb_config *config);
bool hb_ramp_has_ended(const struct hb_safety *safety, const struct hb_config *config);

#ifdef __cplusplus
}
#endif

#endif
