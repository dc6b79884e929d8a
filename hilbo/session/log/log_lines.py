"""The lines of a session's log as bytes: creation, and reading with every digest checked.

The first line is the header, every other an event:

    {"seq":1,"kind":"propose","time":…,"data":{…},"previous":"…","crc":"…"}

`previous` is the start of the SHA-256 of the line before, `crc` the CRC-32 of this line up to it. A last line that is
complete but for its newline counts; an incomplete one is left out with a note; a file without a complete first line is
not a log yet. Any other damage is refused with its line number. Neither digest has a secret, so the content of events
is checked too (`hilbo.session.log.replay`).
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
    """Content of a log. `lines`: the intact ones, each with its newline; `dropped`: a sentence on an incomplete last
    line, or "" if there is none."""

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
    """Return the first line of a log, with the current time."""
    return _line(0, "header", time.time(), msgspec.to_builtins(header), b"")


def event_line(event: Event, previous: bytes) -> bytes:
    """Return the line of an event that follows the line `previous` (bytes with the newline)."""
    return _line(event.seq, event.kind, event.time, event.data, previous)


def event_of(line: bytes, place: str | os.PathLike) -> Event:
    """Decode the event in a line; its digests are not checked. Raises InputError, in which `place` names the file."""
    raw = decoded(line, _Line, str(place), _WHAT)
    return Event(seq=raw.seq, kind=raw.kind, time=raw.time, data=raw.data)


def is_unbegun(content: bytes) -> bool:
    """Whether the content of a file is empty or an incomplete first line of a log."""
    return b"\n" not in content and content[: len(FIRST)] == FIRST[: len(content)]


def read_lines(content: bytes, path: str | os.PathLike) -> Read:
    """Decode the content of a log file and check all digests; `path` is for messages.

    An incomplete last line is left out, with a sentence in `dropped`. Raises InputError, with the line, if another one
    is damaged, and if there is no complete first line.
    """
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
        raise InputError(f"{path}: contains no session, it has no complete first line; begin it without --resume.")
    return Read(header, events, good, dropped)


def _line(seq: int, kind: str, at: float, data: Mapping[str, Any], previous: bytes) -> bytes:
    """Encode a line: the fields, the hash of the line `previous`, the CRC-32, and a newline. `at`: time in s."""
    body = {"seq": seq, "kind": kind, "time": at, "data": data, "previous": _hash(previous)}
    text = msgspec.json.encode(body)[:-1]
    return text + b',"crc":"%08x"}\n' % zlib.crc32(text)


def _hash(line: bytes) -> str:
    """First 16 hex digits of the SHA-256 of a line; "" for the empty line before the first."""
    return hashlib.sha256(line).hexdigest()[:16] if line else ""


def _checked(line: bytes, number: int, previous: bytes, path: str | os.PathLike) -> _Line:
    """Decode line `number` (from 1) and check its CRC-32, sequence number, kind, and the hash of the line `previous`.
    Raises InputError."""
    if not _fits(line):
        raise InputError(f"{path}:{number}: is damaged; restore the file from a copy, nothing after it can be trusted.")
    raw = decoded(line, _Line, f"{path}:{number}", _WHAT)
    if raw.seq != number - 1 or raw.previous != _hash(previous):
        raise InputError(f"{path}:{number}: does not follow the line before it; lines are missing or were changed.")
    if (number == 1) != (raw.kind == "header"):
        raise InputError(f"{path}:{number}: is no {'header' if number == 1 else 'event'}; this is no session's log.")
    return raw


def _fits(line: bytes) -> bool:
    """Whether a line, with its newline, ends in the CRC-32 of the bytes before it."""
    checksum = _CRC.search(line)
    return checksum is not None and int(checksum[1], 16) == zlib.crc32(line[: checksum.start()])
