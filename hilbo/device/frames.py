"""Frames on a serial line: COBS with a terminating 0x00 and a CRC-32; independent of the messages in them.

    frame = COBS(body) 0x00,  body = type:u8 seq:u8 payload:0..64 bytes crc:u32,  crc = CRC-32 of the bytes before it

A damaged frame is dropped and counted; the next 0x00 resynchronises. Reference: Cheshire & Baker (1999), Consistent
Overhead Byte Stuffing.
"""

import zlib
from typing import NamedTuple

__all__ = ["LONGEST", "PAYLOAD", "Frame", "Receiver", "WireError", "decoded_frame", "encoded_frame"]

PAYLOAD = 64  # bytes
LONGEST = 71  # bytes of a frame without its 0x00


class WireError(ValueError):
    """A frame or payload that violates the protocol; the message describes the violation."""


class Frame(NamedTuple):
    """Type, sequence number and payload of an intact frame."""

    type: int
    seq: int
    payload: bytes


def encoded_frame(frame: Frame) -> bytes:
    """Encode a frame as bytes for the line: body, CRC-32, COBS and the final 0x00.

    Raises `WireError` for a payload of more than 64 bytes. Bodies are shorter than 254 bytes, so that COBS needs no
    long runs.
    """
    if len(frame.payload) > PAYLOAD:
        raise WireError(f"a payload of {len(frame.payload)} bytes, more than {PAYLOAD}")
    body = bytes((frame.type, frame.seq)) + frame.payload
    body += zlib.crc32(body).to_bytes(4, "little")
    return b"".join(bytes((len(run) + 1,)) + run for run in body.split(b"\0")) + b"\0"


def decoded_frame(frame: bytes) -> Frame:
    """Decode the bytes of a frame, given without its 0x00, and check its CRC-32.

    Raises `WireError` for a damaged frame: too long or short, invalid COBS, or a wrong CRC.
    """
    if len(frame) > LONGEST:
        raise WireError(f"{len(frame)} bytes without 0x00, more than {LONGEST}")
    body = _unstuffed(frame)
    if len(body) < 6:
        raise WireError(f"a body of {len(body)} bytes, less than 6")
    if zlib.crc32(body[:-4]) != int.from_bytes(body[-4:], "little"):
        raise WireError("its CRC is wrong")
    return Frame(body[0], body[1], body[2:-4])


class Receiver:
    """Split incoming bytes at each 0x00 and decode the frames; `dropped` counts the damaged ones.

    At most the bytes of one frame are buffered.
    """

    def __init__(self):
        self.dropped = 0
        self._buffer = b""

    def feed(self, data: bytes) -> list[Frame]:
        """Add received bytes and return the intact frames that they complete. Damaged frames are left out and counted
        in `dropped`; the bytes of an incomplete frame are kept for the next call."""
        *complete, rest = (self._buffer + data).split(b"\0")
        self._buffer = rest[: LONGEST + 1]  # one byte too many marks the frame as too long
        frames = []
        for frame in filter(None, complete):
            try:
                frames.append(decoded_frame(frame))
            except WireError:
                self.dropped += 1
        return frames


def _unstuffed(frame: bytes) -> bytes:
    """Remove the COBS encoding from the bytes of a frame, given without its 0x00. Raises `WireError` for invalid
    COBS."""
    runs, position = [], 0
    while position < len(frame):
        end = position + frame[position]
        if end == position or end > len(frame):
            raise WireError("no COBS: a run ends beyond the frame, or has no length")
        runs.append(frame[position + 1 : end])
        position = end
    return b"\0".join(runs)
