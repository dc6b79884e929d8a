"""Rows of an export as rows of trials: conditions of the mapping, and tables with one row for each participant turned
into one row for each trial. Loads no JAX."""

from collections.abc import Collection
from collections.abc import Mapping as MappingLike

import pandas as pd

from hilbo.errors import InputError
from hilbo.study.file.reading import StudyFile
from hilbo.study.importing.answers import clean, is_absent, plain
from hilbo.study.importing.checks import numeric_names
from hilbo.study.importing.mapping import FILE, Mapping
from hilbo.study.importing.patterns import STIMULUS, TRIAL, filled, is_pattern, matches

__all__ = ["long_rows", "trial_rows", "with_values"]


def trial_rows(cells: pd.DataFrame, mapping: Mapping, study: StudyFile) -> pd.DataFrame:
    """The rows that meet the conditions of [rows] and have a cell in a column of a parameter or stimulus; all those
    that meet the conditions if no such column is mapped. Cells are compared without blanks around them and without
    regard to capitals."""
    for column, kept in mapping.rows.items():
        forms = {plain(cell) for cell in kept}
        cells = cells[cells[column].map(plain).isin(forms)]
    levels = {p.name: p.levels for p in study.space.parameters} | {STIMULUS: tuple(mapping.stimuli)}
    given = {column: levels[name] for name in levels if (column := mapping.columns.get(name, "")) in cells.columns}
    return with_values(cells, given)


def with_values(cells: pd.DataFrame, columns: MappingLike[str, Collection[str]]) -> pd.DataFrame:
    """The rows that have a value in some of the columns, all rows if there are none. `columns`: column -> cells that
    are values even where they look like a missing one."""
    if not columns:
        return cells
    absent = [cells[column].map(lambda cell, kept=kept: is_absent(cell, kept)) for column, kept in columns.items()]
    return cells[~pd.concat(absent, axis=1).all(axis=1)]


def long_rows(cells: pd.DataFrame, mapping: Mapping, study: StudyFile) -> pd.DataFrame:
    """One row for each trial, with the columns of the trial table that the mapping has, `stimulus`, and those of keep;
    the index (line of the export) is repeated for trials of one line. Cells are as they stand."""
    columns, numeric = dict(mapping.columns), numeric_names(study)
    wide = {name: column for name, column in columns.items() if is_pattern(column, cells.columns)}
    fixed = {name: cells[column].map(clean) for name, column in columns.items() if name not in wide and column != FILE}
    fixed |= {name: cells[name] for name in mapping.keep}
    if not wide:
        return pd.DataFrame(fixed, index=cells.index, dtype=object)
    first = wide.get("response") or next(iter(wide.values()))
    parts = []
    for place, (column, braces) in enumerate(matches(first, cells.columns, numeric).items(), 1):
        part = dict(fixed)
        part |= {
            name: cells[_column(other, braces, cells)].map(clean) for name, other in wide.items() if other != first
        }
        part |= {name: pd.Series(text, cells.index, dtype=object) for name, text in braces.items()}
        part |= {"response": cells[column].map(clean)}
        part |= (
            {} if TRIAL in part else {TRIAL: pd.Series(str(place - 1 + mapping.trials_from), cells.index, dtype=object)}
        )
        parts.append(pd.DataFrame(part, index=cells.index, dtype=object))
    return pd.concat(parts).sort_index(kind="stable")


def _column(pattern: str, braces: dict[str, str], cells: pd.DataFrame) -> str:
    """The column that a pattern gives for the texts of another one. Raises `InputError` if it is not in the table."""
    column = filled(pattern, braces)
    if column not in cells:
        raise InputError(f'columns: "{pattern}" has no column "{column}" beside the response; correct the pattern.')
    return column
