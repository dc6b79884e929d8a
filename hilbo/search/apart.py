"""Distances between points of the unit cube, of which some coordinates may be categorical."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from hilbo.numerics.host import namespace_of, to_device
from hilbo.search.box import Parameter

__all__ = ["differences", "levels_of", "middle_of", "nrmse"]


def levels_of(parameters: Sequence[Parameter]) -> tuple[int, ...]:
    """Number of unordered levels of each parameter, 0 for a numeric or ordered one; an empty tuple if all are 0."""
    counts = tuple(p.steps if p.categorical else 0 for p in parameters)
    return counts if any(counts) else ()


def differences(
    levels: tuple[int, ...], x: Float[Any, "*#batch d"], y: Float[Any, "*#batch d"], apart: float = 1.0
) -> Float[Any, "... d"]:
    """x - y by coordinate, (..., d), in the unit cube; for categorical ones `apart` if the levels differ, else 0.

    `levels`: as from `levels_of`; an empty tuple for numeric coordinates alone.
    """
    if not levels:
        return x - y
    xp = namespace_of(x, y)

    def part(i: int, count: int) -> Float[Any, "..."]:
        here, there = x[..., i], y[..., i]
        if not count:
            return here - there
        return xp.where(xp.round(here * (count - 1)) == xp.round(there * (count - 1)), 0.0, apart).astype(x.dtype)

    return xp.stack([part(i, count) for i, count in enumerate(levels)], axis=-1)


def nrmse(x: Float[Any, "*#batch d"], y: Float[Any, "*#batch d"], levels: tuple[int, ...] = ()) -> Float[Array, "..."]:
    """NRMSE between points of the unit cube: root mean square of `differences` over the coordinates.

    `x`, `y` (..., d) -> a JAX array (...,); `levels` as from `levels_of`.
    """
    away = differences(levels, np.asarray(x), np.asarray(y))
    return to_device(np.sqrt(np.mean(away**2, axis=-1)))


def middle_of(levels: tuple[int, ...], x: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " d"]:
    """Mean of points (n, d) by coordinate, (d,); for a categorical coordinate its most frequent value.

    `levels`: as from `levels_of`. Of equally frequent values the lowest is taken.
    """
    middle = x.mean(axis=0)
    for i in (i for i, count in enumerate(levels) if count):
        values, counts = np.unique(x[:, i], return_counts=True)
        middle[i] = values[counts.argmax()]
    return middle
