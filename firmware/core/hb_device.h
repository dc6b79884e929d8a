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
 * once between two ticks. No answer is later than the call of hb_receive that took the last byte of its request. */
#ifndef HB_DEVICE_H
#define HB_DEVICE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "hb_config.h"
#include "hb_frame.h"
#include "hb_messages.h"
#include "hb_renderer.h"

/* What the port knows at a tick. */
struct hb_input {
    int32_t position_counts; /* of the encoder, 0 at the surface, positive into it */
    bool position_valid;     /* false where the encoder gave no number: counts as bad input */
    bool overrun;            /* a tick was missed, or the last one took longer than its period */
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

/* Position, energy and force as the safety chain knows them. */
struct hb_safety {
    int32_t counts;       /* the last position that was believed */
    bool known;           /* there is one */
    uint16_t bad;         /* bad positions in a row */
    int32_t step_counts;  /* from the one before to `counts` */
    int64_t energy;       /* that the hand put in during this touch, in 2^-20 mJ */
    float force_N;        /* the last command */
    float ramp_N;         /* the command when HOLD or STOP began */
    uint16_t ramp_tick;   /* ticks since */
    uint16_t flags;       /* of the last tick, enum hb_flag */
    struct hb_counts count;
};

/* DRIVE as it was asked for, and where it is. Its forces are positive towards positive positions (pressing in): the
 * opposite sign of the command, which telemetry reports. */
struct hb_drive {
    uint8_t mode;
    uint8_t shape;
    float offset;
    float amplitude;
    uint32_t period_ticks;
    uint32_t duration_ticks;
    uint32_t tick;
    float reference_mm;
    float integral_N;
};

/* Telemetry that is being collected. */
struct hb_stream {
    uint8_t divisor; /* 0 = off */
    uint8_t fields;
    uint8_t until;   /* ticks until the next sample */
    uint8_t samples; /* collected */
    uint16_t lost;   /* samples, modulo 65536 */
    size_t size;
    uint8_t payload[HB_MAX_PAYLOAD];
};

/* Frames that wait for the line: a ring. */
struct hb_output {
    uint8_t bytes[HB_OUTPUT_BYTES];
    size_t first;
    size_t size;
};

/* Owned by the caller; only hb_init and the functions below write to it, whoever likes may read. */
struct hb_device {
    const struct hb_config *config;
    uint32_t boot_id;
    uint32_t tick;
    uint8_t state; /* enum hb_state */
    uint8_t cause; /* enum hb_cause: why it holds */
    bool greeted;  /* HELLO has been said */
    bool flipped;  /* the next tick is the first of another set */
    uint32_t heartbeat_age_ticks; /* stays at watchdog_ticks */

    struct hb_renderer bank[2];
    uint8_t active;          /* bank in force; the other one is staged */
    bool in_force;           /* there is a set in force */
    uint8_t staging;         /* enum hb_staging, without READY for no contact */
    uint16_t states_known;   /* exponentials received of the staged set */
    uint32_t warm_left;      /* ticks until the staged history is warm */
    uint32_t crc[2];         /* of each bank's bytes */
    float offset_N;          /* what is left of the difference of two forces */

    struct hb_safety safety;
    struct hb_drive drive;
    struct hb_stream stream;
    struct hb_receiver receiver;
    struct hb_output output;

    bool answered; /* the last request may be repeated: its seq, CRC and answer */
    uint8_t answered_seq;
    uint32_t answered_crc;
    size_t answer_size;
    uint8_t answer[HB_MAX_FRAME];
};

/* STOPPED, without a set, and a NOTICE of the start waiting for the line. `boot_id` differs at every start (a counter
 * in flash, a random number). On an error nothing else may be called. */
enum hb_error hb_init(struct hb_device *device, const struct hb_config *config, uint32_t boot_id);

/* Take bytes from the line, up to the end of the first frame that is carried out. Returns how many were taken: all, or
 * call again with the rest. */
size_t hb_receive(struct hb_device *device, const uint8_t *bytes, size_t size);

/* Move up to `room` bytes for the line into `bytes`. Returns how many. */
size_t hb_transmit(struct hb_device *device, uint8_t *bytes, size_t room);

/* One period: the force (N) to put out until the next tick, positive towards negative positions, at most
 * force_limit_N either way, and always finite. */
float hb_tick(struct hb_device *device, const struct hb_input *input);

#endif
