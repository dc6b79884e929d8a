"""The lines of a session's log, as bytes: made, and read back with every digest checked.

The first line is the header, every other an event:

    {"seq":1,"kind":"propose","time":…,"data":{…},"previous":"…","crc":"…"}

`previous` is the start of the SHA-256 of the line before, `crc` the CRC-32 of this line up to it. A last line that
lacks nothing but its newline counts; one that is cut off within is left out, and said so; a file without a whole first
line is no log yet. Any other damage is refused with its line. Neither digest has a secret, so that events are checked
for what they say too (`hilbo.session.log.replay`).
"""

import hashlib
import os
import re
import time
import zlib
from collections.abc import Mapping
from typing import Any, NamedTuple

import msgspec

from hilbo.errors import InputError
from hilbo.session.log.records import Event, Header
from hilbo.study.formats.json_file import converted, decoded

__all__ = ["FIRST", "WHY_CUT", "Read", "event_line", "event_of", "header_line", "is_unbegun", "read_lines"]

WHY_CUT = (
    "where hilbo was killed while it wrote, nothing acknowledged is missing; where this is a copy, copy the log again."
)
_WHAT = "is not what this hilbo writes"
FIRST = b'{"seq":0,"kind":"header",'
"""Beginning of every log."""
_CRC = re.compile(rb',"crc":"([0-9a-f]{8})"\}\n\Z')


class Read(NamedTuple):
    """What a log holds. `lines`: the good ones, each with its newline; `dropped`: a sentence on what follows them, or
    "" where nothing does."""

    header: Header
    events: list[Event]
    lines: list[bytes]
    dropped: str


class _Line(msgspec.Struct, forbid_unknown_fields=True):
    """A line of a log."""

    seq: int
    kind: str
    time: float
    data: dict[str, Any]
    previous: str
    crc: str


def header_line(header: Header) -> bytes:
    """The first line of a log that begins now."""
    return _line(0, "header", time.time(), msgspec.to_builtins(header), b"")


def event_line(event: Event, previous: bytes) -> bytes:
    """The line of an event after the line `previous`."""
    return _line(event.seq, event.kind, event.time, event.data, previous)


def event_of(line: bytes, place: str | os.PathLike) -> Event:
    """The event of a line, as a reader gets it. Raises InputError."""
    raw = decoded(line, _Line, str(place), _WHAT)
    return Event(seq=raw.seq, kind=raw.kind, time=raw.time, data=raw.data)


def is_unbegun(content: bytes) -> bool:
    """Whether this is the beginning of a log's first line, without its end."""
    return b"\n" not in content and content[: len(FIRST)] == FIRST[: len(content)]


def read_lines(content: bytes, path: str | os.PathLike) -> Read:
    """What a file holds. Raises InputError, with the line, where it is damaged, and where it holds no session."""
    dropped, header, events, good = "", None, [], []
    for number, line in enumerate(filter(None, re.split(rb"(?<=\n)", content)), 1):
        if not line.endswith(b"\n"):
            if number == 1 or not _fits(line + b"\n"):
                dropped = f"{path}:{number}: the last line is cut off, and is left out; {WHY_CUT}"
                break
            line += b"\n"
        raw = _checked(line, number, good[-1] if good else b"", path)
        if number == 1:
            header = converted(raw.data, Header, f"{path}:{number}", _WHAT)
        else:
            events.append(Event(seq=raw.seq, kind=raw.kind, time=raw.time, data=raw.data))
        good.append(line)
    if header is None:
        raise InputError(f"{path}: holds no session, it has no whole first line; begin it without --resume.")
    return Read(header, events, good, dropped)


def _line(seq: int, kind: str, at: float, data: Mapping[str, Any], previous: bytes) -> bytes:
    body = {"seq": seq, "kind": kind, "time": at, "data": data, "previous": _hash(previous)}
    text = msgspec.json.encode(body)[:-1]
    return text + b',"crc":"%08x"}\n' % zlib.crc32(text)


def _hash(line: bytes) -> str:
    return hashlib.sha256(line).hexdigest()[:16] if line else ""


def _checked(line: bytes, number: int, previous: bytes, path: str | os.PathLike) -> _Line:
    if not _fits(line):
        raise InputError(f"{path}:{number}: is damaged; restore the file from a copy, nothing after it can be trusted.")
    raw = decoded(line, _Line, f"{path}:{number}", _WHAT)
    if raw.seq != number - 1 or raw.previous != _hash(previous):
        raise InputError(f"{path}:{number}: does not follow the line before it; lines are missing or were changed.")
    if (number == 1) != (raw.kind == "header"):
        raise InputError(f"{path}:{number}: is no {'header' if number == 1 else 'event'}; this is no session's log.")
    return raw


def _fits(line: bytes) -> bool:
    """Whether a line is what its checksum says."""
    checksum = _CRC.search(line)
    return checksum is not None and int(checksum[1], 16) == zlib.crc32(line[: checksum.start()])
