"""Trial tables: CSV or Parquet, one row per response, checked before any fit.

Columns: `participant`, `trial`, `response` and one per parameter in physical units; optional `session`, `phase`,
`material`, `voided`, `unblinded`, `flags`, `telemetry_samples`; others are kept. Numbers are correctly rounded from
their decimals, so that a table and the log it came from give the same bits. Participants are sorted by name, whatever
the order of the rows: the last digits of sums, and where a search ends, depend on the order. Every mistake is one
sentence with the file and the line (Parquet: row). A table is read piece by piece, and a piece's text is discarded once
its numbers are parsed.
"""

import os
import re
from collections.abc import Callable, Collection, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from hilbo.errors import InputError, warn_caller
from hilbo.study.file.reading import StudyFile
from hilbo.study.file.trial_flags import COLUMN, COLUMN_OF_SAMPLES, FlagCounts
from hilbo.study.formats.cell_text import FORMULA_WORDS, ID_WORDS, check_text, formulas, invalid_ids
from hilbo.study.formats.csv_file import (
    FRAME,
    answer_forms,
    check_decimal_marks,
    numbers,
    parameter_values,
    place,
    refuse,
)
from hilbo.study.tables.equalities import check_equalities
from hilbo.study.tables.flag_counts import added, counted_flags, flagged
from hilbo.study.tables.missing import Missing, missing_labels
from hilbo.study.tables.remarks import note_absent, note_doubtful_ids

__all__ = [
    "NOT_FITTED",
    "NothingToFitError",
    "TrialTable",
    "boolean_column",
    "check_people",
    "check_recoding",
    "check_texts",
    "is_fitted",
    "joined",
    "of_material",
    "trial_table",
    "write_trials",
]


class NothingToFitError(InputError):
    """A valid table, none of whose responses is fitted."""


NOT_FITTED = ("warm-up", "repeat")
"""Phases whose responses are kept but never fitted: familiarisation, and repetitions for test-retest agreement."""
_KEY = ("participant", "session", "phase", "material", "trial")
_TRUE = {"1", "1.0", "1,0", "true", "yes"}
_NONE = -1  # category of a missing response, which is never fitted
_MISSING = {"", "nan", "none", "<na>"}
_FALSE = {"", "0", "0.0", "0,0", "false", "no", "nan", "none", "<na>"}


class TrialTable(NamedTuple):
    """A checked trial table: the rows to be fitted, sorted by participant, session and trial."""

    rows: pd.DataFrame
    """The rows to be fitted, with the column `category` (0 = lowest response) and levels by their index."""
    flags: FlagCounts
    """Counts of trials with a flag of the device, and of those excluded for it."""
    missing: Missing = Missing()
    """Counts of missing responses."""


def trial_table(
    cells: Iterable[pd.DataFrame],
    study: StudyFile,
    material: str | None = None,
    *,
    source: str,
    others: bool = True,
    say: Callable[[int], object] = lambda rows: None,
    note: Callable[[str], object] = warn_caller,
) -> TrialTable:
    """Check the text cells of a trial table, given in pieces (`csv_file.cell_pieces`, or a list with `cells_of`).

    Warm-up, repeated and voided rows, and those with a flag that the study excludes, are checked and left out.

    **Arguments:** `material`: select its rows; required if there are several. `source`: the file, for messages.
    `others`: keep the columns that hilbo does not use. `say`: called with the number of rows read so far. `note`:
    called with one sentence on each of: participants none of whose responses is fitted, two ids that may be one
    participant's, ids that a spreadsheet has rounded, missing responses; by default a warning. Raises `InputError`, and
    its subclass `NothingToFitError` if no row is left.
    """
    texts, pieces, rows, named = {}, [], 0, {}
    for text in cells:
        _check_columns(text, study, source)
        say(rows := rows + len(text))
        if material is not None and "material" in text:  # each material has separate ranges
            named |= dict.fromkeys(text["material"])
            text = text[text["material"] == material]
        pieces.append(_checked(text, study, source, others, texts))
    if not rows:
        raise InputError(f"{source}: has no rows; a trial table needs at least one answer.")
    if named and material not in named:
        raise InputError(f'{source}: contains no material "{material}"; it has {", ".join(named)}.')
    table = pd.concat(pieces)
    del pieces
    _check_duplicates(table, source)
    fitted, absent = table.pop("_fitted"), table.pop("_missing")
    missing = Missing.of(table["participant"][fitted], absent[fitted])
    absent = absent.notna()
    fitted &= ~absent
    counts = counted_flags(table[fitted], study.exclude_flags)
    fitted &= ~flagged(table, study.exclude_flags)
    left, table = table[~fitted & ~absent], table[fitted]
    _check_blinded(table.pop("_blinded"), study, source)
    besides = ", or excluded by `exclude_flags`" if study.exclude_flags else ""
    nothing = ", or missing" if study.missing else ""
    if table.empty:
        raise NothingToFitError(f"{source}: has no rows to fit; all are warm-up, repeated or voided{nothing}{besides}.")
    table = of_material(table, material, source)
    note_absent(left, table, source if material is None else f"{source} ({material})", besides, note)
    note_doubtful_ids(list(table["participant"].unique()), source, note)
    for sentence in missing.sentences:
        note(f"{source}: {sentence}")
    return TrialTable(_ordered(table), counts, missing)


