"""Material tables: one row per sample of a creep or relaxation test, as CSV, Parquet, or text of an instrument.

Column names include their unit: `time_s`, `time (ms)` and `time [s]` are accepted alike, as are a row of units below
the header, and names of usual instruments (`tables.headings`). `test` is relaxation (position applied, force measured)
or creep (force applied, position measured), with `time`, `position` and `force` in every row; `repeat` identifies
repeats and `material` materials. Stress and strain become force and position by the area and thickness of the sample.
A table of moduli has `time` and `modulus` (relaxation) or `compliance` (creep) instead, and needs no `test`. Other
columns are ignored. Values are converted to s, mm, N, Pa (or N/mm) and 1/Pa (or mm/N). Invalid input raises
`InputError` with file and line.
"""

import os
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float

from hilbo.errors import InputError
from hilbo.identification.fitting import MEASURED, Kind, Test
from hilbo.identification.tables.columns import Columns, quantity_columns
from hilbo.identification.tables.headings import Heading
from hilbo.identification.tables.layout import Layout
from hilbo.identification.tables.text_tables import read_text_table
from hilbo.identification.tables.times import with_distinct_times
from hilbo.study.formats.csv_file import check_decimal_marks, numbers, refuse
from hilbo.study.tables.trials import of_material

__all__ = ["Material", "read_material"]

_OF_LENGTH = {"N/mm", "N/m", "mm/N", "m/N"}
_N_PER_PA_MM2 = 1e-6
_KINDS: tuple[Kind, ...] = ("relaxation", "creep", "modulus", "compliance")


