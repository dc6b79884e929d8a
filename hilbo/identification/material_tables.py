"""Material tables: CSV or Parquet, one row per sample of a creep or relaxation test.

Column names include their unit: `time_s`, `time (ms)` and `time [s]` are accepted alike. `test` is relaxation (position
applied, force measured) or creep (force applied, position measured), with `time`, `position` and `force` in every row;
`repeat` identifies repeats and `material` materials. A table of moduli has `time` and `modulus` (relaxation) or
`compliance` (creep) instead, and needs no `test`. Other columns are ignored, including one-letter names that denote
another quantity (`_quantities`). Values are converted to s, mm, N, Pa (or N/mm) and 1/Pa (or mm/N). Invalid input
raises `InputError` with file and line.
"""

import os
import re
from collections.abc import Collection, Iterable
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float

from hilbo.errors import InputError
from hilbo.identification.fitting import Test
from hilbo.study.formats.csv_file import numbers, place, read_cells, refuse
from hilbo.study.tables.trials import of_material

__all__ = ["Material", "read_material"]

_NAMES = {
    "time": ("time", "t"),
    "position": ("position", "displacement", "deformation", "indentation", "x"),
    "force": ("force", "f"),
    "modulus": ("modulus", "relaxation modulus", "g"),
    "compliance": ("compliance", "creep compliance", "j"),
}
_LETTERS = {"t", "x", "F", "G", "J"}  # the usual symbols of the quantities
_QUANTITY = {name: quantity for quantity, names in _NAMES.items() for name in names}
# Factor to the first unit of each line.
_UNITS = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0, "h": 3600.0},
    "position": {"mm": 1.0, "um": 1e-3, "cm": 10.0, "m": 1000.0},
    "force": {"N": 1.0, "mN": 1e-3, "kN": 1000.0},
    "modulus": {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9, "N/mm": 1.0, "N/m": 1e-3},
    "compliance": {"1/Pa": 1.0, "1/kPa": 1e-3, "1/MPa": 1e-6, "1/GPa": 1e-9, "mm/N": 1.0, "m/N": 1e3},
}
_OF_LENGTH = {"N/mm", "N/m", "mm/N", "m/N"}
_HEAD = re.compile(r"\s*([A-Za-z][A-Za-z ]*?)\s*(?:\[([^\]]*)\]|\(([^)]*)\)|[_ ]([^\[\]()_]+))?\s*")


class Material(NamedTuple):
    """Tests of one material, read from a table.

    `tests` in the order relaxation, creep, modulus, compliance; `stiffness_unit` of K: N/mm, or Pa for moduli in Pa;
    `notes`: how the data were changed, such as interpolation of repeats.
    """

    tests: tuple[Test, ...]
    stiffness_unit: str
    notes: tuple[str, ...]


def read_material(
    path: str | os.PathLike,
    material: str | None = None,
    *,
    begin: str = "rest",
    only: str | None = None,
    longest: float | None = None,
) -> Material:
    """Read the tests of one material from a CSV or Parquet file, in s, mm, N, Pa (or N/mm) and 1/Pa (or mm/N).

    `material`: name, needed if the table has several, without effect in one that names none; `begin`: state before the
    first row, "rest" or "equilibrium" (`fitting.Test`); `only`: kind of test to read; `longest`: read the rows up to
    this time (s). Raises `InputError` for a file that cannot be read, a column or value that is not valid, and a test
    that is not there or not usable.
    """
    source = str(path)
    text = read_cells(path, "a material table needs a header with units and the samples of a test")
    columns, units = _columns(text, source)
    if text.empty:
        raise InputError(f"{source}: has no rows; a material table needs the samples of at least one test.")
    text = of_material(text, material if "material" in text else None, source)
    values = pd.DataFrame(
        {
            q: numbers(text, c, source, "a finite number", lambda v: v == v) * _UNITS[q][units[q]]
            for q, c in columns.items()
        }
    )
    kinds = _kinds(text, columns, source)
    if only is not None and only not in set(kinds):
        raise InputError(f'{source}: contains no test "{only}"; it has {", ".join(kinds.unique())}.')
    repeats = text["repeat"].str.strip() if "repeat" in text else pd.Series("", text.index)
    notes: list[str] = []
    tests = [
        _test(kind, values[kinds == kind], repeats[kinds == kind], source, begin, longest, notes)
        for kind in ("relaxation", "creep", "modulus", "compliance")
        if (kinds == kind).any() and only in (None, kind)
    ]
    fitted = {test.kind for test in tests}
    lengths = {units[q] in _OF_LENGTH for q in columns if q in fitted & {"modulus", "compliance"}}
    if len(lengths) > 1:
        raise InputError(
            f"{place(source)}has a modulus and a compliance that belong to different units; use one system."
        )
    return Material(tuple(tests), "N/mm" if lengths in (set(), {True}) else "Pa", tuple(notes))


