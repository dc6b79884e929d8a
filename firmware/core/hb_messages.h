/* The schema of PROTOCOL.md in C: numbers with names, one struct a message, and the bytes of each. */
#ifndef HB_MESSAGES_H
#define HB_MESSAGES_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "hb_config.h"
#include "hb_frame.h"
#include "hb_renderer.h"

#ifdef __cplusplus
extern "C" {
#endif

#define HB_PROTOCOL_VERSION 2U
#define HB_SCHEMA_CRC 0xeef43481U /* CRC-32 of the schema block; a test compares it with PROTOCOL.md */

enum hb_type {
    HB_HELLO = 0x01,
    HB_SET_PARAMS = 0x02,
    HB_SET_STATES = 0x03,
    HB_COMMIT = 0x04,
    HB_ABORT = 0x05,
    HB_GET_STATUS = 0x06,
    HB_GET_SET = 0x07,
    HB_GET_LIMITS = 0x08,
    HB_START = 0x09,
    HB_STOP = 0x0a,
    HB_ESTOP = 0x0b,
    HB_CLEAR = 0x0c,
    HB_STREAM = 0x0d,
    HB_HEARTBEAT = 0x0e,
    HB_DRIVE = 0x0f,
    HB_ECHO = 0x10,
    HB_HOME = 0x11,
    HB_HELLO_REPLY = 0x41,
    HB_LIMITS = 0x42,
    HB_ACK = 0x43,
    HB_NACK = 0x44,
    HB_STATUS = 0x45,
    HB_SET = 0x46,
    HB_NOTICE = 0x47,
    HB_TELEMETRY = 0x48,
    HB_ECHO_REPLY = 0x49,
    HB_PULSE = 0x4a
};

enum hb_memory { HB_SHORT = 0, HB_FULL = 1 };

enum hb_staging { HB_EMPTY = 0, HB_INCOMPLETE = 1, HB_WARMING = 2, HB_READY = 3 };

enum hb_state { HB_STOPPED = 0, HB_RUNNING = 1, HB_STOPPING = 2, HB_DRIVING = 3, HB_HOLDING = 4, HB_ESTOPPED = 5 };

/* Why the state changed (NOTICE), and why the device holds (STATUS). */
enum hb_cause {
    HB_CAUSE_NONE = 0,
    HB_CAUSE_WATCHDOG = 1,
    HB_CAUSE_INPUT = 2,
    HB_CAUSE_VELOCITY = 3,
    HB_CAUSE_OVERRUN = 4,
    HB_CAUSE_MODEL = 5,
    HB_CAUSE_ENERGY = 6,
    HB_CAUSE_ESTOP = 7,
    HB_CAUSE_BOOT = 8,
    HB_CAUSE_SWITCH = 9, /* the hardware stop is open */
    HB_CAUSE_HEAT = 10
};

/* Why a request is refused (NACK). */
enum hb_reason {
    HB_ACCEPTED = 0,
    HB_NACK_VERSION = 1,
    HB_NACK_SCHEMA = 2,
    HB_NACK_NO_HELLO = 3,
    HB_NACK_UNKNOWN_TYPE = 4,
    HB_NACK_LENGTH = 5,
    HB_NACK_RESERVED = 6,
    HB_NACK_STATE = 7,
    HB_NACK_BOOT_ID = 8,
    HB_NACK_NOT_FINITE = 9,
    HB_NACK_K0_RANGE = 10,
    HB_NACK_K1_RANGE = 11,
    HB_NACK_B1_RANGE = 12,
    HB_NACK_ALPHA_RANGE = 13,
    HB_NACK_FORCE_LIMIT = 14,
    HB_NACK_TICK_RATE = 15,
    HB_NACK_MEMORY_LENGTH = 16,
    HB_NACK_EVEN_TAPS = 17,
    HB_NACK_STATIC_STIFFNESS = 18,
    HB_NACK_NOT_PASSIVE = 19,
    HB_NACK_STATES = 20,
    HB_NACK_NOTHING_STAGED = 21,
    HB_NACK_SET_MISMATCH = 22,
    HB_NACK_NOT_READY = 23,
    HB_NACK_BUSY = 24,
    HB_NACK_NO_SET = 25,
    HB_NACK_NO_HEARTBEAT = 26,
    HB_NACK_LINE_TOO_SLOW = 27,
    HB_NACK_NOT_CAPABLE = 28,
    HB_NACK_DRIVE_RANGE = 29,
    HB_NACK_NO_INPUT = 30,
    HB_NACK_IN_CONTACT = 31,
    HB_NACK_STALE = 32,
    HB_NACK_NOT_HOMED = 33,
    HB_NACK_STOP_OPEN = 34
};

/* Flags of a telemetry sample. */
enum hb_flag {
    HB_FLAG_CONTACT = 1 << 0,
    HB_FLAG_INPUT_HELD = 1 << 1,
    HB_FLAG_SATURATED = 1 << 2,
    HB_FLAG_SLEWED = 1 << 3,
    HB_FLAG_CONTROLLED = 1 << 4,
    HB_FLAG_SWITCHING = 1 << 5,
    HB_FLAG_HOLD = 1 << 6,
    HB_FLAG_ESTOP = 1 << 7,
    HB_FLAG_RUNNING = 1 << 8,
    HB_FLAG_DRIVING = 1 << 9
};

/* Requests as structs. Unpacking reads a payload of the right length (hb_request_size) and returns whether the reserved
 * fields are 0; it judges nothing else. */
struct hb_hello {
    uint16_t version;
    uint32_t schema;
};

/* COMMIT, and START, which also names a stop */
struct hb_confirmation {
    uint16_t set_id;
    uint32_t crc;
    uint32_t boot_id;
};

/* CLEAR: which start of the device, and which stop; HEARTBEAT: which start, and the last tick that the host has heard. */
struct hb_pair {
    uint32_t boot_id;
    uint32_t second;
};

struct hb_home_request {
    uint32_t boot_id;
    uint32_t stop;
    float position_mm;
};

struct hb_states {
    uint16_t set_id;
    uint8_t first;
    uint8_t count; /* as sent; of more than 7 the first 7 are read */
    float weight[7];
    float loss[7];
};

struct hb_drive_request {
    uint8_t mode;
    uint8_t shape;
    float offset;
    float amplitude;
    uint32_t period_ticks;
    uint32_t duration_ticks;
    uint32_t boot_id;
    uint32_t stop;
};

#define HB_NO_REQUEST SIZE_MAX

/* Payload length that a request must have, given the payload itself, whose count decides for SET_STATES; HB_NO_REQUEST
 * for a type that no host sends. */
/*@ requires \valid_read(payload + (0 .. size - 1)) && size <= HB_MAX_PAYLOAD;
    assigns \nothing;
    ensures \result <= HB_MAX_PAYLOAD || \result == HB_NO_REQUEST; */
size_t hb_request_size(uint8_t type, const uint8_t *payload, size_t size);

/*@ requires \valid_read(payload + (0 .. 7)) && \valid(hello);
    assigns *hello; */
bool hb_unpack_hello(const uint8_t *payload, struct hb_hello *hello);
/*@ requires \valid_read(payload + (0 .. 27)) && \valid(set);
    assigns *set; */
bool hb_unpack_parameters(const uint8_t *payload, struct hb_parameters *set);
/*@ requires \valid_read(payload + (0 .. 59)) && \valid(states) && \separated(payload + (0 .. 59), states);
    assigns *states; */
void hb_unpack_states(const uint8_t *payload, struct hb_states *states);
/*@ requires \valid_read(payload + (0 .. 11)) && \valid(confirmation);
    assigns *confirmation; */
bool hb_unpack_confirmation(const uint8_t *payload, struct hb_confirmation *confirmation);
/*@ requires \valid_read(payload + (0 .. 27)) && \valid(drive);
    assigns *drive; */
bool hb_unpack_drive(const uint8_t *payload, struct hb_drive_request *drive);
/*@ requires \valid_read(payload + (0 .. 3));
    assigns \nothing; */
uint32_t hb_unpack_stop(const uint8_t *payload); /* the last four bytes of START */
/*@ requires \valid_read(payload + (0 .. 7)) && \valid(pair);
    assigns *pair; */
void hb_unpack_pair(const uint8_t *payload, struct hb_pair *pair);
/*@ requires \valid_read(payload + (0 .. 11)) && \valid(home) && \separated(payload + (0 .. 11), home);
    assigns *home; */
void hb_unpack_home(const uint8_t *payload, struct hb_home_request *home);

#define HB_TELEMETRY_HEAD 8U
#define HB_SAMPLE_SIZE(with_sensed) ((with_sensed) ? 12U : 8U)

/* What the device sends. Packing fills a payload, and returns its length. */
struct hb_nack {
    uint8_t request;
    uint8_t reason;
    uint32_t ticks;
    float value;
    float limit;
};

struct hb_status {
    uint32_t tick;
    uint32_t boot_id;
    uint8_t state;
    uint8_t hold_reason;
    uint8_t staging;
    uint8_t contact;
    uint16_t active_id;
    uint16_t staged_id;
    uint32_t active_crc;
    uint32_t staged_crc;
    uint32_t ticks_until_ready;
    float position_mm;
    float force_N;
    float energy_mJ;
    uint16_t counts[8]; /* in the order of the schema */
    uint32_t stops;
    uint16_t flags;    /* 1 homed, 2 the hardware stop is open */
    uint16_t delay_us; /* longest so far */
};

struct hb_set_reply {
    uint8_t bank;
    uint8_t flags;
    struct hb_parameters set;
    uint32_t crc;
    float minimum_damping_N_s_per_m;
};

/* NOTICE, and PULSE, which answers a heartbeat */
struct hb_notice {
    uint32_t tick;
    uint32_t boot_id;
    uint8_t state;
    uint8_t reason;
    uint32_t stops;
};

struct hb_sample {
    int16_t position_counts;
    uint16_t flags;
    float force_N;
    float sensed_N;
};

/*@ requires \valid(payload + (0 .. 59)) && \valid_read(config);
    assigns payload[0 .. 59];
    ensures \result == 60; */
size_t hb_pack_hello_reply(const struct hb_config *config, uint32_t boot_id, uint32_t tick, uint8_t *payload);
/*@ requires \valid(payload + (0 .. 43)) && \valid_read(config);
    assigns payload[0 .. 43];
    ensures \result == 44; */
size_t hb_pack_limits(const struct hb_config *config, uint8_t *payload);
/*@ requires \valid(payload + (0 .. 11));
    assigns payload[0 .. 11];
    ensures \result == 12; */
size_t hb_pack_ack(uint8_t request, uint16_t set_id, uint32_t crc, uint32_t stops, uint8_t *payload);
/*@ requires \valid(payload + (0 .. 15)) && \valid_read(nack);
    assigns payload[0 .. 15];
    ensures \result == 16; */
size_t hb_pack_nack(const struct hb_nack *nack, uint8_t *payload);
/*@ requires \valid(payload + (0 .. 63)) && \valid_read(status);
    assigns payload[0 .. 63];
    ensures \result == 64; */
size_t hb_pack_status(const struct hb_status *status, uint8_t *payload);
/*@ requires \valid(payload + (0 .. 35)) && \valid_read(reply);
    assigns payload[0 .. 35];
    ensures \result == 36; */
size_t hb_pack_set(const struct hb_set_reply *reply, uint8_t *payload);
/*@ requires \valid(payload + (0 .. 15)) && \valid_read(notice);
    assigns payload[0 .. 15];
    ensures \result == 16; */
size_t hb_pack_notice(const struct hb_notice *notice, uint8_t *payload);
/*@ requires \valid(payload + (0 .. 7));
    assigns payload[0 .. 7];
    ensures \result == 8; */
size_t hb_pack_telemetry_head(uint32_t tick, uint8_t divisor, uint8_t fields, uint16_t lost, uint8_t *payload);
/*@ requires \valid_read(sample) && \valid(payload + (0 .. HB_SAMPLE_SIZE(with_sensed) - 1));
    assigns payload[0 .. HB_SAMPLE_SIZE(with_sensed) - 1];
    ensures \result == HB_SAMPLE_SIZE(with_sensed); */
size_t hb_pack_sample(const struct hb_sample *sample, bool with_sensed, uint8_t *payload);

#ifdef __cplusplus
}
#endif

#endif
