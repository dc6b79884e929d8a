"""Proposal of a mapping: which column of an export is which, from names, cells and the study file. Loads no JAX.

What cannot be told from the export stays open as a question; nothing is guessed where two readings are possible.
"""

import re
from collections.abc import Sequence
from typing import Literal, NamedTuple

import pandas as pd
from msgspec.structs import replace

from hilbo.search.box import Parameter
from hilbo.study.file.reading import StudyFile
from hilbo.study.formats.cell_text import is_decimal
from hilbo.study.importing.answers import answers_of, clean, is_absent, is_missing, levels_of
from hilbo.study.importing.mapping import FILE, Mapping
from hilbo.study.importing.participants import ids_by_default
from hilbo.study.importing.patterns import STIMULUS, filled, is_pattern, matches, runs_of_digits
from hilbo.study.importing.patterns import TRIAL as TRIAL_KEY
from hilbo.study.importing.rows import trial_rows, with_values
from hilbo.study.importing.tools import PARTICIPANT, RESPONSE, TRIAL, Tool, key, named, other_unit, tool_of

__all__ = ["Proposal", "propose"]

_NAMED = 6  # columns or cells that a question names
_OWN = ("session", "phase", "material", "voided", "unblinded")  # columns that a trial table may have
_THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2}([.,]\d{3})+")
_IMPORT_ID = '{"ImportId"'  # begins the cells of the third row of Qualtrics


class Proposal(NamedTuple):
    """A mapping, and missing items in it."""

    mapping: Mapping
    questions: list[str]
    """Sentences on what a user has to fill in; without any the mapping can be used as it is."""


class _Seen(NamedTuple):
    """An export as it is looked at: its columns, its rows without further header rows, and the program."""

    columns: list[str]
    cells: pd.DataFrame
    tool: Tool


def propose(files: Sequence[pd.DataFrame], study: StudyFile) -> Proposal:
    """Propose a mapping for an export. `files`: the rows of each file as text, further header rows included."""
    columns = list(dict.fromkeys(name for cells in files for name in cells.columns))
    tool, first = tool_of(columns), files[0]
    header_rows = tool.header_rows + 2 * bool(len(first) > 1 and (first.iloc[1].str.startswith(_IMPORT_ID)).any())
    rows = [cells.reindex(columns=columns, fill_value="").iloc[header_rows - 1 :] for cells in files]
    seen = _Seen(columns, pd.concat(rows, ignore_index=True), tool)
    questions: list[str] = []
    chosen = {"participant": _participant(seen, len(files), questions)}
    chosen |= _trials(seen, study, chosen["participant"], questions)
    more = (*_OWN, study.random_effect or "")
    chosen |= {name: name for name in more if name in columns and name not in chosen}
    mapping = Mapping({name: column for name, column in chosen.items() if column or name in _needed(study)})
    mapping = replace(mapping, tool=tool.name, header_rows=header_rows, rows=_rows(seen))
    return Proposal(_cells_of(mapping, seen, study, questions), questions)


def _needed(study: StudyFile) -> tuple[str, ...]:
    """Columns of a trial table that a mapping shows even if they are not by_name."""
    return ("participant", "response", *(p.name for p in study.space.parameters))


def _rows(seen: _Seen) -> dict[str, tuple[str, ...]]:
    """Conditions on rows by the program, as far as they leave rows at all."""
    kept = {column: cells for column, cells in seen.tool.rows if column in seen.columns}
    return {column: cells for column, cells in kept.items() if seen.cells[column].isin(cells).any()}


# Which column is which.


def _participant(seen: _Seen, files: int, questions: list[str]) -> str:
    """The column of the participant, or `FILE`; "" with a question if there is none."""
    hits = named(seen.columns, PARTICIPANT[:1]) or named(seen.columns, seen.tool.participant)
    hits = hits or named(seen.columns, PARTICIPANT)
    if len(hits) > 1:
        questions.append(_which("participant", hits, seen.columns))
    if hits:
        return hits[0] if len(hits) == 1 else ""
    if files > 1:
        return FILE
    questions.append(f"no column is known to name the participant ({_some(seen.columns)}): write it in [columns].")
    return ""