class _Head(NamedTuple):
    """Column header that may denote a quantity: column name, name without unit, quantity and unit."""

    column: str
    name: str
    quantity: str
    unit: str

    @property
    def short(self) -> bool:
        """Whether the name is a single letter, which may denote another quantity."""
        return len(self.name) == 1

    @property
    def usable(self) -> bool:
        """Whether the unit is a known unit of the quantity; False without a unit."""
        return self.unit in _UNITS[self.quantity]


def _columns(text, source):
    """Columns and units by quantity: two dicts. `text`: table of texts; `source`: name of the file, for messages.

    Raises `InputError` for unknown or missing units, and for missing or duplicate columns.
    """
    columns, units = {}, {}
    for head in _quantities(text.columns):
        quantity, unit = head.quantity, head.unit
        if not head.usable:
            allowed = ", ".join(_UNITS[quantity])
            unit_text = f'has the unit "{unit}"' if unit else "has no unit"
            example = f"{head.name} ({next(iter(_UNITS[quantity]))})"
            raise InputError(
                f'{place(source)}column "{head.column}" {unit_text}; write it like "{example}", with one of {allowed}.'
            )
        if quantity in columns:
            raise InputError(
                f'{place(source)}columns "{columns[quantity]}" and "{head.column}" both are a {quantity}; keep one.'
            )
        columns[quantity], units[quantity] = head.column, unit
    if not _is_complete(columns):
        raise InputError(
            f"{place(source)}a material table has time, position and force, or time and modulus or compliance, each"
            f" with its unit as in time_s; found {', '.join(columns) or 'none of them'}."
        )
    return columns, units


def _quantities(columns: Iterable[str]) -> list[_Head]:
    """Headers of the columns that hold quantities, with a valid unit or not.

    One-letter names that denote another quantity, such as T (degC) or g, are left out: if another column has the
    quantity's full name and the letter is not its usual symbol, or if its unit is not a unit of the quantity and the
    table is complete without it.
    """
    heads = [head for column in columns if (head := _head(column)) is not None]
    named = {head.quantity for head in heads if not head.short}
    heads = [head for head in heads if not head.short or head.quantity not in named or head.name in _LETTERS]
    usable = {head.quantity for head in heads if head.usable}
    return [head for head in heads if head.usable or not head.short or not _is_complete(usable)]


def _head(column: str) -> _Head | None:
    """Parse a column name into quantity and unit, "" without one; None if it names no quantity."""
    match = _HEAD.fullmatch(column)
    quantity = _QUANTITY.get(match[1].lower()) if match else None
    if match is None or quantity is None:
        return None
    unit = next((group.strip() for group in match.groups()[1:] if group is not None), "")
    return _Head(column, match[1], quantity, unit.replace("µ", "u").replace("μ", "u"))


def _is_complete(quantities: Collection[str]) -> bool:
    """Whether the quantities suffice: time, position and force; or time and moduli without position and force."""
    measured, derived = {"position", "force"} & set(quantities), {"modulus", "compliance"} & set(quantities)
    return "time" in quantities and (len(measured) == 2 or bool(derived and not measured))


def _kinds(text, columns, source):
    """Kind of test of each row, as a series: from the column `test`, or "modulus" or "compliance" by the `columns`.

    Raises `InputError` for a missing or unknown kind, and for a modulus and a compliance in one table.
    """
    if "position" not in columns:
        both = {"modulus", "compliance"} <= set(columns)
        if both:
            raise InputError(f"{place(source)}has a modulus and a compliance in one row; put them into two tables.")
        return pd.Series("modulus" if "modulus" in columns else "compliance", text.index)
    if "test" not in text:
        raise InputError(
            f'{place(source)}column "test" is missing; write relaxation (position applied) or creep (force applied).'
        )
    kinds = text["test"].str.strip().str.lower()
    refuse(
        ~kinds.isin(("relaxation", "creep")),
        source,
        lambda row: f'test is "{text.at[row, "test"]}"; it must be relaxation or creep.',
    )
    return kinds


