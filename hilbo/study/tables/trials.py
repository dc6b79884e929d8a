"""Trial tables: CSV or Parquet, one row per answer, checked before anything is fitted.

Columns: `participant`, `trial`, `response` and one per parameter in physical units; optional `session`, `phase`,
`material`, `voided`, `unblinded`, `flags`, `telemetry_samples`; others are kept. A number means what its decimals say
(correctly rounded), so that a table and the log it came from give the same bits. People come in the order of their
names, whatever the order of the rows: the last digits of sums, and where a search ends, depend on it. Whatever is wrong
is one sentence with the file and the line (Parquet: row). A table is read piece by piece, and a piece's text is gone
when its numbers are known.
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
from hilbo.study.formats.cell_text import FORMULA_WORDS, ID_WORDS, but_for_case, check_text, formulas, no_ids
from hilbo.study.formats.csv_file import (
    FRAME,
    answer_forms,
    numbers,
    parameter_values,
    place,
    refuse,
)
from hilbo.study.tables.flag_counts import added, counted_flags, flagged

__all__ = [
    "NOT_FITTED",
    "NothingToFitError",
    "TrialTable",
    "check_people",
    "check_recoding",
    "check_texts",
    "flags",
    "is_fitted",
    "joined",
    "of_material",
    "trial_table",
    "write_trials",
]


class NothingToFitError(InputError):
    """A table that is in order, and has no answer that counts."""


NOT_FITTED = ("warm-up", "repeat")
"""Phases whose answers are kept and never fitted: familiarisation, and repetitions that check consistency."""
_KEY = ("participant", "session", "phase", "material", "trial")
_TRUE = {"1", "1.0", "1,0", "true", "yes"}
_NAMED = 6  # people of whom a remark says the names
_MISSING = {"", "nan", "none", "<na>"}
_FALSE = {"", "0", "0.0", "0,0", "false", "no", "nan", "none", "<na>"}


class TrialTable(NamedTuple):
    """A trial table that was checked against a study: the rows to be fitted, by participant, session and trial."""

    rows: pd.DataFrame
    """With the column `category` (0 = lowest response); of a level its place in the list."""
    flags: FlagCounts
    """Trials that carry a flag of the device, and those that the study excludes for theirs."""


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
    """The checked table of these cells, which come as text, piece by piece (`csv_file.cell_pieces`, `cells_of`).

    Warm-up, repeated and voided rows, and those with a flag that the study excludes, are checked and left out.

    **Arguments:** `material`: only its rows; needed if there are several. `source`: the file, for sentences. `others`:
    keep the columns that hilbo does not use. `say`: called with the number of rows read so far. `note`: called with a
    sentence on participants without a response that counts; by default a warning. Raises `InputError`.
    """
    texts, pieces, rows, named = {}, [], 0, {}
    for text in cells:
        _check_columns(text, study, source)
        say(rows := rows + len(text))
        if material is not None and "material" in text:  # each material has ranges of its own
            named |= dict.fromkeys(text["material"])
            text = text[text["material"] == material]
        pieces.append(_checked(text, study, source, others, texts))
    if not rows:
        raise InputError(f"{source}: has no rows; a trial table needs at least one answer.")
    if named and material not in named:
        raise InputError(f'{source}: holds no material "{material}"; it has {", ".join(named)}.')
    table = pd.concat(pieces)
    del pieces
    _check_duplicates(table, source)
    fitted = table.pop("_fitted")
    counts = counted_flags(table[fitted], study.exclude_flags)
    fitted &= ~flagged(table, study.exclude_flags)
    left, table = table[~fitted], table[fitted]
    _check_blinded(table.pop("_blinded"), study, source)
    besides = ", or excluded by `exclude_flags`" if study.exclude_flags else ""
    if table.empty:
        raise NothingToFitError(f"{source}: has no rows to fit; all are warm-up, repeated or voided{besides}.")
    table = of_material(table, material, source)
    _note_the_absent(left, table, source if material is None else f"{source} ({material})", besides, note)
    if alike := but_for_case(table["participant"].unique()):
        note(f"{source}: {alike} differ in capitals only; they are taken for two people.")
    return TrialTable(_ordered(table), counts)


def joined(tables: Sequence[TrialTable]) -> TrialTable:
    """Several tables of one study as one."""
    rows = pd.concat([table.rows for table in tables], ignore_index=True)
    return TrialTable(_ordered(rows), added(table.flags for table in tables))


def _ordered(table: pd.DataFrame) -> pd.DataFrame:
    """A checked table, or several as one, by participant, session and trial; where a session has a number in several
    phases, by phase before."""
    keys = [name for name in ("participant", "session") if name in table]
    if "phase" in table and table.duplicated([*keys, "trial"]).any():
        keys.append("phase")
    places = [table["trial"], *(_numbered(table[name]) for name in reversed(keys))]
    return table.iloc[np.lexsort(places)]


def _note_the_absent(
    left: pd.DataFrame, table: pd.DataFrame, source: str, besides: str, note: Callable[[str], object]
) -> None:
    """Say who has answers, and none that counts: without a word that person would be missing everywhere."""
    kept = set(table["participant"].unique())
    absent = [str(name) for name in left["participant"].unique() if name not in kept]
    if absent:
        who = ", ".join(absent[:_NAMED]) + (f" and {len(absent) - _NAMED} more" if len(absent) > _NAMED else "")
        answers = f"{len(left)} answers are" if len(left) > 1 else "1 answer is"
        have = "has" if len(absent) == 1 else "have"
        also = f"voided, warm-up or repeated{besides}, and not fitted"
        note(f"{source}: {answers} {also}; {who} {have} no other answer in it.")


def _checked(text: pd.DataFrame, study: StudyFile, source: str, others: bool, texts: dict[str, str]) -> pd.DataFrame:
    """A piece with its numbers as numbers and its texts as one object each, and `_fitted`: which rows count."""
    numeric = {"trial", *study.space.names}
    names: list[str] = list(text.columns)
    table: dict[str, object] = {}  # a frame at once: each column that is added to one costs as many as there are
    for column in names:
        if column in numeric:
            table[column] = np.nan  # its place among the columns
        elif others or column in (*_KEY, study.random_effect, COLUMN, COLUMN_OF_SAMPLES):
            table[column] = [texts.setdefault(cell, cell) for cell in text[column]]
    whole = numbers(text, "trial", source, "a whole number from 1", lambda v: (v >= 1) & (v % 1 == 0) & (v < 2**53))
    table["trial"] = whole.astype(int)
    check_people(text, source)
    _check_random_effect(text, study, source)
    check_texts(text, source, numeric | {"response"})
    for parameter in study.space.parameters:
        table[parameter.name] = parameter_values(text, parameter, source)
    table["category"] = _categories(text["response"], study.responses, source)
    table["_blinded"] = text["unblinded"].str.strip().str.lower().isin(_FALSE) if "unblinded" in text else True
    table["_fitted"] = ~flags(text, "voided", source) & (is_fitted(text["phase"]) if "phase" in text else True)
    return pd.DataFrame(table, index=text.index)


def _numbered(names: pd.Series) -> pd.Series:
    """Of people, sessions or phases the place of each row's in their order: by numbers where all are numbers, else by
    the alphabet, in which S2 is before S10. What is computed of a table then does not depend on the order of its rows.
    """
    known = pd.Series(names.unique())
    numbers = pd.to_numeric(known, errors="coerce")
    padded = known.map(lambda name: re.sub(r"\d+", lambda digits: digits[0].zfill(20), str(name)))
    keys = pd.DataFrame({"number": numbers if numbers.notna().all() else 0, "padded": padded, "name": known})
    places = keys.sort_values(["number", "padded", "name"]).index
    return names.map(dict(zip(known[places], range(len(known)), strict=True)))


def write_trials(table: pd.DataFrame, path: str | os.PathLike) -> None:
    """Write a trial table, numbers as the shortest decimals that read back to the same bits."""
    if Path(path).suffix == ".parquet":
        table.to_parquet(path, index=False)
    else:
        table.to_csv(path, index=False)  # pandas writes the shortest decimals that read back the same


def _check_columns(text: pd.DataFrame, study: StudyFile, source: str) -> None:
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
    """Refuse rows that leave the column of the study's random effect empty, where there is one."""
    name = study.random_effect
    if name in text.columns:
        missing = text[name].str.strip().str.lower().isin(_MISSING)
        refuse(missing, source, lambda row: f"{name} is empty; [random_effect] needs it of each answer.")


