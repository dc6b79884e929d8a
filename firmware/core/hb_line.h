/* What goes out: frames that wait for the line, and the telemetry that is being collected. */
#ifndef HB_LINE_H
#define HB_LINE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "hb_config.h"
#include "hb_frame.h"
#include "hb_messages.h"

#ifdef __cplusplus
extern "C" {
#endif

/* A ring. */
struct hb_output {
    uint8_t bytes[HB_OUTPUT_BYTES];
    size_t first;
    size_t size;
};

/*@ predicate hb_output_is_sound(struct hb_output *o) = o->first < HB_OUTPUT_BYTES && o->size <= HB_OUTPUT_BYTES; */

struct hb_stream {
    uint8_t divisor; /* 0 = off */
    uint8_t fields;  /* bit 0: with the sensed force */
    uint8_t until;   /* ticks until the next sample */
    uint8_t samples; /* collected */
    uint16_t lost;   /* samples, modulo 65536 */
    size_t size;
    uint8_t payload[HB_MAX_PAYLOAD];
};

/*@ predicate hb_stream_holds(struct hb_stream *s, integer most, integer bytes) =
      s->samples < most && (s->samples > 0 ==> s->size == HB_TELEMETRY_HEAD + s->samples * bytes);
    predicate hb_stream_is_sound(struct hb_stream *s) =
      s->fields <= 1 && (s->divisor > 0 ==> s->until > 0) &&
      (s->fields == 0 ==> hb_stream_holds(s, 7, 8)) && (s->fields == 1 ==> hb_stream_holds(s, 4, 12)); */

/* Put a whole frame in, if `spare` bytes stay free; false and nothing otherwise. */
/*@ requires \valid(output) && hb_output_is_sound(output) && \valid_read(bytes + (0 .. size - 1));
    requires \separated(output, bytes + (0 .. size - 1)) && size <= HB_MAX_FRAME && spare <= HB_OUTPUT_BYTES;
    assigns output->bytes[0 .. HB_OUTPUT_BYTES - 1], output->size;
    ensures hb_output_is_sound(output);
    ensures \result ==> output->size == \old(output->size) + size && output->size + spare <= HB_OUTPUT_BYTES;
    ensures !\result ==> output->size == \old(output->size); */
bool hb_output_put(struct hb_output *output, const uint8_t *bytes, size_t size, size_t spare);

/* Take up to `room` bytes out. */
/*@ requires \valid(output) && hb_output_is_sound(output) && \valid(bytes + (0 .. room - 1));
    requires \separated(output, bytes + (0 .. room - 1));
    assigns output->first, output->size, bytes[0 .. room - 1];
    ensures hb_output_is_sound(output);
    ensures \result <= room && \result + output->size == \old(output->size);
    ensures \result == room || output->size == 0; */
size_t hb_output_take(struct hb_output *output, uint8_t *bytes, size_t room);

/* Smallest divisor with which telemetry needs at most 80 % of the line. */
/*@ requires \valid_read(config) && config->line_rate_baud > 0 && fields <= 1;
    assigns \nothing; */
uint32_t hb_stream_smallest_divisor(const struct hb_config *config, uint8_t fields);

/* Begin with the next tick, or stop (divisor 0). What has been collected is dropped. */
/*@ requires \valid(stream) && fields <= 1;
    assigns stream->divisor, stream->fields, stream->until, stream->samples, stream->size;
    ensures hb_stream_is_sound(stream); */
void hb_stream_begin(struct hb_stream *stream, uint8_t divisor, uint8_t fields);

/* One tick: collects every divisor-th sample, and sends the frame when it is full. */
/*@ requires \valid(stream) && \valid(output) && \valid_read(sample);
    requires \separated(stream, output, sample) && hb_stream_is_sound(stream) && hb_output_is_sound(output);
    assigns *stream, output->bytes[0 .. HB_OUTPUT_BYTES - 1], output->size;
    ensures hb_stream_is_sound(stream) && hb_output_is_sound(output); */
void hb_stream_tick(struct hb_stream *stream, struct hb_output *output, uint32_t tick, const struct hb_sample *sample);

#ifdef __cplusplus
}
#endif

#endif
