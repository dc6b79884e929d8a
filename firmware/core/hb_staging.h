/* Two banks: how a set is received, checked, warmed up and put in force. */
#ifndef HB_STAGING_H
#define HB_STAGING_H

#include "hb_device.h"

/* What the two banks keep true: a set that is rendered, or warms up, has its indices in range; one whose exponentials
 * still come lacks some; nothing is staged while the old set has its last tick. */
/*@ predicate hb_banks_are_sound(struct hb_device *d) =
      \valid_read(d->config) && d->active <= 1 && (d->in_force == 0 || d->in_force == 1) &&
      (d->flipped == 0 || d->flipped == 1) && (d->starting == 0 || d->starting == 1) && d->staging <= HB_WARMING &&
      (d->in_force == 1 ==> hb_renderer_is_sound(&d->bank[d->active])) &&
      (d->flipped == 1 ==> hb_renderer_is_sound(&d->bank[1 - d->active]) && d->staging == HB_EMPTY) &&
      (d->staging == HB_WARMING ==> hb_renderer_is_sound(&d->bank[1 - d->active])) &&
      (d->staging == HB_INCOMPLETE ==> d->bank[1 - d->active].set.length <= HB_MAX_STATES &&
                                       d->states_known < d->bank[1 - d->active].set.length); */

/* SET_PARAMS: check and stage. A refusal leaves nothing staged, and its numbers in `nack`. */
enum hb_reason hb_stage_parameters(struct hb_device *device, const struct hb_frame *frame, struct hb_nack *nack);

/* SET_STATES: the next exponentials of the staged set; with the last one its history begins. */
/*@ requires \valid(device) && hb_banks_are_sound(device) && \valid_read(frame) && frame->size <= HB_MAX_PAYLOAD;
    requires \separated(device, frame) && \separated(device, device->config);
    assigns device->bank[0 .. 1], device->crc[0 .. 1], device->staging, device->states_known, device->warm_left;
    ensures hb_banks_are_sound(device); */
enum hb_reason hb_stage_states(struct hb_device *device, const struct hb_frame *frame);

/* COMMIT: what is staged is in force from the next tick on. */
/*@ requires \valid(device) && hb_banks_are_sound(device) && \valid_read(confirmation) && \valid(nack);
    requires \separated(device, confirmation, nack) && \separated(device, device->config);
    requires \separated(nack, device->config);
    assigns device->bank[0 .. 1], device->flipped, device->in_force, device->active, device->staging, nack->ticks;
    ensures hb_banks_are_sound(device);
    ensures device->active != \old(device->active) ==> \old(device->staging) == HB_WARMING && device->in_force == 1; */
enum hb_reason hb_commit(struct hb_device *device, const struct hb_confirmation *confirmation, struct hb_nack *nack);

/* What STATUS says about staging; `ticks` until COMMIT is possible. */
/*@ requires \valid_read(device) && \valid(ticks) && \separated(device, ticks);
    assigns *ticks;
    ensures \result == HB_READY ==> device->staging == HB_WARMING; */
enum hb_staging hb_staging_now(const struct hb_device *device, uint32_t *ticks);

/* Ticks until the difference of two forces has been taken back, 0 if there is none. */
/*@ requires \valid_read(device) && \valid_read(device->config);
    assigns \nothing;
    ensures device->flipped == 1 ==> \result > 0; */
uint32_t hb_busy_ticks(const struct hb_device *device);

/* One tick of every history at x: the force of the set in force, of either sign. At the first tick of a new set `old_N`
 * is the force of the one before, otherwise 0. */
/*@ requires \valid(device) && hb_banks_are_sound(device) && \valid(old_N) && \separated(device, old_N);
    requires \separated(device, device->config);
    assigns device->bank[0 .. 1], device->warm_left, *old_N;
    ensures hb_banks_are_sound(device); */
float hb_render(struct hb_device *device, float x_mm, float *old_N);

#endif