def joined(tables: Sequence[TrialTable]) -> TrialTable:
    """Several checked tables of one study as one, sorted again; flag counts are added. Duplicates are not looked
    for."""
    rows = pd.concat([table.rows for table in tables], ignore_index=True)
    return TrialTable(_ordered(rows), added(t.flags for t in tables), Missing.added(t.missing for t in tables))


def _ordered(table: pd.DataFrame) -> pd.DataFrame:
    """Rows sorted by participant, session and trial; by phase before trial if a session has a trial number in several
    phases."""
    keys = [name for name in ("participant", "session") if name in table]
    if "phase" in table and table.duplicated([*keys, "trial"]).any():
        keys.append("phase")
    places = [table["trial"], *(_numbered(table[name]) for name in reversed(keys))]
    return table.iloc[np.lexsort(places)]


def _checked(text: pd.DataFrame, study: StudyFile, source: str, others: bool, texts: dict[str, str]) -> pd.DataFrame:
    """Check one piece of text cells; returns it with `trial` and parameters as numbers, and the new columns `category`,
    `_blinded`, `_missing` and `_fitted` (Boolean: whether the row is to be fitted, if it has a response).

    `texts` is a cache in which equal texts become one object; it is extended. `others`: keep columns that hilbo does
    not use. Raises `InputError`.
    """
    numeric = {"trial", *study.space.names}
    names: list[str] = list(text.columns)
    table: dict[str, object] = {}  # a frame at once: each column that is added to one costs as many as there are
    for column in names:
        if column in numeric:
            table[column] = np.nan  # its place among the columns
        elif others or column in (*_KEY, study.random_effect, COLUMN, COLUMN_OF_SAMPLES):
            table[column] = [texts.setdefault(cell, cell) for cell in text[column]]
    check_decimal_marks(text, ["trial", *(p.name for p in study.space.parameters if not p.levels)], source)
    whole = numbers(text, "trial", source, "a whole number from 1", lambda v: (v >= 1) & (v % 1 == 0) & (v < 2**53))
    table["trial"] = whole.astype(int)
    check_people(text, source)
    _check_random_effect(text, study, source)
    check_texts(text, source, numeric | {"response"})
    for parameter in study.space.parameters:
        table[parameter.name] = parameter_values(text, parameter, source)
    check_equalities(table, text.index, study, source)
    table["_missing"] = missing_labels(text["response"], study.missing)
    given = _categories(text["response"][table["_missing"].isna()], study.responses, source)
    table["category"] = given.reindex(text.index, fill_value=_NONE)
    table["_blinded"] = text["unblinded"].str.strip().str.lower().isin(_FALSE) if "unblinded" in text else True
    table["_fitted"] = ~boolean_column(text, "voided", source) & (is_fitted(text["phase"]) if "phase" in text else True)
    return pd.DataFrame(table, index=text.index)


def _numbered(names: pd.Series) -> pd.Series:
    """Rank (from 0) of each row's name in the sorted names: numerically if all are numbers, otherwise alphabetically
    with runs of digits compared as numbers, so that S2 comes before S10."""
    known = pd.Series(names.unique())
    numbers = pd.to_numeric(known, errors="coerce")
    padded = known.map(lambda name: re.sub(r"\d+", lambda digits: digits[0].zfill(20), str(name)))
    keys = pd.DataFrame({"number": numbers if numbers.notna().all() else 0, "padded": padded, "name": known})
    places = keys.sort_values(["number", "padded", "name"]).index
    return names.map(dict(zip(known[places], range(len(known)), strict=True)))


def write_trials(table: pd.DataFrame, path: str | os.PathLike) -> None:
    """Write a trial table as Parquet (by its suffix) or CSV, without its index; an existing file is overwritten.
    Numbers of a CSV are the shortest decimals that read back to the same bits."""
    if Path(path).suffix == ".parquet":
        table.to_parquet(path, index=False)
    else:
        table.to_csv(path, index=False)  # pandas writes the shortest decimals that read back the same


def _check_columns(text: pd.DataFrame, study: StudyFile, source: str) -> None:
    """Raise InputError for the first required column that is missing; the message names a column that differs in
    capitals or blanks only."""
    needed = ("participant", "trial", "response", *study.space.names)
    missing = [name for name in needed if name not in text.columns]
    if missing:
        alike = [str(name) for name in text.columns if str(name).strip().lower() == missing[0].lower()]
        hint = f' (there is "{alike[0]}")' if alike else ""
        wants = ", ".join(needed)
        raise InputError(
            f'{place(source)}column "{missing[0]}" is missing{hint}; a trial table of this study has {wants}.'
        )


def _check_random_effect(text: pd.DataFrame, study: StudyFile, source: str) -> None:
    """Raise InputError for a row whose cell in the random effect's column is empty; a table without that column
    passes."""
    name = study.random_effect
    if name in text.columns:
        missing = text[name].str.strip().str.lower().isin(_MISSING)
        refuse(missing, source, lambda row: f"{name} is empty; [random_effect] needs it of each answer.")


