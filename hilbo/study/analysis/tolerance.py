"""Tolerance interval of each parameter of a population map.

A map is any function `predict(x) -> mean, variance` of the latent score at points (m, d) of the unit cube.

The *tolerance interval* of a parameter is the connected feasible interval through the optimum on which the goal
is the most probable response under `predict`, a new participant's function (paper, section VII-C). Along any
parameter but K1 the slice stays passive: K1 is kept where it is passive, and reduced to the passive boundary where it
is not; along K1 the interval ends, one-sided, where the boundary cuts it. Each end has a reason: another response, the
range, or the limit that the next value violates: a constraint of the study, the passive boundary, or the range of
effective damping.

`tolerance_ends` gives the uncertainty of both ends: participants are resampled, the map is aggregated again from the
same posteriors, and the interval through the same optimum is read off a coarse grid; percentiles over these draws
describe the variation due to the choice of participants. A draw in which the goal is not the most probable response at
the optimum has no interval, and is counted. Nothing is refitted. With one participant all draws are the same, so that
the percentiles are not known.
"""

import math
from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import Posterior
from hilbo.population.newcomer import class_probabilities
from hilbo.population.pointwise import aggregate
from hilbo.population.shared.scale_use import ScaleUse
from hilbo.search.space import Bound
from hilbo.study.config import Study
from hilbo.study.estimate.bootstrap import can_resample

__all__ = ["End", "Ends", "Predict", "Tolerance", "dominant", "slice_through", "tolerance", "tolerance_ends"]

Predict = Callable[[Float[Array, "m d"]], tuple[Float[Array, " m"], Float[Array, " m"]]]
End = Literal["other answer", "range"] | Bound

_GRID = 1025  # points of a slice; its ends are then found by bisection
_HALVINGS = 40
_COARSE, _DRAWS = 257, 200  # points of a slice, and draws, of the bootstrap


class Tolerance(eqx.Module):
    """The tolerance interval of one parameter, in its physical unit."""

    parameter: str = eqx.field(static=True)
    low: float
    high: float
    low_end: End = eqx.field(static=True)
    high_end: End = eqx.field(static=True)


def dominant(
    study: Study, predict: Predict, x: Float[Array, "m d"], scale: ScaleUse | None = None
) -> Bool[Array, " m"]:
    """Whether the goal is the most probable response at points (m, d) (paper, section VII-C). `scale`: how
    participants differ in the use of the scale."""
    return _lead(study, predict, x, scale) > 0


def slice_through(
    study: Study, x: Float[Array, " d"], parameter: str, values: Float[Array, " m"]
) -> tuple[Float[Array, "m d"], Bool[Array, " m"]]:
    """Points (m, d): copies of x with the coordinate of `parameter` at `values` (unit scale), and whether each is
    feasible (m,). Where needed, K1 is lowered to the passive boundary, except in slices along K1. Another
    parameter of an equality follows."""
    space = study.space
    index = space.names.index(parameter)
    points = jnp.broadcast_to(x, (values.shape[0], x.shape[0])).at[:, index].set(values)
    if space.mechanics is not None and parameter != "K1":
        K1 = space.names.index("K1")
        wall = space.from_box(points.at[:, K1].set(1.0))[:, K1]
        points = points.at[:, K1].set(jnp.minimum(points[:, K1], wall))
    points = space.completed(points, (index,))
    return points, space.feasible(points)


def tolerance(
    study: Study, predict: Predict, x: Float[Array, " d"], parameter: str, scale: ScaleUse | None = None
) -> Tolerance | None:
    """Tolerance interval of a parameter through the optimum `x` (d,); None if the goal is not the most probable
    response there. `scale`: how participants differ in the use of the scale."""
    index = study.space.names.index(parameter)
    here, searched = float(x[index]), study.space.parameters[index]
    grid = searched.axis(_GRID) if searched.discrete else np.unique(np.append(np.linspace(0.0, 1.0, _GRID), here))
    inside = _tolerated(study, predict, x, parameter, jnp.asarray(grid, x.dtype), scale)
    middle = int(np.argmin(np.abs(grid - here)))
    if not inside[middle]:
        return None
    ends = []
    for step in (-1, 1):
        last = middle
        while 0 <= last + step < len(grid) and inside[last + step]:
            last += step
        beyond = last + step
        if not 0 <= beyond < len(grid):
            ends.append((grid[last], "range"))
            continue
        inner, outer = grid[last], grid[beyond]
        if not searched.discrete:
            inner, outer = _bisect(study, predict, x, parameter, inner, outer, scale)
        ends.append((inner, _end(study, x, parameter, outer)))
    to_physical = searched.to_physical
    (low, low_end), (high, high_end) = ((float(to_physical(jnp.asarray(end))), kind) for end, kind in ends)
    return Tolerance(parameter, low, high, low_end, high_end)


def _end(study: Study, x: Float[Array, " d"], parameter: str, outer: float) -> End:
    """Reason of an interval's end: the limit that its first outside value `outer` violates, or "other answer"."""
    (point,), _ = slice_through(study, x, parameter, jnp.asarray([outer], x.dtype))
    return study.space.broken(point) or "other answer"


def _tolerated(
    study: Study,
    predict: Predict,
    x: Float[Array, " d"],
    parameter: str,
    values: Float[Array, " m"],
    scale: ScaleUse | None,
) -> Bool[np.ndarray, " m"]:
    """Mask of the parameter values (unit scale) at which the slice is feasible and the goal is the most probable
    response."""
    points, feasible = slice_through(study, x, parameter, values)
    return np.asarray(feasible & dominant(study, predict, points, scale))