def _categories(cells: pd.Series, responses: Sequence[str], source: str) -> pd.Series:
    """Categories from 0."""
    forms, ranks = answer_forms(responses)
    categories = cells.map(forms)
    allowed = ", ".join(responses) + (ranks and f", or {ranks}")
    refuse(categories.isna(), source, lambda row: f'response is "{cells.at[row]}"; it must be one of {allowed}.')
    return categories.astype(int)


def check_recoding(text: pd.DataFrame, responses: Sequence[str]) -> None:
    """Refuse cells in which `category` is not that of `response`: only one of them was changed by whoever read them,
    and the fit would be to the other."""
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
    """Whether answers of these phases are fitted, however somebody writes "warm-up": "Warm up" is one too."""
    plain = phases.str.lower().str.replace(r"[\s_-]", "", regex=True)
    return ~plain.isin([phase.replace("-", "") for phase in NOT_FITTED])


def flags(text: pd.DataFrame, column: str, source: str) -> pd.Series:
    """A column of 1 and 0; all 0 where there is none."""
    if column not in text:
        return pd.Series(False, text.index)
    cells = text[column].str.strip().str.lower()
    refuse(~cells.isin(_TRUE | _FALSE), source, lambda row: f'{column} is "{text.at[row, column]}"; write 1 or 0.')
    return cells.isin(_TRUE)


