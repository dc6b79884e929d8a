"""Conversion of parsed tables of a study file to records: every key known and of its type, every mistake one sentence
with the key's path.

A table is a `Table` (msgspec) whose annotations carry the type, the range and the words for both; a field that is
itself a `Table` is a table within the table.
"""

import json
import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import Annotated, Any, TypeVar

import msgspec

from hilbo.errors import InputError
from hilbo.study.formats.cell_text import FORMULA_WORDS, runs_in_a_spreadsheet

__all__ = [
    "Name",
    "NotNegative",
    "Number",
    "Positive",
    "Table",
    "check_keys",
    "check_present",
    "check_table",
    "enclosing",
    "lines_of",
    "missing_keys",
    "prefix",
    "read_table",
    "shown",
    "words",
]


def words(description: str, example: str) -> msgspec.Meta:
    """Annotation with the description of a valid value and an example, both used in error messages."""
    return msgspec.Meta(description=description, examples=[example])


_LONGEST = 200  # characters of a value in a sentence
Number = Annotated[float, msgspec.Meta(description="a finite number")]
Positive = Annotated[float, msgspec.Meta(gt=0, description="a number above 0")]
NotNegative = Annotated[float, msgspec.Meta(ge=0, description="a number, 0 or above")]
Name = Annotated[str, msgspec.Meta(min_length=1), words("a text", '"memory foam"')]


class Table(msgspec.Struct, frozen=True, omit_defaults=True):
    """One table of the study file."""


_T = TypeVar("_T", bound=Table)


def read_table(kind: type[_T], raw: Any, path: str) -> _T:
    """Convert a parsed table to its record. `path`: key of the table. Raises `InputError`, which begins with the path
    of the wrong key."""
    fields = {field.encode_name: field for field in msgspec.structs.fields(kind)}
    check_present(missing_keys(kind, raw, path))
    return kind(**{key: _read_field(fields[key].type, value, f"{path}.{key}") for key, value in raw.items()})


def _read_field(kind: Any, raw: Any, path: str) -> Any:
    """Convert the value of a field, which may be a table itself. Raises InputError."""
    if isinstance(kind, type) and issubclass(kind, Table):
        return read_table(kind, raw, path)
    return _read_value(kind, raw, path)


def _read_value(kind: Any, raw: Any, path: str) -> Any:
    """Convert and check a value by its annotated type; rejects non-finite numbers and text that a spreadsheet could
    run. Raises InputError with the description of the annotation."""
    try:
        value = msgspec.convert(raw, kind)
        parts = value if isinstance(value, tuple) else (value,)
        if any(isinstance(v, str) and runs_in_a_spreadsheet(v) for v in parts):
            raise InputError(f"{path} is {shown(value)}, {FORMULA_WORDS}.")
        if all(math.isfinite(v) for v in parts if isinstance(v, float)):
            return value
    except msgspec.ValidationError:
        pass  # its text speaks of types and of `$`; the schema has the words
    notes = [note for note in kind.__metadata__ if isinstance(note, msgspec.Meta)]
    must = next(note.description for note in reversed(notes) if note.description)
    example = next((f"; write for example {path.split('.')[-1]} = {n.examples[0]}" for n in notes if n.examples), "")
    raise InputError(f"{path} is {shown(raw)}; it must be {must}{example}.")


def check_keys(raw: Any, path: str, known: Iterable[str]) -> None:
    """Raise InputError if `raw` is not a table, or has a key that is not in `known`."""
    check_table(raw, path)
    dot = f"{path}." if path else ""
    for key in raw:
        if key not in known:
            raise InputError(f"{dot}{key} is not a key of a study file; known here are {', '.join(known)}.")


def missing_keys(kind: type[Table], raw: Any, path: str) -> Iterator[str]:
    """Yield the paths of required keys that a parsed table lacks, nested tables included.

    Raises `InputError`, while iterated, for a value that is no table, and for an unknown key, which may be a misspelt
    one.
    """
    fields = msgspec.structs.fields(kind)
    check_keys(raw, path, [field.encode_name for field in fields])
    for field in fields:
        key = f"{path}.{field.encode_name}"
        if field.encode_name in raw and isinstance(field.type, type) and issubclass(field.type, Table):
            yield from missing_keys(field.type, raw[field.encode_name], key)
        elif field.required and field.encode_name not in raw:
            yield key


def check_present(missing: Iterable[str], rest: str = "") -> None:
    """Raise InputError that lists these keys as missing; do nothing if there are none. `rest`: end of the message."""
    keys = list(missing)
    if keys:
        first, *others = keys
        also = f" and so {'is' if len(others) == 1 else 'are'} {', '.join(others)}" if others else ""
        raise InputError(f"{first} is missing{also}; add {'them' if others else 'it'}{rest}.")


def check_table(raw: Any, path: str) -> Mapping[str, Any]:
    """Return `raw` unchanged if it is a table. Raises InputError otherwise, and for a table name that a spreadsheet
    could run as a formula."""
    if runs_in_a_spreadsheet(path.partition(".")[2]):
        raise InputError(f"{path} has a name {FORMULA_WORDS}.")
    if not isinstance(raw, Mapping):
        raise InputError(f"{path} is {shown(raw)}; it must be a table; write it as [{path}].")
    return raw


def shown(value: Any) -> str:
    """A value as JSON for messages, cut to 200 characters."""
    text = json.dumps(value, ensure_ascii=False, default=str)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}…"


def prefix(source: str, line: int | None = None) -> str:
    """Prefix of an error message, "FILE:LINE: " or "FILE: "; "" without a file."""
    place = source if line is None else f"{source}:{line}"
    return f"{place}: " if place else ""


def enclosing(path: str, place: str) -> Iterator[str]:
    """Yield a key path and then its enclosing tables, innermost first. `place` is "" or the prefix "materials.NAME.":
    then the same path of the study itself follows."""
    parts = path.rstrip(",:").split(".")
    yield from (".".join(parts[:n]) for n in range(len(parts), len(place.split(".")) - 1 if place else 0, -1))
    if place:
        yield from enclosing(path.removeprefix(place), "")


def lines_of(text: str) -> dict[str, int]:
    """Line number (from 1) of each table header and each key at the beginning of a line in the text of a TOML file, by
    path, such as "parameters.1.low"; [[tables]] count from 1. Keys of inline tables are not listed."""
    lines, table, counts = {}, "", Counter()
    for number, line in enumerate(text.splitlines(), 1):
        if header := re.match(r"\s*\[([^\[\]]+)\]", line):
            table = _path(header[1])
            lines.setdefault(table, number)
        elif header := re.match(r"\s*\[\[([^\[\]]+)\]\]", line):  # tables of one name, called by their number
            counts[_path(header[1])] += 1
            table = f"{_path(header[1])}.{counts[_path(header[1])]}"
            lines[table] = number
        elif key := re.match(r"""\s*([\w."' -]+?)\s*=""", line):
            lines.setdefault(f"{table}.{_path(key[1])}" if table else _path(key[1]), number)
    return lines


def _path(key: str) -> str:
    """A TOML key path without its quotes and blanks."""
    return ".".join(word.strip().strip("\"'") for word in key.split("."))
