#include "hb_line.h"

#define SPARE_FOR_ANSWERS (2U * HB_MAX_FRAME)

bool hb_output_put(struct hb_output *output, const uint8_t *bytes, size_t size, size_t spare)
{
    if (size + spare > HB_OUTPUT_BYTES - output->size) {
        return false;
    }
    /*@ loop invariant i <= size && output->size == \at(output->size, Pre) + i;
        loop assigns i, output->bytes[0 .. HB_OUTPUT_BYTES - 1], output->size;
        loop variant size - i; */
    for (size_t i = 0U; i < size; i += 1U) {
        output->bytes[(output->first + output->size) % HB_OUTPUT_BYTES] = bytes[i];
        output->size += 1U;
    }
    return true;
}

size_t hb_output_take(struct hb_output *output, uint8_t *bytes, size_t room)
{
    size_t taken = 0U;
    /*@ loop invariant taken <= room && taken + output->size == \at(output->size, Pre);
        loop invariant output->first < HB_OUTPUT_BYTES;
        loop assigns taken, output->first, output->size, bytes[0 .. room - 1];
        loop variant output->size; */
    while (taken < room && output->size > 0U) {
        bytes[taken] = output->bytes[output->first];
        output->first = (output->first + 1U) % HB_OUTPUT_BYTES;
        output->size -= 1U;
        taken += 1U;
    }
    return taken;
}

/*@ requires fields <= 1;
    assigns \nothing;
    ensures \result <==> fields == 1; */
static bool with_sensed(uint8_t fields)
{
    return (fields & 1U) != 0U;
}

/*@ requires fields <= 1;
    assigns \nothing;
    ensures \result == (fields == 1 ? 4 : 7); */
static uint8_t samples_a_frame(uint8_t fields)
{
    return (uint8_t)((HB_MAX_PAYLOAD - HB_TELEMETRY_HEAD) / HB_SAMPLE_SIZE(with_sensed(fields)));
}

uint32_t hb_stream_smallest_divisor(const struct hb_config *config, uint8_t fields)
{
    uint32_t samples = samples_a_frame(fields);
    uint32_t frame = HB_TELEMETRY_HEAD + samples * HB_SAMPLE_SIZE(with_sensed(fields)) + HB_MAX_FRAME - HB_MAX_PAYLOAD;
    uint64_t needed = (uint64_t)config->tick_rate_Hz * frame * 100U; /* bits a second, times 10 */
    uint64_t offered = (uint64_t)config->line_rate_baud * 8U * samples;
    return (uint32_t)((needed + offered - 1U) / offered);
}

void hb_stream_begin(struct hb_stream *stream, uint8_t divisor, uint8_t fields)
{
    stream->divisor = divisor;
    stream->fields = fields;
    stream->until = 1U;
    stream->samples = 0U;
    stream->size = 0U;
}

/*@ requires \valid(stream) && \valid(output) && \separated(stream, output) && hb_output_is_sound(output);
    requires stream->size <= HB_MAX_PAYLOAD;
    assigns stream->lost, stream->samples, stream->size, output->bytes[0 .. HB_OUTPUT_BYTES - 1], output->size;
    ensures stream->samples == 0 && hb_output_is_sound(output); */
static void send(struct hb_stream *stream, struct hb_output *output)
{
    uint8_t bytes[HB_MAX_FRAME];
    size_t size = hb_frame_write(HB_TELEMETRY, 0U, stream->payload, stream->size, bytes);
    if (!hb_output_put(output, bytes, size, SPARE_FOR_ANSWERS)) {
        stream->lost = (uint16_t)(stream->lost + stream->samples);
    }
    stream->samples = 0U;
    stream->size = 0U;
}

void hb_stream_tick(struct hb_stream *stream, struct hb_output *output, uint32_t tick, const struct hb_sample *sample)
{
    if (stream->divisor == 0U) {
        return;
    }
    stream->until = (uint8_t)(stream->until - 1U);
    if (stream->until > 0U) {
        return;
    }
    stream->until = stream->divisor;
    if (stream->samples == 0U) {
        stream->size = hb_pack_telemetry_head(tick, stream->divisor, stream->fields, stream->lost, stream->payload);
    }
    stream->size += hb_pack_sample(sample, with_sensed(stream->fields), stream->payload + stream->size);
    stream->samples = (uint8_t)(stream->samples + 1U);
    if (stream->samples >= samples_a_frame(stream->fields)) {
        send(stream, output);
    }
}
