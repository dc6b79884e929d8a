/* Reads the golden frames: each must come out of the receiver, and be written, as it stands in the file; what the
 * device sends must be packed from its numbers into the same bytes. Usage: test_frames FILE */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "hb_frame.h"
#include "hb_messages.h"

#define BOOT 0x5eed0001U

static int faults = 0;

static void expect(int good, const char *name, const char *what)
{
    if (!good) {
        (void)printf("%s: %s\n", name, what);
        faults += 1;
    }
}

static size_t from_hex(const char *text, uint8_t *bytes)
{
    size_t size = strcmp(text, "-") == 0 ? 0U : strlen(text) / 2U;
    for (size_t i = 0U; i < size; i += 1U) {
        char pair[3] = {text[2U * i], text[2U * i + 1U], '\0'};
        bytes[i] = (uint8_t)strtoul(pair, NULL, 16);
    }
    return size;
}

static struct hb_config golden_config(void)
{
    return (struct hb_config){
        .firmware = 0xc0ffee01U, .line_rate_baud = 1000000U, .tick_rate_Hz = 1000U, .watchdog_ticks = 250U,
        .hold_ticks = 20U, .most_taps = 255U, .most_states = 12U, .capabilities = 27U, .delay_us = 376U, .continuous_force_N = 8.0F,
        .heating_s = 12.5F, .damping_N_s_per_m = 0.95F,
        .force_limit_N = 40.0F, .position_low_mm = -20.0F, .position_high_mm = 60.0F, .encoder_step_mm = 0.0127F,
        .slew_limit_N_per_s = 2000.0F, .velocity_limit_mm_per_s = 500.0F, .K0_N_per_mm = {-20.0F, 40.0F},
        .K1_N_per_mm = {0.5F, 40.0F}, .B1_N_s_alpha_per_mm = {0.0005F, 40.0F}, .alpha = {0.005F, 0.995F},
    };
}

static size_t pack_telemetry(int sensed, uint8_t *out)
{
    size_t at = sensed != 0 ? hb_pack_telemetry_head(2000U, 4U, 1U, 65535U, out)
                            : hb_pack_telemetry_head(1000U, 1U, 0U, 3U, out);
    for (int i = 0; i < (sensed != 0 ? 4 : 7); i += 1) {
        struct hb_sample sample = {(int16_t)(100 * i - 300), 257U, 0.5F * (float)i, 0.0F};
        if (sensed != 0) {
            sample = (struct hb_sample){(int16_t)(32767 - i), (uint16_t)(1 << i), 0.25F * (float)i, -0.5F * (float)i};
        }
        at += hb_pack_sample(&sample, sensed != 0, out + at);
    }
    return at;
}