def _check_blinded(blinded: pd.Series, study: StudyFile, source: str) -> None:
    """Refuse answers of people who knew the parameters beside answers of people who did not."""
    expected = study.stimulus is not None and study.stimulus.unblinded
    if not expected and blinded.any() and not blinded.all():
        row = (~blinded).idxmax()
        raise InputError(
            f"{place(source, row)}is an unblinded answer, as hilbo try gives, beside others that are blinded; leave"
            " the unblinded ones out."
        )


def _check_duplicates(table: pd.DataFrame, source: str) -> None:
    key = [column for column in _KEY if column in table]
    again = table.duplicated(key)
    if again.any():
        row = again.idxmax()
        same = (table[key] == table.loc[row, key]).all(axis=1).idxmax()
        line = "row" if source.endswith(".parquet") or source == FRAME else "line"
        raise InputError(
            f"{place(source, row)}participant {table.at[row, 'participant']}, trial {table.at[row, 'trial']} stands in"
            f" {line} {same} already; each ({', '.join(key)}) may occur once."
        )


def of_material(table: pd.DataFrame, material: str | None, source: str) -> pd.DataFrame:
    """The rows of one material; which one must be said where there are several.

    Raises `InputError` if it is not said, or is not there.
    """
    if "material" not in table:
        if material is not None:
            raise InputError(f'{place(source)}column "material" is missing; without it no material can be chosen.')
        return table
    materials = list(table["material"].unique())
    if material is None and len(materials) > 1:
        raise InputError(
            f"{source}: holds {len(materials)} materials ({', '.join(materials)}); choose one with --material."
        )
    if material is not None and material not in materials:
        raise InputError(f'{source}: holds no material "{material}"; it has {", ".join(materials)}.')
    return table if material is None else table[table["material"] == material]


def check_people(text: pd.DataFrame, source: str) -> None:
    """Refuse rows without a participant, and ids against the rule for them."""
    cells = text["participant"]
    refuse(cells == "", source, lambda row: "participant is empty; give each row a participant.")
    refuse(cells.isin(no_ids(cells)), source, lambda row: f'participant is "{cells.at[row]}"; {ID_WORDS}.')


def check_texts(text: pd.DataFrame, source: str, numeric: Collection[str] = ()) -> None:
    """Refuse cells, and heads of columns, that a spreadsheet would run; `numeric`: columns that hold no text."""
    for column in text.columns:  # in memory a name may be a number
        check_text(str(column), "the name of a column", place(source).rstrip(": "))
        if column not in numeric:
            cells = text[column]
            if run := formulas(cells):
                wrong = cells.isin(run)
                refuse(wrong, source, lambda row, c=column: f'{c} is "{text.at[row, c]}", {FORMULA_WORDS}.')
