"""The mapping file: how the columns and cells of another program's table become those of a trial table.

`hilbo import` proposes one; a user corrects it and gives it back. A name of a column may be a pattern with braces, for
tables with one row a participant: `Q{trial}` or `Q{stimulus}` names a column for each trial or stimulus, and
`hue{hue}_light{light}` has the parameters' values in the names of the columns. Loads no JAX, no pandas.
"""

import json
from collections.abc import Mapping as MappingLike
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from hilbo.errors import InputError
from hilbo.study.formats.parsing import UNREADABLE, check_parsed, toml
from hilbo.study.formats.toml_text import toml_key, toml_string

__all__ = ["FILE", "Ids", "Mapping", "mapping_of", "mapping_text", "read_mapping"]

FILE = "{file}"
"""In place of a column: the name of the file, for exports with one file a participant."""
Ids = Literal["", "as written", "normal", "code"]
"""How ids are made; "" is by what they look like."""
_LINES = {
    "tool": "program that wrote the table, as recognised",
    "header_rows": "rows before the first row of data; the first one has the names of the columns",
    "ids": '"as written"; "normal": 1.0, 01 and 1 are one participant; "code": new ids, with a list of them in a file',
    "trials_from": "number of the first trial in the table",
    "decimal": "decimal mark",
    "missing": "cells that mean a missing response",
    "keep": "further columns to copy; check them for personal data",
    "columns": "column of the trial table = column of the export",
    "rows": "only rows with one of these cells are trials",
    "responses": "cell of the export = response of the study",
    "levels": "cell of the export = level of the parameter",
    "factors": "factors from the export's unit to the study's",
    "stimuli": "stimulus of the export = its parameters",
}


class Mapping(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Rules by which a table is converted to a trial table; the comments of a mapping file explain the keys."""

    columns: dict[str, str]
    schema: Literal[1] = 1
    tool: str = ""
    header_rows: Annotated[int, msgspec.Meta(ge=1)] = 1
    ids: Ids = ""
    trials_from: int = 1
    decimal: Literal[".", ","] = "."
    missing: tuple[str, ...] = ()
    keep: tuple[str, ...] = ()
    rows: dict[str, tuple[str, ...]] = {}
    responses: dict[str, str] = {}
    levels: dict[str, dict[str, str]] = {}
    factors: dict[str, float] = {}
    stimuli: dict[str, dict[str, float | str]] = {}


def read_mapping(path: Path) -> Mapping:
    """Read a mapping file. Raises `InputError`, one sentence with the file."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path.") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not UTF-8 text; save it as UTF-8.") from error
    return mapping_of(toml(text, str(path)), str(path))


def mapping_of(raw: MappingLike[str, object], source: str) -> Mapping:
    """Convert parsed tables to a mapping. `source`: the file, for messages. Raises `InputError`."""
    try:
        check_parsed(raw)
        return msgspec.convert(dict(raw), Mapping)
    except UNREADABLE as error:
        why = str(error).replace("`$.", "`").replace("`$`", "the file")
        raise InputError(f"{source}: is no mapping for hilbo import ({why}); correct that key.") from error


def mapping_text(mapping: Mapping) -> str:
    """A mapping as the text of a TOML file with comments. Keys with the default value are left out, but for tables that
    a user may have to fill in."""
    content = msgspec.to_builtins(mapping)
    lines = ["# How `hilbo import` reads the table: correct what is wrong, then give this file with --mapping."]
    plain = {name: value for name, value in content.items() if not isinstance(value, dict)}
    lines += ["schema = 1", *(f"{name} = {_toml(plain[name])}  # {_LINES[name]}" for name in _LINES if name in plain)]
    for name in _LINES:
        if isinstance(content.get(name), dict) and (content[name] or name == "columns"):
            lines += ["", f"# {_LINES[name]}", f"[{name}]"]
            lines += [f"{toml_key(key)} = {_toml(value)}" for key, value in content[name].items()]
    return "\n".join(lines) + "\n"


def _toml(value: object) -> str:
    """A value as TOML: text, number, list, or an inline table."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{toml_key(key)} = {_toml(part)}" for key, part in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return toml_string(value) if isinstance(value, str) else json.dumps(value)
