/* Two banks: how a set is received, checked, warmed up and put in force. */
#ifndef HB_STAGING_H
#define HB_STAGING_H

#include "hb_device.h"

#ifdef __cplusplus
extern "C" {
#endif

/* SET_PARAMS: check and stage. A refusal leaves nothing staged, and its numbers in `nack`. */
enum hb_reason hb_stage_parameters(struct hb_device *device, const struct hb_frame *frame, struct hb_nack *nack);

/* SET_STATES: the next exponentials of the staged set; with the last one its history begins. */
enum hb_reason hb_stage_states(struct hb_device *device, const struct hb_frame *frame);

/* COMMIT: what is staged is in force from the next tick on. */
enum hb_reason hb_commit(struct hb_device *device, const struct hb_confirmation *confirmation, struct hb_nack *nack);

/* What STATUS says about staging; `ticks` until COMMIT is possible. */
enum hb_staging hb_staging_now(const struct hb_device *device, uint32_t *ticks);

/* The handle's position has got another name: every history is at rest where it now is. */
void hb_rest_histories(struct hb_device *device);

/* Ticks until the difference of two forces has been taken back, 0 if there is none. */
uint32_t hb_busy_ticks(const struct hb_device *device);

/* One tick of every history at x: the force of the set in force, of either sign. At the first tick of a new set `old_N`
 * is the force of the one before, otherwise 0. */
float hb_render(struct hb_device *device, float x_mm, float *old_N);

#ifdef __cplusplus
}
#endif

#endif
