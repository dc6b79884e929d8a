"""Levels of a parameter: checks of their names and positions, and ordered levels on the unit scale. Imports no JAX.

The physical number of a level is its index in the list, from 0. Ordered levels lie on one axis, equally spaced or at
the given positions, so that a kernel takes them as it takes numbers; unordered ones are equally far from each other.
"""

import itertools
import math
from collections.abc import Sequence
from typing import Any

from jaxtyping import Real

from hilbo.errors import InputError
from hilbo.numerics.host import namespace_of

__all__ = ["check_levels", "index_at", "position_of"]

_Array = Real[Any, "..."]


def check_levels(path: str, levels: Sequence[str], correlation: float, ordered: bool, at: Sequence[float]) -> None:
    """Raise `InputError` for invalid level names, for a correlation outside (0, 1), and for positions `at` that do not
    rise or do not fit the levels. `path`: of the parameter, begins the text."""
    if len(levels) < 2:
        raise InputError(f"{path}.levels is {list(levels)}; it must have two levels or more.")
    twice = next((level for level in levels if list(levels).count(level) > 1), None)
    if twice is not None:
        raise InputError(f'{path}.levels has "{twice}" twice, give each level once.')
    unseen = next((level for level in levels if level != level.strip() or not level.isprintable()), None)
    if unseen is not None:
        raise InputError(f"{path}.levels has {unseen!r}, a level is a text without blanks around it, on one line.")
    numeral = next((level for level in levels if _reads_as_a_number(level)), None)
    if numeral is not None:
        raise InputError(
            f'{path}.levels has "{numeral}", which reads as a number; name it otherwise, or give low, high and'
            " integer = true."
        )
    if not 0 < correlation < 1:
        raise InputError(f"{path}.correlation is {correlation}; it must be between 0 and 1.")
    if at and not ordered:
        raise InputError(f"{path}.at is of ordered levels; add ordered = true, or leave it out.")
    if at and len(at) != len(levels):
        raise InputError(f"{path}.at is {list(at)}; it must have {len(levels)} numbers, one per level.")
    if not all(low < high for low, high in itertools.pairwise(at)) or not all(map(math.isfinite, at)):
        raise InputError(f"{path}.at is {list(at)}; it must rise from each number to the next.")


def position_of(at: Sequence[float], index: _Array) -> _Array:
    """Levels (array of indices) at the positions `at` on [0, 1], exact at both ends; an index is rounded first."""
    xp = namespace_of(index)
    positions = xp.asarray(_on_unit(at), xp.result_type(1.0, index))
    return positions[xp.clip(xp.round(index), 0, len(at) - 1).astype(int)]


def index_at(at: Sequence[float], unit: _Array) -> _Array:
    """Index, as floats of the shape of `unit`, of the level nearest to values of [0, 1], for levels at the positions
    `at`."""
    xp = namespace_of(unit)
    unit = xp.asarray(unit, xp.result_type(1.0, unit))
    middles = (0.5 * (low + high) for low, high in itertools.pairwise(_on_unit(at)))
    return sum((xp.where(unit > middle, 1.0, 0.0).astype(unit.dtype) for middle in middles), xp.zeros_like(unit))


def _on_unit(at: Sequence[float]) -> list[float]:
    """Rising positions scaled to [0, 1]."""
    return [(position - at[0]) / (at[-1] - at[0]) for position in at]


def _reads_as_a_number(text: str) -> bool:
    """Whether Python can parse the text as a number; "nan" and "inf" count."""
    try:
        float(text)
    except ValueError:
        return False
    return True