def _categories(cells: pd.Series, responses: Sequence[str], source: str) -> pd.Series:
    """Category of each response, an integer from 0 (lowest). Raises InputError for a cell that is no label, nor rank
    where ranks are accepted."""
    forms, ranks = answer_forms(responses)
    categories = cells.map(forms)
    allowed = ", ".join(responses) + (ranks and f", or {ranks}")
    refuse(categories.isna(), source, lambda row: f'response is "{cells.at[row]}"; it must be one of {allowed}.')
    return categories.astype(int)


def check_recoding(text: pd.DataFrame, responses: Sequence[str]) -> None:
    """Raise InputError for a row whose `category` does not belong to its `response`: a user has changed one of the two,
    and the fit would use the other."""
    categories = _categories(text["response"], responses, FRAME)
    refuse(
        pd.to_numeric(text["category"], errors="coerce") != categories,
        FRAME,
        lambda row: (
            f'category is {text.at[row, "category"]}, but response "{text.at[row, "response"]}" is category'
            f" {categories.at[row]}; change the response, and leave the column category out."
        ),
    )


def is_fitted(phases: pd.Series) -> pd.Series:
    """Boolean Series: False for warm-up and repeat phases, in any spelling with capitals, blanks, "-" or "_", such as
    "Warm up"."""
    plain = phases.str.lower().str.replace(r"[\s_-]", "", regex=True)
    return ~plain.isin([phase.replace("-", "") for phase in NOT_FITTED])


def boolean_column(text: pd.DataFrame, column: str, source: str) -> pd.Series:
    """A column of 1/0, true/false or yes/no as a Boolean Series; empty cells are False, and so are all rows if there is
    no such column. Raises InputError for other text."""
    if column not in text:
        return pd.Series(False, text.index)
    cells = text[column].str.strip().str.lower()
    refuse(~cells.isin(_TRUE | _FALSE), source, lambda row: f'{column} is "{text.at[row, column]}"; write 1 or 0.')
    return cells.isin(_TRUE)


def _check_blinded(blinded: pd.Series, study: StudyFile, source: str) -> None:
    """Raise InputError if blinded and unblinded responses are mixed, except in a study with [stimulus] unblinded.
    `blinded`: Boolean, by row."""
    expected = study.stimulus is not None and study.stimulus.unblinded
    if not expected and blinded.any() and not blinded.all():
        row = (~blinded).idxmax()
        raise InputError(
            f"{place(source, row)}is an unblinded response, as of hilbo try, among blinded ones; leave"
            " the unblinded ones out."
        )


def _check_duplicates(table: pd.DataFrame, source: str) -> None:
    """Raise InputError for two rows with the same participant, session, phase, material and trial (of these, the
    columns that the table has)."""
    key = [column for column in _KEY if column in table]
    again = table.duplicated(key)
    if again.any():
        row = again.idxmax()
        same = (table[key] == table.loc[row, key]).all(axis=1).idxmax()
        line = "row" if source.endswith(".parquet") or source == FRAME else "line"
        raise InputError(
            f"{place(source, row)}participant {table.at[row, 'participant']}, trial {table.at[row, 'trial']} is in"
            f" {line} {same} already; each ({', '.join(key)}) may occur once."
        )


def of_material(table: pd.DataFrame, material: str | None, source: str) -> pd.DataFrame:
    """Rows of one material; all rows for None. Raises `InputError` for None with several materials, and for a material
    that is not in the table."""
    if "material" not in table:
        if material is not None:
            raise InputError(f'{place(source)}column "material" is missing; without it no material can be chosen.')
        return table
    materials = list(table["material"].unique())
    if material is None and len(materials) > 1:
        raise InputError(
            f"{source}: contains {len(materials)} materials ({', '.join(materials)}); choose one with --material."
        )
    if material is not None and material not in materials:
        raise InputError(f'{source}: contains no material "{material}"; it has {", ".join(materials)}.')
    return table if material is None else table[table["material"] == material]


def check_people(text: pd.DataFrame, source: str) -> None:
    """Raise `InputError` for a row without a participant, or with an invalid id."""
    cells = text["participant"]
    refuse(cells == "", source, lambda row: "participant is empty; give each row a participant.")
    refuse(cells.isin(invalid_ids(cells)), source, lambda row: f'participant is "{cells.at[row]}"; {ID_WORDS}.')


def check_texts(text: pd.DataFrame, source: str, numeric: Collection[str] = ()) -> None:
    """Raise `InputError` for a cell or column name that a spreadsheet could run as a formula; the cells of the columns
    `numeric` are not checked."""
    for column in text.columns:  # in memory a name may be a number
        check_text(str(column), "the name of a column", place(source).rstrip(": "))
        if column not in numeric:
            cells = text[column]
            if run := formulas(cells):
                wrong = cells.isin(run)
                refuse(wrong, source, lambda row, c=column: f'{c} is "{text.at[row, c]}", {FORMULA_WORDS}.')