def _trials(seen: _Seen, study: StudyFile, participant: str, questions: list[str]) -> dict[str, str]:
    """Key of [columns] ("response", "trial", "stimulus", parameter names) -> column or pattern, "" where it is not
    certain: of a table with a row for each trial, else of one with a row for each participant. Appends a question on
    each uncertain one to `questions`."""
    by_name = {p.name: _parameter(seen, p) for p in study.space.parameters}
    given = [column for columns in by_name.values() for column in columns]
    levels = {column: p.levels for p in study.space.parameters for column in by_name[p.name]}
    seen = seen._replace(cells=with_values(seen.cells, levels))  # other rows may have answers to other questions
    trial = [column for column in named(seen.columns, TRIAL) if _are_whole(seen.cells[column])]
    taken = {participant, *given, *trial}
    hits = [] if _with_parameters(seen.columns, study) else _responses(seen, study, taken)
    wide = {} if hits else _wide(seen, study, participant)
    if not hits and not wide:  # its cells are unknown
        hits = named([column for column in seen.columns if column not in taken], RESPONSE)
    if wide:
        return _wide_parameters(seen, study, wide, questions)
    if len(hits) == 1 and not any(by_name.values()) and (stimulus := named(seen.columns, _STIMULUS)):
        by_name |= {p.name: [] for p in study.space.parameters}
        questions.append(_stimuli_question(stimulus[0]))
        return {"response": hits[0], "trial": next(iter(trial), ""), STIMULUS: stimulus[0]}
    for name, columns in by_name.items():
        if len(columns) != 1:
            questions.append(_which(f"parameter {name}", columns, seen.columns))
    if len(hits) != 1:
        questions.append(_which("response", hits, seen.columns))
    chosen = {name: columns[0] if len(columns) == 1 else "" for name, columns in by_name.items()}
    return {"trial": next(iter(trial), ""), **chosen, "response": hits[0] if len(hits) == 1 else ""}


_STIMULUS = ("stimulus", "stimulusid", "stim", "stimid", "item", "condition", "sample", "image", "video", "rendering")


def _stimuli_question(column: str) -> str:
    """Question for the parameters of the stimuli."""
    return f'"{column}" names the stimuli: write in [stimuli] the parameters of each.'


def _which(what: str, hits: Sequence[str], columns: Sequence[str]) -> str:
    """Question for a column that is missing or not unique."""
    if hits:
        return f"{what} may be in {_some(hits)}: write in [columns] which."
    return f"no column is recognised as the {what} ({_some(columns)}): write it in [columns]."


def _some(names: Sequence[str]) -> str:
    """Names in quotation marks, the first few of them."""
    return ", ".join(f'"{name}"' for name in names[:_NAMED]) + (", …" if len(names) > _NAMED else "")


def _parameter(seen: _Seen, parameter: Parameter) -> list[str]:
    """Columns that may contain a parameter, by their name."""
    hits = named(seen.columns, (parameter.name,), parameter.unit)
    return [column for column in hits if column == parameter.name or not other_unit(column, parameter.unit)]


def _are_whole(cells: pd.Series) -> bool:
    """Whether a column has whole numbers, and beside them only empty cells."""
    given = [clean(cell) for cell in cells if not is_missing(cell)]
    return bool(given) and all(re.fullmatch(r"\d+([.,]0+)?", cell) for cell in given)


def _responses(seen: _Seen, study: StudyFile, taken: set[str]) -> list[str]:
    """Columns, none of them `taken`, that may contain the response: by name, those in which some cell is a response of
    the study (the first one if all have the same cells); else, outside runs of numbered columns, those whose name ends
    as "response" begins and whose cells are all responses; else those that contain only labels and missing marks."""
    free = [column for column in seen.columns if column not in taken]
    answered = [column for column in free if _has_answers(seen, column, study, whole=False)]
    if hits := named(answered, RESPONSE):
        return hits[:1] if all(seen.cells[column].equals(seen.cells[hits[0]]) for column in hits) else hits
    ends = [column for column in free if key(column).endswith(RESPONSE[:3])]
    hits = [column for column in ends if _has_answers(seen, column, study, whole=True)]
    texts = [column for column in free if _has_answers(seen, column, study, whole=True, words=True)]
    wide = {column for names in runs_of_digits(free, TRIAL_KEY).values() for column in names}
    return [column for column in hits or texts if column not in wide]


