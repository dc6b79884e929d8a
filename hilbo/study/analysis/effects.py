"""Effect of each parameter on a population map: along a slice through the optimum, and averaged over the other
parameters.

The *main effect* of a value is the mean of the map over even points of the feasible set whose coordinate is set to that
value, without those that become infeasible (partial dependence; Friedman 2001, Ann. Statist. 29:1189, section 8.2).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hilbo.study.analysis.tolerance import slice_through
from hilbo.study.config import Study

__all__ = ["Effect", "effects_of"]

_VALUES, _POINTS = 33, 128  # along a continuous parameter, and even points that a main effect is the mean over


class Effect(NamedTuple):
    """Effect of one parameter: values in physical units (k,), the map's mean and sd (k,) along the slice, and the main
    effect (k,); NaN where the points are infeasible."""

    parameter: str
    values: Float[np.ndarray, " k"]
    mean: Float[np.ndarray, " k"]
    sd: Float[np.ndarray, " k"]
    average: Float[np.ndarray, " k"]

    @property
    def size(self) -> float:
        """Range (maximum - minimum) of the main effect, without NaN."""
        return float(np.nanmax(self.average) - np.nanmin(self.average))


def effects_of(
    study: Study, surface: Callable[..., Any], optimum: Float[np.ndarray, " d"], seed: int = 0
) -> tuple[Effect, ...]:
    """Effects of all parameters on a map, in their order. `surface`: function of points (m, d) of the unit cube that
    returns mean and variance (m,); `optimum` (d,): point through which slices go."""
    points = study.space.candidates(_POINTS, seed)
    return tuple(_effect(study, surface, np.asarray(optimum), points, i) for i in range(study.space.dim))


def _effect(study, surface, optimum, points, i) -> Effect:
    """Slice through `optimum` (d,) along the parameter with index `i`, and its main effect, averaged over the feasible
    `points` (n, d). `surface`: as in `effects_of`."""
    parameter = study.space.parameters[i]
    axis = parameter.axis(_VALUES)
    along, allowed = slice_through(study, jnp.asarray(optimum), parameter.name, jnp.asarray(axis))
    others = np.repeat(points[None], len(axis), axis=0)
    others[..., i] = axis[:, None]
    rows = np.asarray(study.space.completed(others.reshape(-1, study.space.dim), (i,)))
    mean, variance = (np.asarray(m) for m in surface(jnp.concatenate([along, jnp.asarray(rows)])))
    usable = np.asarray(study.space.feasible(rows)).reshape(len(axis), -1)
    heights = np.where(usable, mean[len(axis) :].reshape(usable.shape), 0.0)
    counts = usable.sum(axis=1)
    average = np.where(counts > 0, heights.sum(axis=1) / np.maximum(counts, 1), np.nan)
    here = np.asarray(allowed)
    return Effect(
        parameter.name,
        np.asarray(parameter.to_physical(axis)),
        np.where(here, mean[: len(axis)], np.nan),
        np.where(here, np.sqrt(variance[: len(axis)]), np.nan),
        average,
    )
