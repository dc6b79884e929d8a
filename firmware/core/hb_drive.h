/* DRIVE: the device moves by itself. Forces here are positive inwards, towards positive positions: the opposite of the
 * command, which is what telemetry reports. */
#ifndef HB_DRIVE_H
#define HB_DRIVE_H

#include <stdbool.h>
#include <stdint.h>

#include "hb_config.h"
#include "hb_messages.h"
#include "hb_safety.h"

#ifdef __cplusplus
extern "C" {
#endif

enum hb_drive_mode { HB_DRIVE_FORCE = 0, HB_DRIVE_POSITION = 1 };
/* A nudge is a force of `offset` that ends when the handle has moved by `amplitude`: by its own work it gives a handle at
 * most their product (N mm = mJ). It is for a device whose signs nobody has checked. */
enum hb_drive_shape { HB_DRIVE_CONSTANT = 0, HB_DRIVE_TRIANGLE = 1, HB_DRIVE_STEP = 2, HB_DRIVE_NUDGE = 3 };

struct hb_drive {
    struct hb_drive_request request;
    uint32_t tick;      /* since the start */
    int32_t from_counts; /* where the handle was then */
    float reference_mm; /* mode 1: where the servo wants to be now */
    float integral_N;   /* mode 1: what its integral has come to */
    int32_t seen_counts;  /* mode 1: where the handle was when it last moved, or needed no push */
    uint16_t still_ticks; /* mode 1: how long it has been pushed there without moving */
};

/* The handle is stuck where the servo pushes with more than this part of the force limit, more than so many encoder steps
 * from where it should be, and sees it move by no more than one step in this part of a second. A servo as soft as the
 * simulated one moves a handle against 60 N/mm further than that. */
#define HB_STUCK_FORCE 0.125F
#define HB_STUCK_STEPS 128
#define HB_STUCK_PER_S 20U

/* DRIVE is held where the handle moves faster than this many times the servo's own speed. */
#define HB_DRIVEN_SPEED 3.0F

/* Its mode and shape have names. */
bool hb_drive_is_named(const struct hb_drive_request *request);

/* HB_ACCEPTED, or why not, with the number and the bound it crosses. */
enum hb_reason hb_drive_check(const struct hb_drive_request *request, const struct hb_config *config, float *value,
                              float *limit);

/* Start from where the handle is. */
void hb_drive_begin(struct hb_drive *drive, const struct hb_drive_request *request, const struct hb_config *config,
                    const struct hb_safety *safety);

bool hb_drive_has_ended(const struct hb_drive *drive, const struct hb_config *config, const struct hb_safety *safety);

/* The servo pushes and sees no movement: the encoder is stuck, or what is in the way is stronger. */
bool hb_drive_is_stuck(const struct hb_drive *drive, const struct hb_config *config);

/* The command of one tick. */
float hb_drive_step(struct hb_drive *drive, const struct hb_config *config, const struct hb_safety *safety);

#ifdef __cplusplus
}
#endif

#endif
