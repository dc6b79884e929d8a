"""Sets tables: a CSV or Parquet file with one named parameter set in each row; the one reader of them.

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
"""What a set is in a validation, by the map that it was read from."""

_NUMBERS = ("K0", "K1", "B1", "alpha", "force_limit")
_WHOLE = ("N", "states")
_INDIVIDUAL = "individual:"
_NUMERAL = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")  # Python also reads 1_5, as 15, and nan


def read_sets(
    path: str | os.PathLike,
    needs: Sequence[str] = ("K1", "B1", "alpha"),
    levels: Mapping[str, Sequence[str]] = MappingProxyType({}),
) -> dict[str, dict[str, Any]]:
    """Each set's name and values, in the order of the file; empty cells are left out.

    `needs`: columns that every set has a value in, beside `set_id`; of these all but `source` are numbers, or one of
    their `levels`. Raises `InputError`, one sentence with file and line.
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
            raise InputError(f'{place}: set_id "{name}" stands there already; name every set once.')
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
    """Which kind of source this names: aggregate, sysid, individual, or None."""
    if text in ("aggregate", "sysid"):
        return text
    return "individual" if text.startswith(_INDIVIDUAL) and len(text) > len(_INDIVIDUAL) else None


def role_of(name: str) -> str:
    """The role in a set's name as plans give it, `[MATERIAL ][PARTICIPANT ]ROLE`; empty where it names none."""
    last = name.rpartition(" ")[2]
    return last if last in ROLES else ""


def source_of(name: str, material: str | None = None) -> str:
    """The source in a set's name as plans give it: with a role its participant's or the population's map, else
    `[MATERIAL ]aggregate` or `[MATERIAL ]individual:PARTICIPANT`. The population's where the name says none."""
    rest = name.removeprefix(f"{material} ") if material else name
    before, _, last = rest.rpartition(" ")
    if last in ROLES:
        return _INDIVIDUAL + before if before else "aggregate"
    return last if source_kind(last) else "aggregate"


def _table(path: Path, needs: str = "a sets table needs a header and a parameter set") -> tuple[list[str], Rows, bool]:
    """Column names, each row's line and cells as text, and whether a comma may be the decimal point."""
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
    """A cell as what its column holds: a number, a whole number, or text."""
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
    if comma and column in (*_WHOLE, *_NUMBERS, "T", *needs):
        text = without_decimal_comma(text)
    if column in _WHOLE:
        if not re.fullmatch(r"\d+(\.0*)?", text) or int(float(text)) < 1:
            raise InputError(f'{place}: {column} is "{text}"; it must be a whole number from 1.')
        return int(float(text))
    if column not in (*_NUMBERS, "T", *needs):
        check_text(text, column, place)
        return text
    if not _NUMERAL.fullmatch(text) or not math.isfinite(float(text)):
        raise InputError(f'{place}: {column} is "{text}"; it must be a finite number.')
    if column == "T" and not float(text) > 0:
        raise InputError(f'{place}: T is "{text}"; it must be a time above 0, in s.')
    return float(text)
