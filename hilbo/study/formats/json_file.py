"""Reading of files that hilbo itself has written: typed JSON, and a digest that shows accidental changes.

A digest is the SHA-256 of the text before it. It detects damage and careless edits; it has no secret, so that it is no
protection against forgery.
"""

import hashlib
import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec

from hilbo.errors import InputError
from hilbo.search.box import Parameter
from hilbo.study.formats.parsing import UNREADABLE

__all__ = ["Content", "check_seal", "check_values", "converted", "decoded", "digest_of", "read_bytes", "sealed"]

Content = dict[str, Any]
"""A JSON object: texts, numbers, lists and further objects by their keys."""
_SEAL = re.compile(rb',\n  "digest": "([0-9a-f]{16})"\n\}\n\Z')
_END = "\n}\n"
_SLACK = 1e-9  # of a parameter's range: what rounding may do


def read_bytes(path: str | os.PathLike) -> bytes:
    """The content of a file. Raises InputError if it cannot be read."""
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path.") from error


def decoded(content: bytes, kind: Any, source: str, what: str) -> Any:
    """Parse JSON as an object of the type `kind`. `source`: the file, `what`: the error and what to do, both for
    the message. Raises InputError if the bytes are not JSON, or not of this type."""
    try:
        return msgspec.json.decode(content, type=kind)
    except UNREADABLE as error:
        raise InputError(f"{source}: {what} ({error}).") from error


def converted(raw: Any, kind: Any, source: str, what: str) -> Any:
    """Convert parsed Python data to an object of the type `kind`. `source`: the file, `what`: the error and what to
    do, both for the message. Raises InputError if they are not of this type."""
    try:
        return msgspec.convert(raw, kind)
    except UNREADABLE as error:
        raise InputError(f"{source}: {what} ({error}).") from error


def digest_of(content: bytes) -> str:
    """First 16 hex digits of the SHA-256."""
    return hashlib.sha256(content).hexdigest()[:16]


def sealed(pieces: Iterable[str]) -> Iterator[str]:
    """Yield the text of a JSON object, given in pieces, with one more key at its end: "digest", the digest of the text
    before it. The last piece must end with a line break, "}" and a line break."""
    hashed, held = hashlib.sha256(), ""
    for piece in pieces:
        hashed.update(held.encode())
        yield held
        held = piece
    before = held.removesuffix(_END)
    hashed.update(before.encode())
    yield f'{before},\n  "digest": "{hashed.hexdigest()[:16]}"{_END}'


def check_seal(content: bytes, digest: str | None, source: str) -> None:
    """Raise InputError if `digest`, as read from the content, is not the digest of the text before it. None (a file
    without a digest) passes. Returns nothing."""
    if digest is None:
        return
    match = _SEAL.search(content)
    if match is None or match[1].decode() != digest or digest_of(content[: match.start()]) != digest:
        raise InputError(
            f"{source}: has been changed since hilbo wrote it (its digest does not fit); restore it from a copy, or"
            " make it again."
        )


def check_values(
    values: Mapping[str, float | str | None], parameters: Iterable[Parameter], source: str, what: str
) -> dict[str, float]:
    """Check a point's parameters, in physical units or as names of levels; returns parameter -> number, levels by their
    index.

    `what`: name of the point in messages. A value may exceed the range by 1e-9 of it (rounding) and is not clipped.
    Further keys are dropped. Raises InputError for a missing, non-finite or out-of-range value, or an unknown level.
    """
    checked = {}
    for parameter in parameters:
        value = values.get(parameter.name)
        if isinstance(value, str):
            if value not in parameter.levels:
                raise InputError(
                    f"{source}: {parameter.name} of {what} is {value}; it must be {parameter.range_words};"
                    " make the file again."
                )
            value = parameter.number(value)
        slack = _SLACK * (parameter.high - parameter.low)
        if value is None or not math.isfinite(value):
            raise InputError(f"{source}: {what} has no number for {parameter.name}; make the file again.")
        if not parameter.low - slack <= value <= parameter.high + slack:
            raise InputError(
                f"{source}: {parameter.name} of {what} is {value:g}; it must be from {parameter.low:g} to"
                f" {parameter.high:g} {parameter.unit}".rstrip()
                + ", the study's range; make the file again."
            )
        if parameter.levels and value != round(value):
            raise InputError(
                f"{source}: {parameter.name} of {what} is {value}, which is no level; make the file again."
            )
        checked[parameter.name] = float(value)
    return checked
