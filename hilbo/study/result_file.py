"""result.json of `hilbo aggregate` as another command reads it: typed, within the study's ranges, unchanged."""

import os
from collections.abc import Mapping
from typing import Annotated

import msgspec
import numpy as np

from hilbo.errors import InputError
from hilbo.study.config import Study
from hilbo.study.text_cells import check_id
from hilbo.study.typed_files import check_values, decoded, read_bytes, unsealed

__all__ = ["FoundOptimum", "FoundPerson", "Result", "read_result"]

_MARGIN = 1e-6  # of the device's damping: what rounding may do to an optimum on the passive boundary
_WHAT = "is no result.json of hilbo; give the one that hilbo aggregate wrote"


class FoundOptimum(msgspec.Struct, frozen=True):
    """An optimum: parameter -> value in physical units."""

    parameters: dict[str, float | None]


class FoundPerson(msgspec.Struct, frozen=True):
    """A participant of the map, and their own optimum if one was sought."""

    participant: str
    optimum: FoundOptimum | None = None


class Result(msgspec.Struct, frozen=True):
    """What other commands take from a result."""

    study: str
    optimum: FoundOptimum
    participants: tuple[FoundPerson, ...]
    seed: Annotated[int, msgspec.Meta(ge=0, lt=2**31)] = 0
    digest: str | None = None


def read_result(path: str | os.PathLike, study: Study) -> Result:
    """A result.json of this study. Raises InputError."""
    source, content = str(path), read_bytes(path)
    found: Result = decoded(content, Result, source, _WHAT)
    unsealed(content, found.digest, source)
    if found.study != study.hash:
        raise InputError(
            f"{path}: is the result of another study ({found.study}, not {study.hash}); aggregate the answers again"
            " with this study file."
        )
    if not found.participants:
        raise InputError(f"{path}: holds no participants; aggregate the answers again.")
    names = [person.participant for person in found.participants]
    for name in names:
        check_id(name, source)
    if len(set(names)) < len(names):
        raise InputError(f"{path}: a participant stands there twice; aggregate the answers again.")
    _check_optimum(study, found.optimum, source, "the optimum")
    for person in found.participants:
        if person.optimum is not None:
            _check_optimum(study, person.optimum, source, f"the optimum of {person.participant}")
    return found


def _check_optimum(study: Study, found: FoundOptimum, source: str, what: str) -> None:
    """Refuse an optimum outside the study's ranges, or one that would not be passive."""
    values = check_values(found.parameters, study.space.parameters, source, what)
    margin = _margin(study, values)
    if margin is not None and not margin >= 0:
        raise InputError(f"{source}: {what} is not passive on the study's device; aggregate the answers again.")


def _margin(study: Study, values: Mapping[str, float]) -> float | None:
    """The passivity margin in N.s/m with the slack that rounding may need; None without mechanics."""
    margin = study.space.passivity_margin({name: np.asarray(value, float) for name, value in values.items()})
    if margin is None or study.space.mechanics is None:
        return None
    return float(margin) + _MARGIN * float(study.space.mechanics.damping)
