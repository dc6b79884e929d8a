/* The schema of PROTOCOL.md in C: numbers with names, one struct a message, and the bytes of each. */
#ifndef HB_MESSAGES_H
#define HB_MESSAGES_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define HB_PROTOCOL_VERSION 1U
#define HB_SCHEMA_CRC 0x00000000U /* CRC-32 of the schema block; a test compares it with PROTOCOL.md */

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
    HB_HELLO_REPLY = 0x41,
    HB_LIMITS = 0x42,
    HB_ACK = 0x43,
    HB_NACK = 0x44,
    HB_STATUS = 0x45,
    HB_SET = 0x46,
    HB_NOTICE = 0x47,
    HB_TELEMETRY = 0x48,
    HB_ECHO_REPLY = 0x49
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
    HB_CAUSE_BOOT = 8
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
    HB_NACK_DRIVE_RANGE = 29
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

#endif
