"""Golden frames: every message of PROTOCOL.md with numbers of its own, made with struct and zlib and nothing of hilbo.

    python tests/vectors/make_frames.py > tests/vectors/frames.txt

One a line: name type seq payload frame, all but the name in hex, `-` for an empty payload.
"""

import struct
import zlib

SCHEMA = 0xEEF43481
BOOT = 0x5EED0001
PARAMETERS = struct.pack("<HBBHHfffff", 17, 0, 0, 101, 1000, -3.18, 5.58, 7.88, 0.176, 12.5)
FULL = struct.pack("<HBBHHfffff", 18, 1, 0, 2, 1000, 0.44, 2.0, 3.0, 0.5, 12.5)
STATES = struct.pack("<HBBffff", 18, 0, 2, 0.75, 0.9, 0.25, 0.001)
SET_CRC = zlib.crc32(PARAMETERS)

MESSAGES = [
    ("HELLO", 0x01, 0, struct.pack("<HHI", 2, 0, SCHEMA)),
    ("SET_PARAMS", 0x02, 1, PARAMETERS),
    ("SET_PARAMS_FULL", 0x02, 2, FULL),
    ("SET_STATES", 0x03, 3, STATES),
    ("SET_STATES_SEVEN", 0x03, 4, struct.pack("<HBB14f", 18, 7, 7, *(i / 8 for i in range(1, 15)))),
    ("COMMIT", 0x04, 5, struct.pack("<HHII", 17, 0, SET_CRC, BOOT)),
    ("ABORT", 0x05, 6, b""),
    ("GET_STATUS", 0x06, 7, b""),
    ("GET_SET_IN_FORCE", 0x07, 8, b"\0"),
    ("GET_SET_STAGED", 0x07, 9, b"\1"),
    ("GET_LIMITS", 0x08, 10, b""),
    ("START", 0x09, 11, struct.pack("<HHIII", 17, 0, SET_CRC, BOOT, 3)),
    ("STOP", 0x0A, 12, b""),
    ("ESTOP", 0x0B, 255, b""),
    ("CLEAR", 0x0C, 0, struct.pack("<II", BOOT, 70000)),
    ("STREAM", 0x0D, 13, struct.pack("<BB", 4, 1)),
    ("HEARTBEAT", 0x0E, 14, struct.pack("<II", BOOT, 123406)),
    ("DRIVE_FORCE", 0x0F, 15, struct.pack("<BBHffIIII", 0, 1, 0, 0.5, 2.5, 1000, 120000, BOOT, 4)),
    ("DRIVE_POSITION", 0x0F, 16, struct.pack("<BBHffIIII", 1, 2, 0, 5.0, 0.5, 3000, 6000, BOOT, 5)),
    ("ECHO", 0x10, 17, bytes(range(64))),
    ("ECHO_ZEROS", 0x10, 18, bytes(64)),
    ("ECHO_EMPTY", 0x10, 19, b""),
    ("HOME", 0x11, 20, struct.pack("<IIf", BOOT, 6, -2.5)),
    (
        "HELLO_REPLY", 0x41, 0,
        struct.pack("<HHIIIIfffffffHHHBBI", 2, 1000, SCHEMA, 0xC0FFEE01, BOOT, 1000000, 0.95, 40.0, -20.0, 60.0, 0.0127,
                    2000.0, 500.0, 250, 20, 255, 12, 27, 123400),
    ),
    ("LIMITS", 0x42, 10, struct.pack("<8fIff", -20.0, 40.0, 0.5, 40.0, 0.0005, 40.0, 0.005, 0.995, 376, 8.0, 12.5)),
    ("ACK", 0x43, 1, struct.pack("<BBHII", 0x02, 0, 17, SET_CRC, 7)),
    ("NACK_NOT_PASSIVE", 0x44, 2, struct.pack("<BBHIff", 0x02, 19, 0, 0, 1.34452, 0.95)),
    ("NACK_NOT_READY", 0x44, 5, struct.pack("<BBHIff", 0x04, 23, 0, 412, 0.0, 0.0)),
    (
        "STATUS", 0x45, 7,
        struct.pack("<IIBBBBHHIIIfffHHHHHHHHIHH", 123456, BOOT, 4, 1, 2, 1, 17, 18, SET_CRC, zlib.crc32(FULL + STATES),
                    412, 3.81, 1.25, -0.125, 1, 2, 3, 4, 5, 6, 7, 65535, 8, 3, 311),
    ),
    (
        "SET", 0x46, 8,
        struct.pack("<BBHBBHfffffIf", 0, 0, 17, 0, 1, 101, -3.18, 5.58, 7.88, 0.176, 12.5, SET_CRC, 0.76288),
    ),
    ("NOTICE", 0x47, 0, struct.pack("<IIBBHI", 123457, BOOT, 4, 1, 0, 9)),
    (
        "TELEMETRY", 0x48, 0,
        struct.pack("<IBBH", 1000, 1, 0, 3)
        + b"".join(struct.pack("<hHf", 100 * i - 300, 257, 0.5 * i) for i in range(7)),
    ),
    (
        "TELEMETRY_SENSED", 0x48, 0,
        struct.pack("<IBBH", 2000, 4, 1, 65535)
        + b"".join(struct.pack("<hHff", 32767 - i, 1 << i, 0.25 * i, -0.5 * i) for i in range(4)),
    ),
    ("ECHO_REPLY", 0x49, 17, bytes(range(64))),
    ("PULSE", 0x4A, 14, struct.pack("<IIBBHI", 123458, BOOT, 1, 0, 0, 10)),
]  # fmt: skip


def stuffed(body: bytes) -> bytes:
    """COBS, byte by byte: each run of bytes that are not 0 is led by its length + 1."""
    blocks, run = bytearray(), bytearray()
    for byte in body:
        if byte:
            run.append(byte)
        else:
            blocks += bytes([len(run) + 1]) + run
            run = bytearray()
    return bytes(blocks + bytes([len(run) + 1]) + run)


def lines() -> list[str]:
    """The file, line by line."""
    made = []
    for name, kind, seq, payload in MESSAGES:
        body = bytes([kind, seq]) + payload
        frame = stuffed(body + zlib.crc32(body).to_bytes(4, "little")) + b"\0"
        made.append(f"{name} {kind:02x} {seq:02x} {payload.hex() or '-'} {frame.hex()}")
    return made


if __name__ == "__main__":
    print("\n".join(lines()))
