"""Wire protocol of the device: conversion between messages and bytes, as specified in firmware/PROTOCOL.md.

Nothing here does I/O. `encode` converts a message to the bytes of a frame, `Receiver` extracts frames from bytes and
counts damaged ones (`frames`), `decode` converts a frame to a message. Numbers are rounded to binary32 when they are
packed.
"""

import re
import struct
from collections.abc import Iterator
from dataclasses import fields
from typing import NamedTuple, get_args, get_type_hints

from hilbo.device.frames import PAYLOAD, Frame, WireError, decoded_frame, encoded_frame
from hilbo.device.messages import (
    MESSAGES,
    VERSION,
    Echo,
    EchoReply,
    Exponential,
    Message,
    Sample,
    SetStates,
    Telemetry,
    code_of,
    name_of,
)

__all__ = ["decode", "encode", "frames_in", "payload_of", "schema_text"]

_CODES = {"u8": "B", "u16": "H", "u32": "I", "i16": "h", "f32": "f"}


class _Layout(NamedTuple):
    """Binary layout of a message: `head` packs the fields `names`.

    `tail` is the repeated field, `row` packs one of its items, `wide` one with its optional value.
    """

    head: struct.Struct
    names: tuple[str, ...]
    tail: str | None
    row: struct.Struct
    wide: struct.Struct


def _wire(kind: type) -> dict[str, str]:
    """Field name of a message class -> its wire type, such as "u16" or "n*(byte:u8)", read from the annotations."""
    hints = get_type_hints(kind, include_extras=True)
    return {field.name: get_args(hints[field.name])[1] for field in fields(kind)}


def _layout(kind: type) -> _Layout:
    """Build the `_Layout` of a message class from its annotations."""
    wire = _wire(kind)
    names = tuple(name for name, word in wire.items() if word in _CODES)
    tail = next((name for name in wire if name not in names), None)
    parts = re.findall(r"(\[?)\w+:(\w+)", wire[tail]) if tail else []
    rows = ["".join(_CODES[word] for bracket, word in parts if wide or not bracket) for wide in (False, True)]
    head = struct.Struct("<" + "".join(_CODES[wire[name]] for name in names))
    return _Layout(head, names, tail, *(struct.Struct("<" + row) for row in rows))


_LAYOUTS = {kind: _layout(kind) for kind in MESSAGES.values()}


def schema_text() -> str:
    """Return the schema block of PROTOCOL.md, generated from the message classes: the version, then a line for each
    message."""
    lines = [f"version {VERSION}"]
    for code, kind in MESSAGES.items():
        words = [word if word.startswith("n*") else f"{name}:{word}" for name, word in _wire(kind).items()]
        lines.append(" ".join([f"{code:02x} {name_of(kind):<12}", *words]).rstrip())
    return "\n".join(lines) + "\n"


def payload_of(message: Message) -> bytes:
    """Pack the fields of a message to the bytes of its payload, without a frame around them.

    Raises `WireError` for a number that does not fit its field, or a payload of more than 64 bytes.
    """
    layout = _LAYOUTS[type(message)]
    try:
        payload = layout.head.pack(*(getattr(message, name) for name in layout.names))
        if layout.tail is not None:
            payload += _rows(layout, getattr(message, layout.tail))
    except (struct.error, OverflowError) as error:
        raise WireError(f"{name_of(type(message))} cannot be packed: {error}") from error
    if len(payload) > PAYLOAD:
        raise WireError(f"{name_of(type(message))} has {len(payload)} bytes, more than the {PAYLOAD} of a payload")
    return payload


def _rows(layout, rows) -> bytes:
    """Pack the items `rows` of a message's repeated field. Bytes are returned unchanged; otherwise each item is a
    tuple, packed without its last value if that is None."""
    if isinstance(rows, bytes):
        return rows
    return b"".join(
        layout.row.pack(*row[: len(row) - 1]) if row[-1] is None else layout.wide.pack(*row) for row in rows
    )


def decode(frame: Frame) -> Message:
    """Unpack the message in a frame.

    Raises `WireError` for an unknown type, a wrong length, or a reserved field that is not 0.
    """
    if frame.type not in MESSAGES:
        raise WireError(f"type {frame.type:#04x} is not of this protocol")
    kind = MESSAGES[frame.type]
    layout, name = _LAYOUTS[kind], name_of(kind)
    head, rest = frame.payload[: layout.head.size], frame.payload[layout.head.size :]
    if len(head) < layout.head.size or (rest and layout.tail is None):
        raise WireError(f"{name} has {len(frame.payload)} bytes instead of {layout.head.size}")
    values = dict(zip(layout.names, layout.head.unpack(head), strict=True))
    if values.get("reserved"):
        raise WireError(f"{name} has a reserved field that is not 0")
    if layout.tail is not None:
        values[layout.tail] = _unpack_rows(kind, layout, values, rest)
    return kind(**values)


def _unpack_rows(kind, layout, values, rest):
    """Unpack the bytes `rest` of the repeated field of a message class `kind`, given its other fields `values`.

    Returns the bytes unchanged for an echo, else a tuple of `Exponential` (SET_STATES) or `Sample` (TELEMETRY). Raises
    `WireError` for an incomplete item, or another number of exponentials than `values` has in `count`.
    """
    if kind in (Echo, EchoReply):
        return rest
    wide = kind is Telemetry and values["fields"] & 1
    row = layout.wide if wide or kind is SetStates else layout.row
    if len(rest) % row.size or (kind is SetStates and len(rest) != values["count"] * row.size):
        raise WireError(f"{name_of(kind)} ends in the middle of what repeats")
    make = Exponential if kind is SetStates else Sample
    return tuple(make(*numbers) for numbers in row.iter_unpack(rest))


def encode(message: Message, seq: int) -> bytes:
    """Encode a message with sequence number `seq` as the bytes of a frame, including the final 0x00.

    Raises `WireError` for a number that does not fit its field, or too long a payload.
    """
    return encoded_frame(Frame(code_of(type(message)), seq, payload_of(message)))


def frames_in(capture: bytes) -> Iterator[tuple[int, Message | WireError, Frame | None]]:
    """Split captured bytes into frames and yield for each: its offset in bytes, the message or the `WireError`, and the
    `Frame` (None if it is damaged)."""
    offset = 0
    for raw in capture.split(b"\0"):
        frame = None
        if raw:
            try:
                frame = decoded_frame(raw)
                yield offset, decode(frame), frame
            except WireError as error:
                yield offset, error, frame
        offset += len(raw) + 1