def _has_answers(seen: _Seen, column: str, study: StudyFile, *, whole: bool, words: bool = False) -> bool:
    """Whether a column has responses of the study; `whole`: no other cells but missing marks; `words`: labels with
    letters only."""
    cells = [cell for cell in seen.cells[column].unique() if not is_missing(cell)]
    if words:
        cells = [cell for cell in cells if re.search(r"[^\W\d_]", cell)]
    answers = answers_of(cells, study.responses, seen.tool.counts_from_zero)
    return bool(cells) and (not answers.unknown if whole else len(answers.unknown) < len(cells))


# Tables with a row for each participant.


def _wide(seen: _Seen, study: StudyFile, participant: str) -> dict[str, list[str]]:
    """Columns of responses of a table with one row for each participant: pattern -> columns; several patterns if it is
    not clear which. Patterns with all parameters come first."""
    free = [column for column in seen.columns if column != participant]
    if pattern := _with_parameters(free, study):
        return {pattern: [*matches(pattern, free, [p.name for p in study.space.parameters])]}
    groups = runs_of_digits(free, TRIAL_KEY)
    good = {
        pattern: names
        for pattern, names in groups.items()
        if all(_has_answers(seen, name, study, whole=True) or _is_empty(seen, name) for name in names)
        and any(_has_answers(seen, name, study, whole=True) for name in names)
        and not any(key(pattern).startswith(key(p.name)) for p in study.space.parameters)
    }
    most = max(map(len, good.values()), default=0)
    return {pattern: names for pattern, names in good.items() if len(names) == most}


def _is_empty(seen: _Seen, column: str) -> bool:
    """Whether a column has no text but missing marks."""
    return all(map(is_missing, seen.cells[column].unique()))


def _with_parameters(columns: Sequence[str], study: StudyFile) -> str:
    """The pattern of columns that have every parameter's name and number in their names, such as
    "hue{hue}_light{light}"; "" if there are none, or if a sign before a number may be a separator."""
    numeric = [p.name for p in study.space.parameters]
    every = [c for c in columns if all(re.search(rf"(?i){re.escape(name)}[ _=:-]*\d", c) for name in numeric)]
    pattern = every[0] if len(every) > 1 else ""
    for p in study.space.parameters:
        sign, name = ("-?" if p.low < 0 else ""), re.escape(p.name)
        if p.low < 0 and any(re.search(rf"(?i){name}-\d", column) for column in every):
            return ""
        pattern = re.sub(rf"(?i)({name}[ _=:-]*?){sign}\d+([.,]\d+)?", rf"\1{{{p.name}}}", pattern, count=1)
    return pattern if len(matches(pattern, every, numeric)) == len(every) > 1 else ""


def _wide_parameters(seen: _Seen, study: StudyFile, wide: dict[str, list[str]], questions: list[str]) -> dict[str, str]:
    """Key of [columns] ("response", parameter names) -> pattern of columns, of a wide table; "" where it is not
    certain, and without the parameters if the response's pattern has no trial, or names stimuli.

    `wide`: of `_wide`, pattern -> columns. Appends questions to `questions`.
    """
    if len(wide) > 1:
        questions.append(f"the responses may be in {_some([*wide])}: write in [columns] which.")
        return {"response": "", **{p.name: "" for p in study.space.parameters}}
    pattern, names = next(iter(wide.items()))
    if f"{{{TRIAL_KEY}}}" not in pattern:
        return {"response": pattern}
    texts = [match[TRIAL_KEY] for match in matches(pattern, names, ()).values()]
    chosen = {}
    for p in study.space.parameters:
        groups = runs_of_digits([column for column in seen.columns if column not in names], TRIAL_KEY)
        hits = [g for g in groups if key(g.replace(f"{{{TRIAL_KEY}}}", "")) in (key(p.name), key(p.name + p.unit))]
        hits = [g for g in hits if all(filled(g, {TRIAL_KEY: text}) in seen.columns for text in texts)]
        chosen |= {p.name: hits[0]} if len(hits) == 1 else {}
    if len(chosen) == len(study.space.parameters):
        return {"response": pattern, **chosen}
    asked = pattern.replace(TRIAL_KEY, STIMULUS)
    questions.append(_stimuli_question(asked))
    return {"response": asked}


