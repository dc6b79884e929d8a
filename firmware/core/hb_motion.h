/* The states, and the requests that change them.
 *
 * Orders in time: `stops` counts every STOP, ESTOP, HOLD, end of a DRIVE, opening of the hardware stop, and HOME. START,
 * DRIVE, CLEAR and HOME name the count that their sender knew, and do nothing after a later stop. RUNNING and DRIVING end
 * in a stop, CLEAR ends the stop that it names, and HOME is counted itself, so that each of these orders acts at most
 * once, whatever is lost, late or sent twice. */
#ifndef HB_MOTION_H
#define HB_MOTION_H

#include "hb_requests.h"

#ifdef __cplusplus
extern "C" {
#endif

bool hb_is_in(const struct hb_device *device, enum hb_state state);

/* Change the state, and say so with a NOTICE. A difference of two forces ends with the state. */
void hb_enter(struct hb_device *device, enum hb_state state, enum hb_cause cause);

enum hb_reason hb_start(struct hb_device *device, const struct hb_frame *frame, struct hb_reply *reply);
enum hb_reason hb_drive(struct hb_device *device, const struct hb_frame *frame, struct hb_reply *reply);
enum hb_reason hb_clear(struct hb_device *device, const struct hb_frame *frame, struct hb_reply *reply);
enum hb_reason hb_home_here(struct hb_device *device, const struct hb_frame *frame, struct hb_reply *reply);
void hb_stop(struct hb_device *device);
void hb_estop(struct hb_device *device, enum hb_cause cause);

#ifdef __cplusplus
}
#endif

#endif
