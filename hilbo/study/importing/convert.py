"""Conversion of an export to a trial table by a mapping, and the record of the actions taken. Loads no JAX."""

import re
from collections import Counter
from collections.abc import Callable, Sequence
from decimal import Decimal, InvalidOperation
from typing import NamedTuple

import pandas as pd

from hilbo.errors import InputError
from hilbo.search.box import Parameter
from hilbo.study.file.reading import StudyFile
from hilbo.study.formats.cell_text import id_form, is_decimal
from hilbo.study.formats.csv_file import answer_forms, place, refuse
from hilbo.study.formats.json_file import Content
from hilbo.study.importing.answers import clean, is_missing, plain, told_missing
from hilbo.study.importing.mapping import FILE, Mapping
from hilbo.study.importing.patterns import STIMULUS
from hilbo.study.importing.raw import RawTable
from hilbo.study.importing.record import Counts, record_of, sentences_of
from hilbo.study.importing.rows import check_columns, long_rows, numeric_names, trial_rows
from hilbo.study.tables.remarks import note_forms
from hilbo.study.tables.trials import NothingToFitError, trial_table

__all__ = ["Imported", "converted"]

_NOT_GIVEN = "missing response"
_GIVE_ID = "each trial needs one, so add it or delete the row"


class Imported(NamedTuple):
    """A trial table made of an export."""

    table: pd.DataFrame
    """The trial table as text cells."""
    ids: dict[str, str]
    """Id in the export -> id in the table; empty if ids are as written."""
    record: Content
    """Actions taken, in counts, without ids."""
    sentences: list[str]
    """Actions taken, for the user."""


def converted(
    tables: Sequence[RawTable], mapping: Mapping, study: StudyFile, source: str, note: Callable[[str], object]
) -> Imported:
    """Convert exports to a trial table, and check it as any trial table is.

    `source`: the mapping, for messages; `note`: called with one sentence on each doubt about the table. Raises
    `InputError` with the file and the line of the first cell that cannot be converted.
    """
    parts, counts = [], Counts()
    for raw in tables:
        cells = raw.cells.iloc[mapping.header_rows - 1 :]
        check_columns(cells, mapping, study, source)
        counts.rows += len(cells)
        trials = trial_rows(cells, mapping, study)
        counts.left_out["not a trial"] += len(cells) - len(trials)
        part = long_rows(trials, mapping, study)
        if mapping.columns["participant"] == FILE:
            part["participant"] = _stem(raw.source)
        refuse(part["participant"].map(is_missing), raw.source, lambda row: f"participant is empty; {_GIVE_ID}.")
        part, kept = _with_answers(part, mapping, study, raw.source)
        absent = part[~kept]
        counts.missing += Counter(clean(cell) for cell in absent["response"])
        counts.people += Counter(absent["participant"])
        counts.left_out[_NOT_GIVEN] += len(absent)
        parts.append((raw.source, _with_numbers(part[kept].copy(), mapping, study, raw.source)))
    names = list(dict.fromkeys(name for _, part in parts for name in part["participant"]))
    note_forms(names, parts[0][0], note)
    ids = _ids(names, mapping)
    texts = [_finished(part, mapping, study, ids, file) for file, part in parts]
    _check([(file, part) for (file, _), part in zip(parts, texts, strict=True)], study, note)
    table = pd.concat(texts, ignore_index=True)
    record = record_of(tables, mapping, study.hash, table, ids, counts)
    return Imported(table, ids, record, sentences_of(record, counts.people))


def _stem(source: str) -> str:
    """Name of a file without its folder and suffix."""
    return re.sub(r"\.[^.]*$", "", re.split(r"[\\/]", source)[-1])


# Cells.


def _with_answers(
    part: pd.DataFrame, mapping: Mapping, study: StudyFile, source: str
) -> tuple[pd.DataFrame, "pd.Series[bool]"]:
    """Responses by the mapping; and the Boolean rows that stay, which are all but missing ones that the study file does
    not name. Raises `InputError` for a cell that is no response."""
    marks = {plain(cell) for cell in mapping.missing}
    meant = {plain(cell): label for cell, label in mapping.responses.items()}
    exact = {plain(form): form for form in answer_forms(study.responses)[0]} if not _from_zero(mapping, study) else {}
    kept_marks = {plain(cell): cell for cell in study.missing}
    answers, stays = [], []
    for row, cell in zip(part.index, part["response"], strict=True):
        form = plain(cell)
        whole = re.sub(r"(?<=\d)[.,]0+$", "", form)
        label = meant.get(form) or meant.get(whole) or exact.get(form) or exact.get(whole)
        absent = label is None and told_missing(cell, marks | kept_marks.keys())
        if label is None and not absent:
            raise InputError(
                f'{place(source, row)}response is "{cell}"; write in [responses] of the mapping what it means, or add'
                " it to missing."
            )
        if label is not None and label not in study.responses and label not in exact.values():
            raise InputError(
                f'[responses] of the mapping has "{label}", which is no response of the study; correct it.'
            )
        answers.append(label if label is not None else kept_marks.get(form, cell))
        stays.append(not absent or form in kept_marks)
    return part.assign(response=answers), pd.Series(stays, part.index, dtype=bool)


def _from_zero(mapping: Mapping, study: StudyFile) -> bool:
    """Whether the mapping reads ranks from 0, so that a rank that it does not name is no response."""
    return mapping.responses.get("0") == study.responses[0]