def _bisect(
    study: Study,
    predict: Predict,
    x: Float[Array, " d"],
    parameter: str,
    inner: float,
    outer: float,
    scale: ScaleUse | None,
) -> tuple[float, float]:
    """Narrow down an interval's end between a value inside and one outside (unit scale), by 40 bisections; returns
    both, inside first."""
    for _ in range(_HALVINGS):
        middle = (inner + outer) / 2
        if _tolerated(study, predict, x, parameter, jnp.asarray([middle], x.dtype), scale)[0]:
            inner = middle
        else:
            outer = middle
    return inner, outer


@program
def _lead(study: Study, predict: Predict, x: Float[Array, "m d"], scale: ScaleUse | None) -> Float[Array, " m"]:
    """Probability of the goal minus that of the most probable other one. (m,)."""
    p = class_probabilities(study.gp.likelihood, *predict(x), scale)
    goal = study.goal.category
    return p[:, goal] - jnp.max(jnp.delete(p, goal, axis=1), axis=1)


class Ends(eqx.Module):
    """95 % percentile intervals of both ends of a tolerance interval, in the parameter's unit; NaN: not known."""

    low: tuple[float, float]
    high: tuple[float, float]
    lost: float
    """Fraction of draws in which the goal is not the most probable response at the optimum."""


def tolerance_ends(
    study: Study,
    posteriors: Posterior,
    x: Float[Array, " d"],
    parameter: str,
    seed: int = 0,
    *,
    rule: str = "bcm",
    share: ArrayLike | None = None,
    scale: ScaleUse | None = None,
    draws: int = _DRAWS,
) -> Ends | None:
    """Bootstrap over participants of the tolerance interval of a parameter through `x` (d,); None if no draw has an
    interval. With fewer than two participants with responses every number is NaN.

    `rule`: aggregation method that works point by point; `share`: shared variance fraction of the hierarchical one,
    otherwise None; `scale`: how participants differ in the use of the scale.
    """
    if not can_resample(posteriors):
        return Ends((math.nan, math.nan), (math.nan, math.nan), math.nan)
    index = study.space.names.index(parameter)
    grid = study.space.parameters[index].axis(_COARSE)
    if not study.space.parameters[index].discrete:
        grid = np.unique(np.append(grid, float(x[index])))
        grid = np.interp(
            np.linspace(0, 1, _COARSE + 1), np.linspace(0, 1, len(grid)), grid
        )  # one shape, one compilation
    middle = int(np.argmin(np.abs(grid - float(x[index]))))
    points, feasible = slice_through(study, x, parameter, jnp.asarray(grid, x.dtype))
    means, explained, prior = _predictions(posteriors, points)
    count = means.shape[0]
    rows = jax.random.randint(jax.random.key(seed), (draws, count), 0, count)
    inside = np.asarray(_dominant_in_draws(study, means, explained, prior, rows, rule, share, scale)) & np.asarray(
        feasible
    )
    ends = [_ends(row, middle) for row in inside if row[middle]]
    if not ends:
        return None
    physical = np.asarray(study.space.parameters[index].to_physical(jnp.asarray(grid)))
    low, high = (np.percentile(physical[list(side)], [2.5, 97.5]) for side in zip(*ends, strict=True))
    lost = 1 - len(ends) / draws
    return Ends((float(low[0]), float(low[1])), (float(high[0]), float(high[1])), lost)


@program
def _predictions(
    posteriors: Posterior, x: Float[Array, "m d"]
) -> tuple[Float[Array, "M m"], Float[Array, "M m"], Float[Array, " m"]]:
    """Posterior mean and variance reduction (prior - posterior) of each participant, (M, m), and prior variance (m,),
    at points."""
    means, explained = jax.lax.map(lambda p: p.predict_explained(x), posteriors)
    kernel = jax.tree.map(lambda leaf: leaf[0], posteriors.gp).kernel
    return means, explained, jax.vmap(kernel.diagonal)(x)


@program
def _dominant_in_draws(
    study: Study,
    means: Float[Array, "M m"],
    explained: Float[Array, "M m"],
    prior: Float[Array, " m"],
    rows: Int[Array, "draws M"],
    rule: str,
    share: ArrayLike | None,
    scale: ScaleUse | None = None,
) -> Bool[Array, "draws m"]:
    """Whether the goal is the most probable response of a new participant, (draws, m); `rows`: participants of
    each resample."""

    goal = study.goal.category

    def one(chosen):
        mean, variance = aggregate(rule, means[chosen], explained[chosen], prior, share=share)
        apart = jnp.zeros_like(prior) if share is None else (1.0 - share) * prior  # a new person about the map
        p = class_probabilities(study.gp.likelihood, mean, variance + apart, scale)
        return p[:, goal] > jnp.max(jnp.delete(p, goal, axis=1), axis=1)

    return jax.lax.map(one, rows)


def _ends(inside: Bool[np.ndarray, " m"], middle: int) -> tuple[int, int]:
    """First and last index of the run of True values through `middle`."""
    outside = np.flatnonzero(~inside)
    below, above = outside[outside < middle], outside[outside > middle]
    first = int(below[-1]) + 1 if len(below) else 0
    return first, int(above[0]) - 1 if len(above) else len(inside) - 1
