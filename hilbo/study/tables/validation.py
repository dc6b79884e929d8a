"""Validation tables, one row per comparison of two parameter sets, and sets tables, one row per set: reading and
checks.

Validation: `participant, trial, set_a, set_b, class_a, class_b, preferred`, optional `material, session, first`; others
are kept. `class_a`, `class_b` are labels of the study's responses (or ranks from 1, if no label reads as an integer),
`preferred` and `first` one of the two sets, or "a" or "b"; `preferred` may be "tie". Rows whose `voided` is 1, or whose
`phase` is warm-up or repeat, are left out. Questions that were not asked are empty cells.

Sets: `set_id, source` (aggregate, sysid or individual:PARTICIPANT), and the parameters that the caller names. Every
mistake is one sentence with the file and the line.
"""

import os
from collections.abc import Collection, Sequence

import pandas as pd

from hilbo.errors import InputError
from hilbo.search.box import Parameter
from hilbo.study.file.reading import StudyFile
from hilbo.study.formats.csv_file import answer_forms, numbers, read_cells, refuse
from hilbo.study.tables.equalities import broken_equality
from hilbo.study.tables.flag_counts import counted_flags, flagged, with_flag_counts
from hilbo.study.tables.parameter_sets import read_sets
from hilbo.study.tables.trials import boolean_column, check_people, check_texts, is_fitted

__all__ = [
    "NONE",
    "RESPONSES",
    "TIE",
    "check_validation",
    "of_material",
    "read_validation",
    "sets_frame",
    "sets_of_study",
]

RESPONSES = ("different", "similar", "close")
TIE = "tie"
NONE = ""
"""Cell of a question that was not asked."""

_NEEDED = ("participant", "trial", "set_a", "set_b", "class_a", "class_b", "preferred")
_OPTIONAL = ("material", "session", "first")
_KEY = ("participant", "material", "session", "trial")
_RESERVED = ("a", "b", TIE)


def read_validation(
    path: str | os.PathLike,
    responses: Sequence[str] = RESPONSES,
    material: str | None = None,
    exclude_flags: Collection[str] = (),
) -> pd.DataFrame:
    """Read a validation table and check its comparisons. `material`: select its rows; required if the table has
    several. `responses`: the study's labels, lowest first.

    All columns are text but `trial`; classes are labels, `preferred` and `first` names of sets (or "tie"), or empty.
    Rows that are warm-up, repeated or voided, and those with one of `exclude_flags`, are left out. Raises `InputError`.
    """
    text = read_cells(path, "a validation table needs a header and a comparison")
    if "material" in text:
        text["material"] = text["material"].str.strip()
    return check_validation(of_material(text, material, str(path)), responses, str(path), exclude_flags)


def check_validation(
    table: pd.DataFrame,
    responses: Sequence[str] = RESPONSES,
    source: str = "validation table",
    exclude_flags: Collection[str] = (),
) -> pd.DataFrame:
    """Check a validation table in memory and convert it to the form of `read_validation`.

    Warm-up, repeated and voided rows, and those with one of `exclude_flags`, are checked and left out; flag counts are
    stored in the result (`flag_counts.flag_counts`). Raises `InputError` for a missing column, an invalid value, a
    duplicate, and a table without a comparison that is left.
    """
    _check_columns(table, source)
    text = _as_text(table)
    out = text.copy()
    whole = numbers(text, "trial", source, "a whole number from 1", lambda v: (v >= 1) & (v % 1 == 0) & (v < 2**53))
    out["trial"] = whole.astype(int)
    check_people(text, source)
    check_texts(text, source, ("trial",))
    _check_sets(text, source)
    for column in ("class_a", "class_b"):
        out[column] = _classes(text, column, responses, source)
    out["preferred"] = _chosen(text, "preferred", (TIE,), source)
    if "first" in text:
        out["first"] = _chosen(text, "first", (), source)
    nothing = (out["class_a"] == NONE) & (out["class_b"] == NONE) & (out["preferred"] == NONE)
    refuse(nothing, source, lambda row: "has no response; fill in class_a and class_b, or preferred, or leave it out.")
    _check_duplicates(out, source)
    counts = ~boolean_column(text, "voided", source) & (is_fitted(text["phase"]) if "phase" in text else True)
    flags_of = counted_flags(out[counts], exclude_flags)
    counts &= ~flagged(out, exclude_flags)
    if not counts.any():
        besides = ", or excluded by `exclude_flags`" if exclude_flags else ""
        raise InputError(f"{source}: has no comparison that counts; all are warm-up, repeated or voided{besides}.")
    return with_flag_counts(out[counts], flags_of)


def _check_columns(table: pd.DataFrame, source: str) -> None:
    """Raise InputError for a missing column, or a table without rows."""
    missing = [name for name in _NEEDED if name not in table.columns]
    if missing:
        raise InputError(
            f'{source}:1: column "{missing[0]}" is missing; a validation table has {", ".join(_NEEDED)}'
            f" and may have {', '.join(_OPTIONAL)}."
        )
    if table.empty:
        raise InputError(f"{source}: has no rows; a validation table needs at least one comparison.")


