"""result.json of `hilbo aggregate` as read by other commands: parsed, and checked against the study and for changes."""

import os
from typing import Annotated

import msgspec
import numpy as np

from hilbo.errors import InputError
from hilbo.study.config import Study
from hilbo.study.formats.cell_text import check_id
from hilbo.study.formats.json_file import check_seal, check_values, decoded, read_bytes

__all__ = ["FoundOptimum", "FoundPerson", "Result", "read_result"]

_MARGIN = 1e-6  # of the device's damping: what rounding may do to an optimum on the passive boundary
_WHAT = "is no result.json of hilbo; give the one that hilbo aggregate wrote"


class FoundOptimum(msgspec.Struct, frozen=True):
    """An optimum: parameter -> value in physical units, levels by name."""

    parameters: dict[str, float | str | None]


class FoundPerson(msgspec.Struct, frozen=True):
    """A participant, and their individual optimum if one was computed."""

    participant: str
    optimum: FoundOptimum | None = None


class Result(msgspec.Struct, frozen=True):
    """The part of a result.json that other commands use."""

    study: str
    meaning: str
    goal: str
    optimum: FoundOptimum
    participants: tuple[FoundPerson, ...]
    seed: Annotated[int, msgspec.Meta(ge=0, lt=2**31)] = 0
    digest: str | None = None
    rule: str | None = None


def read_result(path: str | os.PathLike, study: Study) -> Result:
    """Read and check the result.json of this study. Raises InputError for a file that cannot be read, was changed, or
    is of a study whose responses mean something else, for no, invalid or repeated participants, and for optima that
    are out of range or not passive."""
    source, content = str(path), read_bytes(path)
    result: Result = decoded(content, Result, source, _WHAT)
    check_seal(content, result.digest, source)
    if result.meaning != study.file.meaning:
        raise InputError(
            f"{path}: is the result of another study ({result.study}, not {study.file.hash}), in which responses mean"
            " something else; aggregate the answers again with this study file."
        )
    if result.goal != study.goal_label:
        raise InputError(
            f'{path}: is the optimum of "{result.goal}", and the study\'s goal is "{study.goal_label}"; aggregate the'
            " answers again."
        )
    if not result.participants:
        raise InputError(f"{path}: contains no participants; aggregate the answers again.")
    names = [person.participant for person in result.participants]
    for name in names:
        check_id(name, source)
    if len(set(names)) < len(names):
        raise InputError(f"{path}: a participant is there twice; aggregate the responses again.")
    _check_optima(study, result, source)
    return result


def _check_optima(study: Study, result: Result, source: str) -> None:
    """Raise InputError for an optimum outside the study's ranges, or one that is not passive on the study's device."""
    named = {"the optimum": result.optimum} | {
        f"the optimum of {person.participant}": person.optimum for person in result.participants if person.optimum
    }
    rows = [check_values(optimum.parameters, study.space.parameters, source, what) for what, optimum in named.items()]
    columns = {name: np.array([row[name] for row in rows]) for name in study.space.names}
    margins = study.space.passivity_margin(columns)
    if margins is None or study.space.mechanics is None:
        return
    bad = ~(np.asarray(margins) >= -_MARGIN * float(study.space.mechanics.damping))
    if bad.any():
        what = list(named)[int(bad.argmax())]
        raise InputError(f"{source}: {what} is not passive on the study's device; aggregate the answers again.")