def _with_numbers(part: pd.DataFrame, mapping: Mapping, study: StudyFile, source: str) -> pd.DataFrame:
    """Parameters in the study's units and with points, levels by their names; from [stimuli] where the table names
    stimuli. Raises `InputError`."""
    if STIMULUS in part:
        for name in (p.name for p in study.space.parameters):
            part[name] = [
                _of_stimulus(stimulus, name, mapping, place(source, row)) for row, stimulus in part[STIMULUS].items()
            ]
    _check_marks(part, numeric_names(study), mapping, source)
    for p in study.space.parameters:
        part[p.name] = [_value(cell, p, mapping, place(source, row)) for row, cell in part[p.name].items()]
    return part


def _of_stimulus(stimulus: str, name: str, mapping: Mapping, where: str) -> str:
    """A stimulus' value of a parameter, with the decimal mark of the table. Raises `InputError` if it is not stated."""
    value = mapping.stimuli.get(stimulus, {}).get(name, "")
    if value == "":
        raise InputError(f'{where}stimulus "{stimulus}" has no {name}; write it in [stimuli] of the mapping.')
    return value if isinstance(value, str) else repr(value).replace(".", mapping.decimal)


def _check_marks(part: pd.DataFrame, names: Sequence[str], mapping: Mapping, source: str) -> None:
    """Raise `InputError` for a number with the other decimal mark than the mapping's; with both cells if there are
    both."""
    other = "." if mapping.decimal == "," else ","
    cells = [(row, name, cell) for name in names for row, cell in part[name].items()]
    wrong = next((each for each in cells if is_decimal(each[2], other)), None)
    if wrong is None:
        return
    right = next((f' beside "{cell}"' for _, _, cell in cells if is_decimal(cell, mapping.decimal)), "")
    words = {",": "comma", ".": "point"}
    raise InputError(
        f'{place(source, wrong[0])}{wrong[1]} is "{wrong[2]}"{right}, but the decimal mark is the'
        f" {words[mapping.decimal]}; write all numbers with one mark, or correct decimal in the mapping."
    )


def _value(cell: str, parameter: Parameter, mapping: Mapping, where: str) -> str:
    """A parameter's cell as the text of a number in the study's unit, or as a level's name. Raises `InputError`."""
    if parameter.levels:
        return mapping.levels.get(parameter.name, {}).get(cell) or cell
    text = cell.removesuffix(parameter.unit).rstrip() if parameter.unit else cell
    text = text.replace(",", ".") if mapping.decimal == "," else text
    factor = mapping.factors.get(parameter.name, 1.0)
    if factor == 1.0:
        return text
    try:
        return str(float(Decimal(text) * Decimal(repr(factor))))
    except InvalidOperation as error:
        raise InputError(f'{where}{parameter.name} is "{cell}"; it must be a number.') from error


# Participants and trials.


def _ids(names: Sequence[str], mapping: Mapping) -> dict[str, str]:
    """Id in the export -> id in the table, for ids that are not as written; codes are P001, P002, … in the order of the
    table."""
    if mapping.ids == "as written":
        return {}
    if mapping.ids == "normal":
        return {name: re.sub(r"(?<=\d)[.,]0+$", "", id_form(name)) for name in names}
    width = max(3, len(str(len(names))))
    return {name: f"P{number:0{width}d}" for number, name in enumerate(names, 1)}


def _finished(part: pd.DataFrame, mapping: Mapping, study: StudyFile, ids: dict[str, str], source: str) -> pd.DataFrame:
    """The columns of a trial table, in their order, with the ids and the numbers of trials. Raises `InputError`."""
    if ids:
        part = part.assign(participant=part["participant"].map(ids))
    if "trial" in part:
        part = part.assign(trial=[_trial(cell, mapping, place(source, row)) for row, cell in part["trial"].items()])
    else:
        order = part.groupby(["participant", *({"session", "material"} & set(part.columns))]).cumcount() + 1
        part = part.assign(trial=order.astype(str))
    names = ["participant", "trial", "response", *(p.name for p in study.space.parameters)]
    more = [name for name in part.columns if name not in (*names, STIMULUS)]
    return part[[*names, *more]]


def _trial(cell: str, mapping: Mapping, where: str) -> str:
    """A trial's number, counted from 1. Raises `InputError`."""
    if not re.fullmatch(r"\d+([.,]0+)?", cell):
        raise InputError(f'{where}trial is "{cell}"; it must be a whole number.')
    return str(int(re.split("[.,]", cell)[0]) + 1 - mapping.trials_from)


def _check(parts: Sequence[tuple[str, pd.DataFrame]], study: StudyFile, note: Callable[[str], object]) -> None:
    """Check the rows of each file as a trial table is checked, so that mistakes are named with its line; and those of
    several files together. Raises `InputError`."""
    groups = [(source, [part]) for source, part in parts]
    if len(parts) > 1:
        groups.append(("the table", [_numbered(pd.concat([part for _, part in parts]))]))
    for place_of_group, (source, pieces) in enumerate(groups, 1):
        said = note if place_of_group == len(groups) else _silent
        for material in study.materials or (None,):
            named = material is None or any((piece.get("material") == material).any() for piece in pieces)
            if named:
                _check_one(pieces, study if material is None else study.material(material), material, source, said)


def _silent(sentence: str) -> None:
    """Do nothing with a remark."""


def _check_one(
    pieces: Sequence[pd.DataFrame],
    study: StudyFile,
    material: str | None,
    source: str,
    note: Callable[[str], object],
) -> None:
    """Check pieces of a table of one material; `note`: called with remarks. Raises `InputError`; a table without a row
    to fit passes."""
    try:
        trial_table(pieces, study, material, source=source, note=note)
    except NothingToFitError:
        return


def _numbered(piece: pd.DataFrame) -> pd.DataFrame:
    """A piece of a table with rows numbered from 1."""
    return piece.reset_index(drop=True).rename(index=lambda row: row + 1)