def _as_text(table: pd.DataFrame) -> pd.DataFrame:
    """Copy of the table in which the columns that hilbo uses are text without surrounding blanks, "" for missing
    values."""
    text = table.copy()
    for column in (*_NEEDED, *(name for name in (*_OPTIONAL, "voided", "phase") if name in text)):
        cells = ["" if pd.isna(cell) else str(cell).strip() for cell in text[column]]
        text[column] = ["" if cell == "nan" else cell for cell in cells]  # a column of nothing, read from Parquet
    return text


def _check_sets(text: pd.DataFrame, source: str) -> None:
    """Raise InputError for a comparison with an empty or reserved set name (a, b, tie), or of a set with itself."""
    for column in ("set_a", "set_b"):
        refuse(text[column] == "", source, lambda row, c=column: f"{c} is empty; every comparison has one.")
    for column in ("set_a", "set_b"):
        refuse(
            text[column].isin(_RESERVED),
            source,
            lambda row, c=column: f'{c} is "{text.at[row, c]}", which has a fixed meaning; choose another name.',
        )
    same = text["set_a"] == text["set_b"]
    refuse(same, source, lambda row: f'set_a and set_b are both "{text.at[row, "set_a"]}"; compare two sets.')


def of_material(table: pd.DataFrame, material: str | None, source: str = "validation table") -> pd.DataFrame:
    """Rows of one material; all rows for None. Raises `InputError` for None with several materials, and for a material
    that is not in the table."""
    materials = list(table["material"].unique()) if "material" in table else []
    if material is None:
        if len(materials) > 1:
            raise InputError(
                f"{source}: contains {len(materials)} materials ({', '.join(materials)}); choose one of them."
            )
        return table
    if material not in materials:
        has = f"it has {', '.join(materials)}" if materials else 'it has no column "material"'
        raise InputError(f'{source}: contains no comparisons of material "{material}"; {has}.')
    return table[table["material"] == material]


def sets_frame(
    path: str | os.PathLike, names: Sequence[str] = (), parameters: Sequence[Parameter] = ()
) -> pd.DataFrame:
    """Read a sets table (`parameter_sets.read_sets`) in which `source` is required; returns it indexed by `set_id`,
    missing texts as "".

    `names`: required columns of numbers; `parameters`: those of them with levels have names of levels in the file, and
    indices of levels in the result. Raises `InputError`.
    """
    chosen = [p for p in parameters if p.levels]
    sets = read_sets(path, ("source", *names), {p.name: p.levels for p in chosen})
    frame = pd.DataFrame.from_dict(sets, orient="index").rename_axis("set_id")
    for p in chosen:
        frame[p.name] = [p.number(value) for value in frame[p.name]]
    text = frame.select_dtypes(exclude="number").columns
    return frame.fillna(dict.fromkeys(text, ""))


def sets_of_study(path: str | os.PathLike, study: StudyFile) -> pd.DataFrame:
    """Read the sets table of a study (`sets_frame`). Raises `InputError` also for a set that violates an equality of
    the study."""
    frame = sets_frame(path, study.space.names, study.space.parameters)
    for row, values in zip(frame.index, frame[list(study.space.names)].to_dict("records"), strict=True):
        broken = broken_equality({str(name): value for name, value in values.items()}, study)
        if broken is not None:
            raise InputError(f'{path}: the set "{row}": {broken}')
    return frame


def _classes(text: pd.DataFrame, column: str, responses: Sequence[str], source: str) -> pd.Series:
    """Labels of the responses in a column of labels or ranks; "" where nothing was asked. Raises InputError for other
    text."""
    forms, ranks = answer_forms(responses)
    labels = text[column].map({form: responses[i] for form, i in forms.items()} | {"": NONE})
    allowed = ", ".join(responses) + (ranks and f", {ranks}") + ", or empty"
    refuse(labels.isna(), source, lambda row: f'{column} is "{text.at[row, column]}"; it must be one of {allowed}.')
    return labels


def _chosen(text: pd.DataFrame, column: str, others: tuple[str, ...], source: str) -> pd.Series:
    """The column with "a" and "b" replaced by the row's set names. Raises InputError for a cell that is neither of the
    two sets, nor empty, nor one of `others`."""
    cells = text[column].mask(text[column] == "a", text["set_a"]).mask(text[column] == "b", text["set_b"])
    good = (cells == text["set_a"]) | (cells == text["set_b"]) | cells.isin((NONE, *others))
    allowed = "".join(f", {other}" for other in others)
    refuse(
        ~good,
        source,
        lambda row: (
            f'{column} is "{text.at[row, column]}"; it must be {text.at[row, "set_a"]}, {text.at[row, "set_b"]}'
            f"{allowed}, or empty."
        ),
    )
    return cells


def _check_duplicates(table: pd.DataFrame, source: str) -> None:
    """Raise InputError for two rows with the same participant, material, session and trial (of these, the columns that
    the table has)."""
    key = [column for column in _KEY if column in table]
    again = table.duplicated(key)
    refuse(
        again,
        source,
        lambda row: (
            f"participant {table.at[row, 'participant']}, trial {table.at[row, 'trial']} is there already;"
            f" each ({', '.join(key)}) may occur once."
        ),
    )
