/* What goes out: frames that wait for the line, and the telemetry that is being collected. */
#ifndef HB_LINE_H
#define HB_LINE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "hb_config.h"
#include "hb_frame.h"
#include "hb_messages.h"

/* A ring. */
struct hb_output {
    uint8_t bytes[HB_OUTPUT_BYTES];
    size_t first;
    size_t size;
};

struct hb_stream {
    uint8_t divisor; /* 0 = off */
    uint8_t fields;  /* bit 0: with the sensed force */
    uint8_t until;   /* ticks until the next sample */
    uint8_t samples; /* collected */
    uint16_t lost;   /* samples, modulo 65536 */
    size_t size;
    uint8_t payload[HB_MAX_PAYLOAD];
};

/* Put a whole frame in, if `spare` bytes stay free; false and nothing otherwise. */
bool hb_output_put(struct hb_output *output, const uint8_t *bytes, size_t size, size_t spare);

/* Take up to `room` bytes out. */
size_t hb_output_take(struct hb_output *output, uint8_t *bytes, size_t room);

/* Smallest divisor with which telemetry needs at most 80 % of the line. */
uint32_t hb_stream_smallest_divisor(const struct hb_config *config, uint8_t fields);

/* Begin with the next tick, or stop (divisor 0). What has been collected is dropped. */
void hb_stream_begin(struct hb_stream *stream, uint8_t divisor, uint8_t fields);

/* One tick: collects every divisor-th sample, and sends the frame when it is full. */
void hb_stream_tick(struct hb_stream *stream, struct hb_output *output, uint32_t tick, const struct hb_sample *sample);

#endif
