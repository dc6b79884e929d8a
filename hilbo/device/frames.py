"""Frames on a serial line: COBS with 0x00 at the end and a CRC-32 inside. Knows no messages.

    frame = COBS(body) 0x00,  body = type:u8 seq:u8 payload:0..64 bytes crc:u32,  crc = CRC-32 of what is before it

A damaged frame is dropped and counted, and the next 0x00 starts afresh.
Reference: Cheshire & Baker (1999), Consistent Overhead Byte Stuffing.
"""

import zlib
from typing import NamedTuple

__all__ = ["LONGEST", "PAYLOAD", "Frame", "Receiver", "WireError", "closed", "opened"]

PAYLOAD = 64  # bytes
LONGEST = 71  # bytes of a frame without its 0x00


class WireError(ValueError):
    """A frame or a payload that is not of this protocol; the message says in which way."""


class Frame(NamedTuple):
    """A body that came through whole."""

    type: int
    seq: int
    payload: bytes


def closed(frame: Frame) -> bytes:
    """The bytes of a frame, its 0x00 included. Runs are shorter than COBS's 254 bytes, because bodies are."""
    if len(frame.payload) > PAYLOAD:
        raise WireError(f"a payload of {len(frame.payload)} bytes, more than {PAYLOAD}")
    body = bytes((frame.type, frame.seq)) + frame.payload
    body += zlib.crc32(body).to_bytes(4, "little")
    return b"".join(bytes((len(run) + 1,)) + run for run in body.split(b"\0")) + b"\0"


def opened(frame: bytes) -> Frame:
    """What is in a frame without its 0x00. Raises `WireError` for one that is damaged."""
    if len(frame) > LONGEST:
        raise WireError(f"{len(frame)} bytes without 0x00, more than {LONGEST}")
    body = _unstuffed(frame)
    if len(body) < 6:
        raise WireError(f"a body of {len(body)} bytes, less than 6")
    if zlib.crc32(body[:-4]) != int.from_bytes(body[-4:], "little"):
        raise WireError("its CRC is wrong")
    return Frame(body[0], body[1], body[2:-4])


class Receiver:
    """Collects bytes up to each 0x00 and yields the frames that came through; `dropped` counts the others.

    Whatever arrives, it holds at most a frame's bytes, and the next 0x00 starts afresh.
    """

    def __init__(self):
        self.dropped = 0
        self._held = b""

    def feed(self, data: bytes) -> list[Frame]:
        """The frames that these bytes complete."""
        *whole, rest = (self._held + data).split(b"\0")
        self._held = rest[: LONGEST + 1]  # one byte too many is enough to know that it is too long
        frames = []
        for frame in filter(None, whole):
            try:
                frames.append(opened(frame))
            except WireError:
                self.dropped += 1
        return frames


def _unstuffed(frame: bytes) -> bytes:
    """The body in a frame without its 0x00."""
    runs, place = [], 0
    while place < len(frame):
        end = place + frame[place]
        if end > len(frame):
            raise WireError("no COBS: a run ends beyond the frame")
        runs.append(frame[place + 1 : end])
        place = end
    return b"\0".join(runs)
