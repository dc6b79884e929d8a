"""Sets tables: a CSV or Parquet file with one named parameter set in each row; all sets tables are read here.

Columns: `set_id` (its name), the parameters, and optionally `source`, `role`, `material`, K0, N, T, memory, states,
force_limit and others, which are kept as text. Units: K N/mm, B1 N·s^α/mm, T s, force N. Loads no JAX: `hilbo device`
reads sets on machines that have little time for it.
"""

import math
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from hilbo.errors import InputError
from hilbo.study.formats.cell_text import check_id, check_text, without_decimal_comma
from hilbo.study.formats.csv_rows import Rows, open_csv, say_delimiter

__all__ = ["ROLES", "read_sets", "role_of", "source_kind", "source_of"]

ROLES = ("best", "mid", "worst")
"""Roles of sets in a validation: points of the map from which they were read."""

_NUMBERS = ("K0", "K1", "B1", "alpha", "force_limit")
_WHOLE = ("N", "states")
_INDIVIDUAL = "individual:"
_NUMERAL = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")  # Python also reads 1_5, as 15, and nan


def read_sets(
    path: str | os.PathLike,
    needs: Sequence[str] = ("K1", "B1", "alpha"),
    levels: Mapping[str, Sequence[str]] = MappingProxyType({}),
) -> dict[str, dict[str, Any]]:
    """Read a sets table; returns set name -> column -> value, in the order of the file, without empty cells.

    `needs`: columns in which every set must have a value, besides `set_id`; all of them but `source` are numbers, or
    one of the `levels` (column -> names). Values are numbers, whole numbers or text by their column. Raises
    `InputError`, one sentence with file and line.
    """
    source = str(path)
    columns, rows, comma = _table(Path(path))
    for name in columns:
        check_text(name, "the name of a column", f"{source}:1")
    missing = [name for name in ("set_id", *needs) if name not in columns]
    if missing:
        raise InputError(
            f'{source}:1: column "{missing[0]}" is missing; this sets table has {", ".join(("set_id", *needs))}.'
        )
    sets: dict[str, dict[str, Any]] = {}
    for line, cells in rows:
        place = f"{source}:{line}"
        given = {column: cell.strip() for column, cell in zip(columns, cells, strict=True)}
        name = given.pop("set_id")
        if not name:
            raise InputError(f"{place}: set_id is empty; name every set.")
        check_text(name, "set_id", place)
        if name in sets:
            raise InputError(f'{place}: set_id "{name}" is there already; name every set once.')
        sets[name] = {
            column: _value(column, text, needs, levels, place, comma) for column, text in given.items() if text
        }
        empty = next((column for column in needs if column not in sets[name]), None)
        if empty is not None:
            raise InputError(f'{place}: {empty} is ""; every set has one.')
    if not sets:
        raise InputError(f"{source}: has no rows; a sets table needs a parameter set.")
    return sets


def source_kind(text: str) -> str | None:
    """Kind of a set's source: "aggregate", "sysid", or "individual" for `individual:PARTICIPANT`; None for other
    text."""
    if text in ("aggregate", "sysid"):
        return text
    return "individual" if text.startswith(_INDIVIDUAL) and len(text) > len(_INDIVIDUAL) else None


def role_of(name: str) -> str:
    """Role (best, mid, worst) at the end of a set's name, which plans form as `[MATERIAL ][PARTICIPANT ]ROLE`; "" if
    there is none."""
    last = name.rpartition(" ")[2]
    return last if last in ROLES else ""


def source_of(name: str, material: str | None = None) -> str:
    """Source of a set, "aggregate" or "individual:PARTICIPANT", from its name as plans form it:
    `[MATERIAL ][PARTICIPANT ]ROLE`, or `[MATERIAL ]SOURCE` (which may be "sysid"). "aggregate" for any other name.
    `material`: name to remove from the front."""
    rest = name.removeprefix(f"{material} ") if material else name
    before, _, last = rest.rpartition(" ")
    if last in ROLES:
        return _INDIVIDUAL + before if before else "aggregate"
    return last if source_kind(last) else "aggregate"


def _table(path: Path, needs: str = "a sets table needs a header and a parameter set") -> tuple[list[str], Rows, bool]:
    """Read a file; returns column names, rows (line number, text cells), and whether a comma may be the decimal point.
    Warns about the separator if it is not a comma. Raises `InputError`."""
    if path.suffix == ".parquet":
        from hilbo.study.formats.csv_file import read_cells

        frame = read_cells(path, needs)
        return list(frame.columns), zip(frame.index, frame.to_numpy().tolist(), strict=True), False
    with open_csv(path, needs) as table:
        say_delimiter(table.delimiter, str(path))
        return table.header, iter(list(table.rows)), table.delimiter != ","


def _value(
    column: str, text: str, needs: Sequence[str], levels: Mapping[str, Sequence[str]], place: str, comma: bool
) -> Any:
    """Convert a cell to the type of its column: level, source, whole number (N, states), number or text. `place`: file
    and line. Raises `InputError`."""
    if column in levels:
        if text not in levels[column]:
            raise InputError(f'{place}: {column} is "{text}"; it must be one of {", ".join(levels[column])}.')
        return text
    if column == "source":
        if "source" in needs and source_kind(text) is None:
            raise InputError(f'{place}: source is "{text}"; it must be aggregate, sysid or individual:PARTICIPANT.')
        if text.startswith(_INDIVIDUAL):
            check_id(text.removeprefix(_INDIVIDUAL), place)
        check_text(text, "source", place)
        return text
    numeric = (*_NUMBERS, "T", *needs)
    number = column in numeric or column.removesuffix("_low").removesuffix("_high") in numeric
    if comma and (number or column in _WHOLE):
        text = without_decimal_comma(text)
    if column in _WHOLE:
        if not re.fullmatch(r"\d{1,9}(\.0*)?", text) or int(float(text)) < 1:
            raise InputError(f'{place}: {column} is "{text}"; it must be a whole number from 1.')
        return int(float(text))
    if not number:
        check_text(text, column, place)
        return text
    if not _NUMERAL.fullmatch(text) or not math.isfinite(float(text)):
        raise InputError(f'{place}: {column} is "{text}"; it must be a finite number.')
    if column == "T" and not float(text) > 0:
        raise InputError(f'{place}: T is "{text}"; it must be a time above 0, in s.')
    return float(text)
