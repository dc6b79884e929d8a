"""The device's frames in raw bytes, written from PROTOCOL.md alone: an oracle beside hilbo and the C core."""

import struct
import zlib
from typing import NamedTuple

__all__ = ["MOST_ENCODED", "Answer", "Type", "decode", "encode", "set_crc", "set_params", "set_states"]

MOST_ENCODED = 71  # bytes of a frame before its 0x00


class Type:
    """Numbers of the messages."""

    HELLO, SET_PARAMS, SET_STATES, COMMIT, ABORT, GET_STATUS, GET_SET, GET_LIMITS = range(0x01, 0x09)
    START, STOP, ESTOP, CLEAR, STREAM, HEARTBEAT, DRIVE, ECHO, HOME = range(0x09, 0x12)
    HELLO_REPLY, LIMITS, ACK, NACK, STATUS, SET, NOTICE, TELEMETRY, ECHO_REPLY, PULSE = range(0x41, 0x4B)


class Answer(NamedTuple):
    """The body of one frame whose CRC is right."""

    type: int
    seq: int
    payload: bytes


def encode(type: int, payload: bytes = b"", seq: int = 0) -> bytes:
    """One frame with its closing 0x00."""
    body = bytes([type, seq]) + payload
    body += struct.pack("<I", zlib.crc32(body))
    # COBS: each run of bytes that are not 0, with its length before it. No body has 254 bytes.
    return b"".join(bytes([len(run) + 1]) + run for run in body.split(b"\0")) + b"\0"


def decode(encoded: bytes) -> Answer:
    """The frame without its 0x00; ValueError where it is none."""
    runs, at = [], 0
    while at < len(encoded):
        runs.append(encoded[at + 1 : at + encoded[at]])
        at += encoded[at]
    body = b"\0".join(runs)
    if at != len(encoded) or len(body) < 6 or struct.unpack("<I", body[-4:])[0] != zlib.crc32(body[:-4]):
        raise ValueError(f"no frame: {encoded.hex()}")
    return Answer(body[0], body[1], body[2:-4])


def set_params(set_id, K0, K1, B1, alpha, *, memory=0, length=101, rate=1000, limit=20.0) -> bytes:
    """Payload of SET_PARAMS."""
    return struct.pack("<HBBHHfffff", set_id, memory, 0, length, rate, K0, K1, B1, alpha, limit)


def set_states(set_id, weight, loss) -> list[bytes]:
    """Payloads of the SET_STATES of one set, seven exponentials each."""
    pairs = list(zip(weight, loss, strict=True))
    return [
        struct.pack("<HBB", set_id, first, len(pairs[first : first + 7]))
        + b"".join(struct.pack("<ff", *pair) for pair in pairs[first : first + 7])
        for first in range(0, len(pairs), 7)
    ]


def set_crc(*payloads: bytes) -> int:
    """What COMMIT and START name a set by."""
    return zlib.crc32(b"".join(payloads))
