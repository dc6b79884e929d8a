"""Parsers of text from users: every exception becomes one sentence, and the size of the input is limited.

A parser meets more than syntax errors: an integer with thousands of digits is a plain `ValueError`, and deeply nested
lists end in a `RecursionError`, in the parser or in code that walks its result.
"""

import re
import tomllib
from collections.abc import Mapping

import msgspec

from hilbo.errors import InputError

__all__ = ["UNREADABLE", "check_parsed", "toml"]

UNREADABLE = (ValueError, RecursionError, msgspec.MsgspecError)
"""Exceptions of the parsers of TOML and JSON for unreadable text."""
_DEEPEST = 20  # tables and lists within each other; a study file needs 6
_BITS = 64  # of an integer, by the TOML specification


def toml(text: str, source: str) -> dict[str, object]:
    """Parse TOML text. `source`: the file, for the message. Raises `InputError` with the line of the mistake where it
    is known."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        reason, _, rest = str(error).partition(" (at line ")
        line = rest.partition(",")[0] or len(text.splitlines())
        raise InputError(f"{source}:{line}: is not valid TOML ({reason}), fix that line.") from error
    except RecursionError as error:
        raise InputError(f"{source}: nests lists or tables too deep to be read; flatten them.") from error
    except ValueError as error:
        line = _line_of_digits(text)
        raise InputError(f"{source}:{line}: has a number of too many digits; write it shorter.") from error


def check_parsed(raw: object) -> None:
    """Raise `InputError`, which begins with the key's path, for lists or tables nested more than 20 deep and
    integers of 64 bits or more."""
    pending: list[tuple[str, object, int]] = [("", raw, 0)]
    while pending:
        path, value, depth = pending.pop()
        if depth > _DEEPEST:
            raise InputError(f"{path} nests lists or tables more than {_DEEPEST} deep; flatten them.")
        if isinstance(value, Mapping):
            pending += ((f"{path}.{key}" if path else str(key), part, depth + 1) for key, part in value.items())
        elif isinstance(value, list | tuple):
            pending += ((path, part, depth + 1) for part in value)
        elif isinstance(value, int) and value.bit_length() >= _BITS:
            raise InputError(f"{path} is an integer of more than {_BITS} bits; write a smaller one.")


def _line_of_digits(text: str) -> int:
    """Number of the line with the longest run of digits."""
    lengths = [max(map(len, re.findall(r"[\d_]+", line)), default=0) for line in text.splitlines()]
    return lengths.index(max(lengths)) + 1