# What the cells mean.


def _cells_of(mapping: Mapping, seen: _Seen, study: StudyFile, questions: list[str]) -> Mapping:
    """The mapping with what the cells of its columns mean: responses, missing marks, levels, ids, decimal mark, the
    first trial's number, stimuli. Adds questions."""
    cells = trial_rows(seen.cells, mapping, study)
    if asked := _texts(mapping, cells, "response", study):
        answers = answers_of(asked, study.responses, seen.tool.counts_from_zero)
        unknown = {cell: "" for cell in answers.unknown}
        if doubtful := [cell for cell, label in answers.labels.items() if not label]:
            questions.append(
                f"response {_some(doubtful)} may count from 0 or from 1: write in [responses] what each means."
            )
        if unknown:
            questions.append(
                f"response {_some(answers.unknown)}: write in [responses] what each means, or add it to missing."
            )
        mapping = replace(mapping, responses=answers.labels | unknown, missing=answers.missing)
    levels = {
        p.name: levels_of(_texts(mapping, cells, p.name, study), p.levels) for p in study.space.parameters if p.levels
    }
    for name, (_, unknown) in levels.items():
        if unknown:
            questions.append(f"{name} {_some(unknown)}: write in [levels.{name}] which level each means.")
    given = {name: other | dict.fromkeys(unknown, "") for name, (other, unknown) in levels.items()}
    mapping = replace(mapping, levels={name: texts for name, texts in given.items() if texts})
    numeric = [p.name for p in study.space.parameters if not p.levels]
    numbers = [clean(cell) for name in numeric for cell in _texts(mapping, cells, name, study)]
    return replace(
        mapping,
        ids=ids_by_default(
            [clean(text) for text in _texts(mapping, cells, "participant", study) if clean(text)],
            mapping.columns["participant"],
        ),
        decimal=_decimal(numbers, questions),
        trials_from=0
        if "0" in {re.sub(r"[.,]0+$", "", clean(t)) for t in _texts(mapping, cells, "trial", study)}
        else 1,
        stimuli=_stimuli(mapping, cells, study),
    )


def _texts(mapping: Mapping, cells: pd.DataFrame, name: str, study: StudyFile) -> list[str]:
    """The different cells of a mapping's column, or of all columns that its pattern matches; [] without a column."""
    column = mapping.columns.get(name, "")
    if is_pattern(column, cells.columns):
        columns = list(matches(column, cells.columns, [p.name for p in study.space.parameters if not p.levels]))
    else:
        columns = [column] if column in cells.columns else []
    return list(dict.fromkeys(cell for column in columns for cell in cells[column].unique()))


def _decimal(numbers: Sequence[str], questions: list[str]) -> Literal[".", ","]:
    """The decimal mark of the parameters' cells. Adds a question if both occur, or if a comma may group thousands."""
    marked = {mark: [cell for cell in numbers if is_decimal(cell, mark)] for mark in ",."}
    if marked[","] and marked["."]:
        questions.append(
            f'numbers have decimal commas and points ("{marked[","][0]}", "{marked["."][0]}"): write one of them only.'
        )
    elif marked[","] and all(map(_THOUSANDS.fullmatch, marked[","])):
        questions.append(f'"{marked[","][0]}" may be a thousand or a decimal: write the numbers without such commas.')
    return "," if marked[","] else "."


def _stimuli(mapping: Mapping, cells: pd.DataFrame, study: StudyFile) -> dict[str, dict[str, float | str]]:
    """An entry, to be filled in, for each stimulus that the export names; none if it has the parameters itself."""
    column = mapping.columns.get("response", "")
    if f"{{{STIMULUS}}}" in column:
        names = [match[STIMULUS] for match in matches(column, cells.columns, ()).values()]
    elif STIMULUS in mapping.columns:
        names = [clean(cell) for cell in cells[mapping.columns[STIMULUS]].unique() if not is_absent(cell)]
    else:
        return {}
    return {name: {p.name: "" for p in study.space.parameters} for name in names}
