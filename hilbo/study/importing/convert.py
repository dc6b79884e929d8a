"""Conversion of an export to a trial table by a mapping, and the record of the actions taken. Loads no JAX."""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from collections.abc import Mapping as MappingLike
from decimal import Decimal, InvalidOperation
from typing import NamedTuple

import pandas as pd

from hilbo.errors import InputError
from hilbo.search.box import Parameter
from hilbo.study.file.reading import StudyFile
from hilbo.study.formats.cell_text import is_decimal
from hilbo.study.formats.csv_file import answer_forms, place, refuse
from hilbo.study.formats.json_file import Content
from hilbo.study.importing.answers import clean, is_missing, plain, told_missing
from hilbo.study.importing.checks import check_mapping, numeric_names
from hilbo.study.importing.mapping import FILE, Mapping
from hilbo.study.importing.participants import finished, new_ids
from hilbo.study.importing.patterns import STIMULUS
from hilbo.study.importing.raw import RawTable
from hilbo.study.importing.record import Counts, record_of, sentences_of
from hilbo.study.importing.rows import long_rows, trial_rows
from hilbo.study.tables.trials import NothingToFitError, trial_table

__all__ = ["Imported", "converted"]

_NOT_GIVEN = "missing response"
_NO_TRIAL = "without a value of a parameter, or excluded by [rows]"
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
        check_mapping(mapping, cells.columns, study, source)
        counts.rows += len(cells)
        trials = trial_rows(cells, mapping, study)
        counts.left_out[_NO_TRIAL] += len(cells) - len(trials)
        part = long_rows(trials, mapping, study)
        if mapping.columns["participant"] == FILE:
            part["participant"] = _stem(raw.source)
        _check_participants(part, raw.source)
        part, kept = _with_answers(part, mapping, study, raw.source)
        absent = part[~kept]
        counts.missing += Counter(clean(cell) for cell in absent["response"])
        counts.people += Counter(absent["participant"])
        counts.left_out[_NOT_GIVEN] += len(absent)
        parts.append((raw.source, _with_numbers(part[kept].copy(), mapping, study, raw.source)))
    names = list(dict.fromkeys(name for _, part in parts for name in part["participant"]))
    ids = new_ids(names, mapping, parts[0][0], note)
    texts = finished(parts, mapping, study, ids)
    _check([(file, part) for (file, _), part in zip(parts, texts, strict=True)], study, note)
    table = pd.concat(texts, ignore_index=True)
    record = record_of(tables, mapping, study, table, ids, counts)
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
    exact = {plain(form): form for form in _forms(mapping, study)}
    kept_marks = {plain(cell): cell for cell in study.missing}
    answers, stays = [], []
    for row, cell in zip(part.index, part["response"], strict=True):
        forms = (plain(cell), re.sub(r"(?<=\d)[.,]0+$", "", plain(cell)))
        absent = told_missing(cell, marks | kept_marks.keys())
        label = _first(meant, forms) or (None if absent else _first(exact, forms))
        kept = _first(kept_marks, forms)
        if label is None and not absent:
            raise InputError(
                f'{place(source, row)}response is "{cell}"; write in [responses] of the mapping what it means, or add'
                " it to missing."
            )
        answers.append(label or kept or cell)
        stays.append(label is not None or kept is not None)
    return part.assign(response=answers), pd.Series(stays, part.index, dtype=bool)


def _first(known: MappingLike[str, str], forms: Sequence[str]) -> str | None:
    """The entry of the first of these forms that has one; None if none has."""
    return next((known[form] for form in forms if form in known), None)


def _forms(mapping: Mapping, study: StudyFile) -> Iterable[str]:
    """Cells that are responses without an entry in the mapping: labels and ranks from 1; labels only if the mapping has
    an entry for a number that means another rank."""
    ranks = {str(rank): label for rank, label in enumerate(study.responses, 1)}
    other = any(cell in map(str, range(100)) and ranks.get(cell) != label for cell, label in mapping.responses.items())
    return study.responses if other else answer_forms(study.responses)[0]


def _check_participants(part: pd.DataFrame, source: str) -> None:
    """Raise `InputError` for a row whose participant is empty or a mark of a missing value."""
    names = part["participant"]
    refuse(names.map(is_missing), source, lambda row: f'participant is "{part.at[row, "participant"]}"; {_GIVE_ID}.')


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
    """A parameter's cell without its unit as the text of a number in the study's unit, or as a level's name. Raises
    `InputError` for a text that has to be multiplied by a factor and is no number; other texts are not checked."""
    if parameter.levels:
        return mapping.levels.get(parameter.name, {}).get(cell, cell)
    text = cell.removesuffix(parameter.unit).rstrip() if parameter.unit else cell
    text = text.replace(",", ".") if mapping.decimal == "," else text
    factor = mapping.factors.get(parameter.name, 1.0)
    if factor == 1.0:
        return text
    try:
        return str(float(Decimal(text) * Decimal(repr(factor)) if "_" not in text else Decimal("no number")))
    except InvalidOperation as error:
        raise InputError(f'{where}{parameter.name} is "{cell}"; it must be a number.') from error


# The whole table.


def _check(parts: Sequence[tuple[str, pd.DataFrame]], study: StudyFile, note: Callable[[str], object]) -> None:
    """Check the rows of each file as a trial table is checked, so that mistakes are named with its line; and those of
    several files together. Raises `InputError`."""
    groups = [(source, [part]) for source, part in parts]
    listed = f"it must be one of {', '.join(study.materials)}"
    if len(parts) > 1:
        groups.append(("the table", [_numbered(pd.concat([part for _, part in parts]))]))
    for number, (source, pieces) in enumerate(groups, 1):
        said = note if number == len(groups) else _silent
        if not study.materials:
            _check_one(pieces, study, None, source, said)
        for piece in pieces if study.materials else ():
            unknown = ~piece["material"].isin(study.materials)
            refuse(unknown, source, lambda row, piece=piece: f'material is "{piece.at[row, "material"]}"; {listed}.')
        for material in study.materials:
            if any((piece["material"] == material).any() for piece in pieces):
                _check_one(pieces, study.material(material), material, source, said)


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