/* The payload that the device would send, or HB_NO_REQUEST for a message that it does not send. */
static size_t pack(const char *name, const uint8_t *payload, size_t size, uint8_t *out)
{
    struct hb_config config = golden_config();
    struct hb_parameters set = {17U, 0U, 101U, 1000U, -3.18F, 5.58F, 7.88F, 0.176F, 12.5F};
    static uint32_t set_crc = 0U;
    if (strcmp(name, "SET_PARAMS") == 0) {
        struct hb_parameters read;
        set_crc = hb_crc32(0U, payload, size);
        expect(hb_unpack_parameters(payload, &read), name, "a reserved field is not 0");
        expect(read.set_id == set.set_id && read.memory == set.memory && read.length == set.length &&
                   read.tick_rate_Hz == set.tick_rate_Hz && read.K0_N_per_mm == set.K0_N_per_mm &&
                   read.K1_N_per_mm == set.K1_N_per_mm && read.B1_N_s_alpha_per_mm == set.B1_N_s_alpha_per_mm &&
                   read.alpha == set.alpha && read.force_limit_N == set.force_limit_N,
               name, "unpacked to other numbers");
    }
    if (strcmp(name, "HELLO_REPLY") == 0) {
        return hb_pack_hello_reply(&config, BOOT, 123400U, out);
    }
    if (strcmp(name, "LIMITS") == 0) {
        return hb_pack_limits(&config, out);
    }
    if (strcmp(name, "ACK") == 0) {
        return hb_pack_ack(HB_SET_PARAMS, 17U, set_crc, 7U, out);
    }
    if (strcmp(name, "NACK_NOT_PASSIVE") == 0) {
        struct hb_nack nack = {HB_SET_PARAMS, HB_NACK_NOT_PASSIVE, 0U, 1.34452F, 0.95F};
        return hb_pack_nack(&nack, out);
    }
    if (strcmp(name, "NACK_NOT_READY") == 0) {
        struct hb_nack nack = {HB_COMMIT, HB_NACK_NOT_READY, 412U, 0.0F, 0.0F};
        return hb_pack_nack(&nack, out);
    }
    if (strcmp(name, "STATUS") == 0) {
        uint32_t staged = (uint32_t)payload[20] | (uint32_t)payload[21] << 8 | (uint32_t)payload[22] << 16 |
                          (uint32_t)payload[23] << 24;
        struct hb_status status = {123456U, BOOT, HB_HOLDING, HB_CAUSE_WATCHDOG, HB_WARMING, 1U, 17U, 18U, set_crc,
                                   staged, 412U, 3.81F, 1.25F, -0.125F, {1U, 2U, 3U, 4U, 5U, 6U, 7U, 65535U}, 8U, 3U, 311U};
        return hb_pack_status(&status, out);
    }
    if (strcmp(name, "SET") == 0) {
        struct hb_set_reply reply = {0U, 1U, set, set_crc, 0.76288F};
        return hb_pack_set(&reply, out);
    }
    if (strcmp(name, "NOTICE") == 0) {
        struct hb_notice notice = {123457U, BOOT, HB_HOLDING, HB_CAUSE_WATCHDOG, 9U};
        return hb_pack_notice(&notice, out);
    }
    if (strcmp(name, "PULSE") == 0) {
        struct hb_notice pulse = {123458U, BOOT, HB_RUNNING, HB_CAUSE_NONE, 10U};
        return hb_pack_notice(&pulse, out);
    }
    if (strcmp(name, "TELEMETRY") == 0 || strcmp(name, "TELEMETRY_SENSED") == 0) {
        return pack_telemetry(strcmp(name, "TELEMETRY_SENSED") == 0, out);
    }
    return HB_NO_REQUEST;
}

static void check(const char *name, uint8_t type, uint8_t seq, const char *payload_hex, const char *frame_hex)
{
    uint8_t payload[256];
    uint8_t wire[256];
    uint8_t made[HB_MAX_FRAME];
    struct hb_receiver receiver = {{0U}, 0U, false, 0U};
    struct hb_frame frame;
    size_t size = from_hex(payload_hex, payload);
    size_t length = from_hex(frame_hex, wire);
    bool complete = false;
    for (size_t i = 0U; i < length; i += 1U) {
        expect(!complete, name, "complete too early");
        complete = hb_receiver_push(&receiver, wire[i], &frame);
    }
    expect(complete && frame.type == type && frame.seq == seq && frame.size == size &&
               memcmp(frame.payload, payload, size) == 0,
           name, "received as another frame");
    expect(hb_frame_write(type, seq, payload, size, made) == length && memcmp(made, wire, length) == 0, name,
           "written as other bytes");
    size_t request = hb_request_size(type, payload, size);
    expect(request == (type < 0x40U ? size : HB_NO_REQUEST), name, "another length is expected");
    size_t packed = pack(name, payload, size, made);
    expect(packed == HB_NO_REQUEST || (packed == size && memcmp(made, payload, size) == 0), name,
           "packed to other bytes");
}

int main(int count, char **arguments)
{
    char name[64];
    char payload[512];
    char wire[512];
    unsigned type = 0U;
    unsigned seq = 0U;
    int lines = 0;
    FILE *file = count == 2 ? fopen(arguments[1], "r") : NULL;
    if (file == NULL) {
        (void)printf("usage: test_frames FILE\n");
        return 2;
    }
    while (fscanf(file, "%63s %2x %2x %511s %511s", name, &type, &seq, payload, wire) == 5) {
        check(name, (uint8_t)type, (uint8_t)seq, payload, wire);
        lines += 1;
    }
    (void)fclose(file);
    (void)printf("%d frames, %d faults\n", lines, faults);
    return faults == 0 && lines > 0 ? 0 : 1;
}
