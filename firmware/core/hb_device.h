/* The device: what a port includes.
 *
 *     static const struct hb_config config = {...};      the device's own numbers
 *     static struct hb_device device;                     all of its state, owned by the port
 *
 *     hb_init(&device, &config, boot_id);
 *     once a period:  force = hb_tick(&device, &input);   first thing in the period; put `force` out at once
 *     in between:     n = hb_receive(&device, bytes, size);   bytes from the line, as they come
 *                     n = hb_transmit(&device, bytes, room);  bytes for the line, as it takes them
 *
 * One context: none of these may interrupt another on the same device (call them from one loop, or with the tick's
 * interrupt masked around the others). None waits, allocates or calls back. hb_receive returns after the first frame
 * that it carried out, so that its longest run is that of one SET_PARAMS; a port that must not be late calls it
 * once between two ticks. ESTOP acts at the next tick; a port that can cut the motor's supply looks at device->state
 * after hb_receive and does so at once. No answer is later than the call of hb_receive that took the last byte of its
 * request. */
#ifndef HB_DEVICE_H
#define HB_DEVICE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "hb_config.h"
#include "hb_delay.h"
#include "hb_drive.h"
#include "hb_frame.h"
#include "hb_line.h"
#include "hb_messages.h"
#include "hb_renderer.h"
#include "hb_safety.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Owned by the caller; only hb_init and the functions below write to it, whoever likes may read. */
struct hb_device {
    const struct hb_config *config; /* NULL where hb_init refused it: such a device gives no force and no answer */
    uint32_t boot_id;
    uint32_t tick;
    uint8_t state;                /* enum hb_state */
    uint8_t cause;                /* enum hb_cause: why it is in this state */
    bool stop_open;               /* the hardware stop, at the last tick */
    uint16_t longest_delay_us;    /* stays at 65535 */
    bool greeted;                 /* HELLO has been said */
    uint32_t heartbeat_age_ticks; /* since the last tick that the host is known to have heard; stays at watchdog_ticks */
    uint32_t stops;               /* since the start: what makes earlier orders stale (hb_motion.h) */
    uint32_t drive_crc;           /* of the request for the DRIVE that runs */

    struct hb_renderer bank[2];
    uint32_t crc[2];       /* of the bytes that each set came in */
    uint8_t active;        /* bank in force; the other one is staged */
    bool in_force;         /* there is a set in force */
    uint8_t staging;       /* enum hb_staging; READY is told by warm_left and delay_check */
    uint16_t states_known; /* exponentials of the staged set that have come */
    uint32_t warm_left;    /* ticks until the staged history is its own */
    struct hb_delay_check delay_check; /* of the staged set; done at once on a device without delay */
    bool flipped;          /* the next tick is the first of a set that follows another */
    float offset_N;        /* what is left of the difference to the force of the idle bank; 0 out of contact */

    struct hb_safety safety;
    struct hb_drive drive;
    struct hb_stream stream;
    struct hb_receiver receiver;
    struct hb_output output;

    bool answered; /* the last request, if it comes again, gets the same answer */
    uint8_t answered_seq;
    uint32_t answered_crc;
    size_t answer_size;
    uint8_t answer[HB_MAX_FRAME];
};

/* The name of hb_init holds the maxima: a port that was compiled with others than the core does not link. */
#define HB_JOIN(a, b, c) hb_init_##a##_##b##_##c
#define HB_INIT(a, b, c) HB_JOIN(a, b, c)
#define hb_init HB_INIT(HB_MAX_TAPS, HB_MAX_STATES, HB_OUTPUT_BYTES)

#if defined(__GNUC__)
#define HB_MUST_LOOK __attribute__((warn_unused_result))
#else
#define HB_MUST_LOOK
#endif

/* STOPPED, without a set, and a NOTICE of the start waiting for the line. `boot_id` differs at every start (a counter
 * in flash, a random number). On an error the device stays in ESTOP: no force, no answer. */
HB_MUST_LOOK enum hb_error hb_init(struct hb_device *device, const struct hb_config *config, uint32_t boot_id);

/* Take bytes from the line, up to the end of the first frame that is carried out. Returns how many were taken: all, or
 * call again with the rest. */
size_t hb_receive(struct hb_device *device, const uint8_t *bytes, size_t size);

/* Move up to `room` bytes for the line into `bytes`. Returns how many. */
size_t hb_transmit(struct hb_device *device, uint8_t *bytes, size_t room);

/* One period: the force (N) to put out until the next tick, positive towards negative positions, at most
 * force_limit_N either way, and always finite. */
float hb_tick(struct hb_device *device, const struct hb_input *input);

#ifdef __cplusplus
}
#endif

#endif
