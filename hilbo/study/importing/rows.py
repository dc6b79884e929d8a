"""Rows of an export as rows of trials: conditions of the mapping, and tables with one row for each participant turned
into one row for each trial. Loads no JAX."""

import pandas as pd

from hilbo.errors import InputError
from hilbo.study.file.reading import StudyFile
from hilbo.study.importing.answers import clean, is_missing, plain
from hilbo.study.importing.mapping import FILE, Mapping
from hilbo.study.importing.patterns import STIMULUS, TRIAL, filled, is_pattern, matches

__all__ = ["check_columns", "long_rows", "numeric_names", "trial_rows"]


def numeric_names(study: StudyFile) -> list[str]:
    """Names of the parameters that are numbers."""
    return [p.name for p in study.space.parameters if not p.levels]


def trial_rows(cells: pd.DataFrame, mapping: Mapping, study: StudyFile) -> pd.DataFrame:
    """The rows that meet the conditions of [rows] and have a cell in a column of a parameter or stimulus; all those
    that meet the conditions if no such column is mapped. Cells are compared without blanks around them and without
    regard to capitals."""
    for column, kept in mapping.rows.items():
        forms = {plain(cell) for cell in kept}
        cells = cells[cells[column].map(plain).isin(forms)]
    names = (*(p.name for p in study.space.parameters), STIMULUS)
    given = [column for name in names if (column := mapping.columns.get(name, "")) in cells.columns and column]
    return cells[~cells[given].map(is_missing).all(axis=1)] if given else cells


def check_columns(cells: pd.DataFrame, mapping: Mapping, study: StudyFile, source: str) -> None:
    """Raise `InputError` unless the mapping has a column, a pattern or stimuli for all that a trial table needs, and
    the columns that it names are in the table. `source`: the mapping, for messages."""
    parameters = [p.name for p in study.space.parameters]
    known = {"participant", "trial", "response", STIMULUS, "session", "phase", "material", "voided", "unblinded"}
    for name, column in mapping.columns.items():
        if name not in (*known, *parameters, study.random_effect):
            raise InputError(f"{source}: columns.{name} is no column of a trial table; copy others with keep.")
        present = bool(matches(column, cells.columns, numeric_names(study))) if is_pattern(column) else column in cells
        if not present and column != FILE:
            words = f'"{column}", which is not in the table' if column else "empty"
            raise InputError(f"{source}: columns.{name} is {words}; write the name of a column.")
    braced = set(parameters) & {
        name for column in mapping.columns.values() for name in parameters if f"{{{name}}}" in column
    }
    by_stimulus = STIMULUS in mapping.columns or f"{{{STIMULUS}}}" in mapping.columns.get("response", "")
    for name in ("participant", "response", *([] if by_stimulus else parameters)):
        if name not in mapping.columns and name not in braced:
            raise InputError(f"{source}: columns.{name} is missing; write the name of its column.")
    if absent := [column for column in (*mapping.rows, *mapping.keep) if column not in cells]:
        raise InputError(f'{source}: column "{absent[0]}" of rows or keep is not in the table; correct its name.')


def long_rows(cells: pd.DataFrame, mapping: Mapping, study: StudyFile) -> pd.DataFrame:
    """One row for each trial, with the columns of the trial table that the mapping has, `stimulus`, and those of keep;
    the index (line of the export) is repeated for trials of one line. Cells are as they stand."""
    columns, numeric = dict(mapping.columns), numeric_names(study)
    wide = {name: column for name, column in columns.items() if is_pattern(column)}
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