def _test(kind, values, repeats, source, start, longest, notes):
    """One kind of test as a `Test`, with its repeats interpolated to common times; appends to `notes` if they were.

    `values`: its rows in base units; `repeats`: name of the repeat of each row; `source`: name of the file, for
    messages; `start`: state before the first row; `longest`: last time (s) to use, or None. Recorded times count from
    the first row. Raises `InputError` for times that do not increase, moduli at or below 0, and an invalid test.
    """
    output = {"relaxation": "force", "creep": "position"}.get(kind, kind)
    applied = {"relaxation": "position", "creep": "force"}.get(kind)
    tables = [values[repeats == name] for name in repeats.unique()]
    for table in tables:
        falls = table["time"].diff() <= 0
        refuse(falls, source, lambda row: "time does not increase from the row before; sort the rows of each repeat.")
    if applied is None:
        refuse(values["time"] <= 0, source, lambda row: "time is not above 0; moduli are counted from the step.")
        refuse(values[output] <= 0, source, lambda row: f"{output} is not above 0.")
    first = [0.0 if applied is None else table["time"].iloc[0] for table in tables]
    times = [table["time"].to_numpy() - zero for table, zero in zip(tables, first, strict=True)]
    times, tables = _shortened(times, tables, longest, f"{source}: the {kind} test")
    time, resampled = _common(times)
    if not time.size:
        raise InputError(f"{source}: the repeats of the {kind} test have no time in common; check their times.")
    if resampled:
        last = max(t[-1] for t in times)
        cut = f", up to {time[-1]:g} s, where the shortest ends (the longest: {last:g} s)" if time[-1] < last else ""
        how = "" if applied else " in their logarithms"
        notes.append(
            f"The repeats of the {kind} test have different times;"
            f" they were interpolated{how} to those of the first{cut}."
        )
    columns = [output] + ([applied] if applied else [])
    between = _interpolated_logs if resampled and applied is None else np.interp
    stacked = {
        c: np.stack([between(time, t, p[c].to_numpy()) for t, p in zip(times, tables, strict=True)]) for c in columns
    }
    try:
        return Test(
            kind, time, stacked[output], stacked.get(applied) if applied else None, "rest" if applied is None else start
        )
    except InputError as error:
        raise InputError(f"{source}: {error}") from None


def _shortened(times: list, tables: list, longest: float | None, which: str) -> tuple[list, list]:
    """Times (s) and rows of each repeat up to `longest` s; all of them for None.

    Raises `InputError`, naming the test as `which`, if a repeat has none.
    """
    if longest is None:
        return times, tables
    latest = max(t[0] for t in times)
    if not latest <= longest:
        raise InputError(f"{which} has no row up to {longest:g} s; give a --longest above {latest:g} s.")
    kept = [t <= longest for t in times]
    return [t[k] for t, k in zip(times, kept, strict=True)], [p[k] for p, k in zip(tables, kept, strict=True)]


def _common(times: list[Float[np.ndarray, " _"]]) -> tuple[Float[np.ndarray, " m"], bool]:
    """Times shared by all repeats, those of the first one, and whether the other repeats must be interpolated.

    Only times that all repeats cover are shared; there may be none.
    """
    first = times[0]
    if all(t.size == first.size and np.allclose(t, first, rtol=0, atol=1e-9 * first[-1]) for t in times):
        return first, False
    earliest, latest = max(t[0] for t in times), min(t[-1] for t in times)
    return first[(first >= earliest) & (first <= latest)], True


def _interpolated_logs(
    time: Float[np.ndarray, " m"], known_time: Float[np.ndarray, " _"], values: Float[np.ndarray, " _"]
) -> Float[np.ndarray, " m"]:
    """Interpolate positive `values`, given at `known_time`, to `time`; linearly in log-log, where moduli are smooth.

    `time` (m,) -> (m,), in the unit of the values.
    """
    return np.exp(np.interp(np.log(time), np.log(known_time), np.log(values)))
