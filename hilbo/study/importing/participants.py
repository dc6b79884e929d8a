"""Ids of participants and numbers of trials in a trial table that is made of an export. Loads no JAX."""

import re
from collections import Counter
from collections.abc import Callable, Sequence

import pandas as pd

from hilbo.errors import InputError
from hilbo.study.file.reading import StudyFile
from hilbo.study.formats.cell_text import id_form
from hilbo.study.formats.csv_file import place
from hilbo.study.importing.answers import is_personal_id
from hilbo.study.importing.mapping import FILE, Ids, Mapping
from hilbo.study.importing.patterns import STIMULUS, TRIAL
from hilbo.study.tables.remarks import note_doubtful_ids, note_forms

__all__ = ["finished", "ids_by_default", "new_ids"]


def ids_by_default(names: Sequence[str], column: str) -> Ids:
    """How ids are made unless a mapping states it: new ones if they come from names of files (`column`) or any could be
    traced to a person, without ".0" if all are such numbers."""
    if column == FILE or any(map(is_personal_id, names)):
        return "code"
    return "normal" if names and all(re.fullmatch(r"\d+[.,]0", text) for text in names) else "as written"


def new_ids(names: Sequence[str], mapping: Mapping, source: str, note: Callable[[str], object]) -> dict[str, str]:
    """Id in the export -> id in the table, empty if ids are as written; codes are P001, P002, … in the order of the
    table. `note`: called with remarks on ids that may be those of one participant, which codes no longer show."""
    note_forms(names, source, note)
    how = mapping.ids or ids_by_default(names, mapping.columns["participant"])
    if how == "as written":
        return {}
    if how == "normal":
        return {name: re.sub(r"(?<=\d)[.,]0+$", "", id_form(name)) for name in names}
    note_doubtful_ids(list(names), source, note)
    width = max(3, len(str(len(names))))
    return {name: f"P{number:0{width}d}" for number, name in enumerate(names, 1)}


def finished(
    parts: Sequence[tuple[str, pd.DataFrame]], mapping: Mapping, study: StudyFile, ids: dict[str, str]
) -> list[pd.DataFrame]:
    """For each file (`parts`: name, rows) the columns of a trial table, in their order, with the ids and the numbers of
    trials. Raises `InputError`."""
    given, texts = Counter[tuple[str, ...]](), []
    for source, part in parts:
        if ids:
            part = part.assign(participant=part["participant"].map(ids))
        if TRIAL in part:
            numbers = [_trial(cell, mapping, place(source, row)) for row, cell in part[TRIAL].items()]
        else:
            numbers = _in_order(part, given)
        part = part.assign(trial=numbers)
        names = ["participant", TRIAL, "response", *(p.name for p in study.space.parameters)]
        texts.append(part[[*names, *(name for name in part.columns if name not in (*names, STIMULUS))]])
    return texts


def _in_order(part: pd.DataFrame, given: "Counter[tuple[str, ...]]") -> list[str]:
    """Numbers of the rows of each participant, session and material, in their order; `given`: how many there were in
    earlier files, which is counted on."""
    keys = ["participant", *(name for name in ("session", "material") if name in part)]
    numbers = []
    for row in part[keys].itertuples(index=False, name=None):
        given[row] += 1
        numbers.append(str(given[row]))
    return numbers


def _trial(cell: str, mapping: Mapping, where: str) -> str:
    """A trial's number, counted from 1. Raises `InputError`."""
    if not re.fullmatch(r"\d+([.,]0+)?", cell):
        raise InputError(f'{where}trial is "{cell}"; it must be a whole number.')
    return str(int(re.split("[.,]", cell)[0]) + 1 - mapping.trials_from)