class Material(NamedTuple):
    """Tests of one material, read from a table.

    `tests` in the order relaxation, creep, modulus, compliance; `stiffness_unit` of K: N/mm, or Pa for moduli in Pa;
    `notes`: how the table was read where that is not plain, and how the data were changed, such as interpolation.
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
    layout: Layout = Layout(),  # noqa: B008 (immutable)
) -> Material:
    """Read the tests of one material from a CSV, text or Parquet file, in s, mm, N, Pa (or N/mm) and 1/Pa (or mm/N).

    `material`: name, needed if the table has several, without effect in one that names none; `begin`: state before the
    first row, "rest" or "equilibrium" (`fitting.Test`); `only`: kind of test to read; `longest`: read the rows up to
    this time (s); `layout`: what the table does not say itself. Raises `InputError` for a file that cannot be read, a
    column or value that is not valid, and a test that is not there or not usable.
    """
    source = str(path)
    text, where, note = read_text_table(path, layout)
    columns = quantity_columns(list(text.columns), layout, where)
    _check_geometry(columns, layout, where)
    if text.empty:
        raise InputError(f"{source}: has no rows; a material table needs the samples of at least one test.")
    check_decimal_marks(text, [head.column for head in columns.heads.values()], source)
    text = of_material(text, material if "material" in text else None, source)
    values = _values(text, columns.heads, layout, source)
    kinds = _kinds(text, columns, layout, where, source)
    if only is not None and only not in set(kinds):
        raise InputError(f'{source}: contains no test "{only}"; it has {", ".join(kinds.unique())}.')
    repeats = text["repeat"].str.strip() if "repeat" in text else pd.Series("", text.index)
    notes = [" ".join(filter(None, (note, columns.note)))] if note or columns.note else []
    clock = columns.heads["time"]
    tests = [
        _test(
            kind,
            _repeats(values[kinds == kind], repeats[kinds == kind], text[clock.column], clock.factor, source, notes),
            *(source, begin, longest, notes),
        )
        for kind in _KINDS
        if (kinds == kind).any() and only in (None, kind)
    ]
    moduli = {test.kind for test in tests} & {"modulus", "compliance"}
    lengths = {columns.heads[quantity].unit in _OF_LENGTH for quantity in moduli}
    return Material(tuple(tests), "N/mm" if lengths in (set(), {True}) else "Pa", tuple(notes))


def _check_geometry(columns: Columns, layout: Layout, where: str) -> None:
    """Raise `InputError` for stress and strain without the geometry of the sample, and for a geometry without them."""
    given = (layout.area is not None, layout.gap is not None)
    if columns.of("strain", "stress") and not all(given):
        options = ("its area in mm2 by --area", "its thickness in mm by --gap")
        missing = " and ".join(option for option, is_given in zip(options, given, strict=True) if not is_given)
        raise InputError(
            f"{where}has stress and strain, which become force and position by the size of the sample: give {missing}."
        )
    if any(given) and not columns.of("strain", "stress"):
        raise InputError(
            f"{where}--area and --gap are for stress and strain, and {', '.join(columns.heads)} are read from this"
            " table; leave them out."
        )


def _values(text: pd.DataFrame, heads: dict[str, Heading], layout: Layout, source: str) -> pd.DataFrame:
    """The columns of `heads` as numbers in base units, named by quantity, with the rows of `text`; strain and stress
    become position (mm) and force (N) if the `layout` has area and gap. Raises `InputError` for cells that are no
    numbers."""
    words = "a finite number; correct it, or delete that row"
    values = pd.DataFrame(
        {q: numbers(text, head.column, source, words, lambda v: v == v) * head.factor for q, head in heads.items()}
    )
    if "stress" not in values or layout.area is None or layout.gap is None:
        return values
    position, force = values["strain"] * layout.gap, values["stress"] * (_N_PER_PA_MM2 * layout.area)
    return pd.DataFrame({"time": values["time"], "position": position, "force": force})


def _kinds(text: pd.DataFrame, columns: Columns, layout: Layout, where: str, source: str) -> pd.Series:
    """Kind of test of each row: from the column `test` or the `layout`, or "modulus" or "compliance" by the `columns`.

    Raises `InputError` for a missing or unknown kind, for a kind given by the `layout` where the table determines it,
    and for a modulus and a compliance in one table.
    """
    if columns.of("modulus") or columns.of("compliance"):
        if columns.of("modulus", "compliance"):
            raise InputError(
                f"{where}has a modulus and a compliance in one row; put them into two tables, or choose one, as by"
                f' --column "modulus={columns.heads["modulus"].column}".'
            )
        if layout.test is not None:
            raise InputError(f"{where}--test is for a table with a force; a table of moduli needs none, leave it out.")
        return pd.Series("modulus" if columns.of("modulus") else "compliance", text.index)
    if "test" in text and layout.test is not None:
        raise InputError(f'{where}has a column "test", and --test is given; leave --test out.')
    if layout.test is not None:
        return pd.Series(layout.test, text.index)
    if "test" not in text:
        raise InputError(
            f'{where}column "test" is missing; write relaxation (position applied) or creep (force applied), or give'
            " --test relaxation or --test creep."
        )
    kinds = text["test"].str.strip().str.lower()
    refuse(
        ~kinds.isin(MEASURED),
        source,
        lambda row: f'test is "{text.at[row, "test"]}"; it must be relaxation or creep.',
    )
    return kinds


def _repeats(
    values: pd.DataFrame, names: pd.Series, cells: pd.Series, factor: float, source: str, notes: list[str]
) -> list[pd.DataFrame]:
    """The rows of each repeat, those with equal times as their mean; appends to `notes` if there are any.

    `values`: rows of one kind of test in base units; `names`: of the repeat of each row; `cells`: times as written,
    with `factor` to s. Raises `InputError` for times that do not increase.
    """
    tables, step = [], 0.0
    for name in names.unique():
        table, own = with_distinct_times(values[names == name], cells[values.index[names == name]], factor, source)
        tables, step = [*tables, table], max(step, own)
    merged = len(values) - sum(map(len, tables))
    if merged:
        notes.append(
            f"{merged} of {len(values)} rows have the time of the row before, which is written to {step:g} s: rows of"
            " equal time were averaged."
        )
    return tables


def _test(
    kind: Kind,
    tables: list[pd.DataFrame],
    source: str,
    start,
    longest: float | None,
    notes: list[str],
) -> Test:
    """One kind of test as a `Test`, with its repeats interpolated to common times; appends to `notes` if they were.

    `tables`: the rows of each repeat in base units; `source`: name of the file, for messages; `start`: state before the
    first row; `longest`: last time (s) to use, or None. Recorded times count from the first row. Raises `InputError`
    for moduli at or below 0, and an invalid test.
    """
    output = {"relaxation": "force", "creep": "position"}.get(kind, kind)
    applied = {"relaxation": "position", "creep": "force"}.get(kind)
    if applied is None:
        values = pd.concat(tables)
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
