"""Checks of a mapping against the study and the table, before anything is converted. Loads no JAX, no pandas."""

import math
from collections.abc import Collection, Iterator

from hilbo.errors import InputError
from hilbo.study.file.reading import StudyFile
from hilbo.study.importing.mapping import FILE, Mapping
from hilbo.study.importing.patterns import STIMULUS, TRIAL, braces, is_pattern, matches

__all__ = ["check_mapping", "numeric_names"]

_OWN = ("participant", TRIAL, "response", STIMULUS, "session", "phase", "material", "voided", "unblinded")


def numeric_names(study: StudyFile) -> list[str]:
    """Names of the parameters that are numbers."""
    return [p.name for p in study.space.parameters if not p.levels]


def check_mapping(mapping: Mapping, columns: Collection[str], study: StudyFile, source: str) -> None:
    """Raise `InputError` for a mapping that lacks what a trial table needs, names columns that are not in the table,
    or has keys that mean nothing. `columns`: of the table; `source`: the mapping, for messages."""
    for mistake in (
        *_of_columns(mapping, columns, study),
        *_of_needed(mapping, study),
        *_of_copies(mapping, columns, study),
        *_of_values(mapping, study),
    ):
        raise InputError(f"{source}: {mistake}")


def _of_columns(mapping: Mapping, columns: Collection[str], study: StudyFile) -> Iterator[str]:
    """Yield a sentence for each mistake in [columns]. `columns`: of the table."""
    parameters = [p.name for p in study.space.parameters]
    for name, column in mapping.columns.items():
        if name not in (*_OWN, *parameters, study.random_effect):
            yield f"columns.{name} is no column of a trial table; copy others with keep."
        elif column == FILE and name != "participant":
            yield f"columns.{name} is {FILE}, which only the participant may be."
        elif is_pattern(column, columns):
            if other := next((each for each in braces(column) if each not in (*_OWN[1:], *parameters)), None):
                yield f'columns.{name} has "{{{other}}}", which is neither trial, stimulus nor a parameter.'
            if not matches(column, columns, numeric_names(study)):
                yield f'columns.{name} is "{column}", which matches no column of the table.'
        elif column not in columns and column != FILE:
            words = f'"{column}", which is not in the table' if column else "empty"
            yield f"columns.{name} is {words}; write the name of a column."


def _of_needed(mapping: Mapping, study: StudyFile) -> Iterator[str]:
    """Yield a sentence for each column that a trial table needs and that the mapping has neither as a column nor in
    braces."""
    response = mapping.columns.get("response", "")
    in_braces = braces(response)
    by_stimulus = STIMULUS in mapping.columns or STIMULUS in in_braces
    parameters = [] if by_stimulus else [p.name for p in study.space.parameters]
    for name in ("participant", "response", *parameters, *(["material"] if study.materials else [])):
        if name not in mapping.columns and name not in in_braces:
            yield f"columns.{name} is missing; write the name of its column."


def _of_copies(mapping: Mapping, columns: Collection[str], study: StudyFile) -> Iterator[str]:
    """Yield mistakes in rows and keep."""
    if absent := [column for column in (*mapping.rows, *mapping.keep) if column not in columns]:
        yield f'column "{absent[0]}" of rows or keep is not in the table; correct its name.'
    taken = {*_OWN, *(p.name for p in study.space.parameters)}
    if again := [column for column in mapping.keep if column in taken]:
        yield f'keep has "{again[0]}", which is a column of the trial table itself; leave it out.'


def _of_values(mapping: Mapping, study: StudyFile) -> Iterator[str]:
    """Yield mistakes in responses, levels, factors and stimuli."""
    parameters = {p.name: p for p in study.space.parameters}
    for cell, label in mapping.responses.items():
        if label not in study.responses:
            meant = f'"{label}", which is no response of the study' if label else "empty"
            yield f'responses."{cell}" is {meant}; write one of {", ".join(study.responses)}, or list it in missing.'
    for name, levels in mapping.levels.items():
        known = parameters[name].levels if name in parameters else ()
        if wrong := [cell for cell, level in levels.items() if level not in known]:
            listed = f"write one of {', '.join(known)}" if known else "the parameter has no levels"
            yield f'levels.{name}."{wrong[0]}" is no level; {listed}.'
    for name, factor in mapping.factors.items():
        if name not in numeric_names(study):
            yield f"factors.{name} is no parameter with numbers; it may be one of {', '.join(numeric_names(study))}."
        elif not (math.isfinite(factor) and factor > 0):
            yield f"factors.{name} is {factor:g}; it must be a number above 0."
    for stimulus, values in mapping.stimuli.items():
        if other := [name for name in values if name not in parameters]:
            yield f'stimuli."{stimulus}".{other[0]} is no parameter of the study; correct its name.'
