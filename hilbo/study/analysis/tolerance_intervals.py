"""Tolerance intervals with their uncertainty: how far a parameter may move, had other people of this kind been asked.

`tolerance.tolerance` reads the interval from a population map. Here people are resampled (a bootstrap), the map is
aggregated anew from the same posteriors, and the interval through the same optimum is read off a grid; percentiles of
its ends over these draws are what the choice of participants leaves open. A draw in which the highest answer is not the
likeliest at the optimum has no interval, and counts as such. Nothing is refitted: aggregation is a sum over people.
One person says nothing of others, of whom all draws are the same: there the percentiles are not known.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import Posterior
from hilbo.population.pointwise import aggregate
from hilbo.study.analysis.bootstrap import can_resample
from hilbo.study.analysis.tolerance import slice_through
from hilbo.study.config import Study

__all__ = ["Ends", "tolerance_ends"]

_GRID = 257
_DRAWS = 200


class Ends(eqx.Module):
    """95 % percentile intervals of both ends of a tolerance interval, in the parameter's unit; NaN: not known."""

    low: tuple[float, float]
    high: tuple[float, float]
    lost: float
    """Share of draws in which the highest answer is not the likeliest at the optimum."""


def tolerance_ends(
    study: Study,
    posteriors: Posterior,
    x: Float[Array, " d"],
    parameter: str,
    seed: int = 0,
    *,
    rule: str = "bcm",
    share: ArrayLike | None = None,
    draws: int = _DRAWS,
) -> Ends | None:
    """Bootstrap over people of the tolerance interval of a parameter through `x` (d,); None if no draw has one. With
    fewer than two people with answers every number is NaN.

    `share` is the hierarchical rule's.
    """
    if not can_resample(posteriors):
        return Ends((math.nan, math.nan), (math.nan, math.nan), math.nan)
    index = study.space.names.index(parameter)
    grid = study.space.parameters[index].axis(_GRID)
    if not study.space.parameters[index].discrete:
        grid = np.unique(np.append(grid, float(x[index])))
        grid = np.interp(np.linspace(0, 1, _GRID + 1), np.linspace(0, 1, len(grid)), grid)  # one shape, one compilation
    middle = int(np.argmin(np.abs(grid - float(x[index]))))
    points, feasible = slice_through(study, x, parameter, jnp.asarray(grid, x.dtype))
    means, explained, prior = _predictions(posteriors, points)
    count = means.shape[0]
    rows = jax.random.randint(jax.random.key(seed), (draws, count), 0, count)
    inside = np.asarray(_dominant_in_draws(study, means, explained, prior, rows, rule, share)) & np.asarray(feasible)
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
    """Posterior mean and variance reduction (prior minus posterior) of each person, and prior variance, at points."""
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
) -> Bool[Array, "draws m"]:
    """Whether the highest answer is the likeliest one, (draws, m)."""

    def one(chosen):
        mean, variance = aggregate(rule, means[chosen], explained[chosen], prior, share=share)
        apart = jnp.zeros_like(prior) if share is None else (1.0 - share) * prior  # a new person about the map
        p = jax.vmap(study.gp.likelihood.class_probabilities)(mean, variance + apart)
        return p[:, -1] > jnp.max(p[:, :-1], axis=1)

    return jax.lax.map(one, rows)


def _ends(inside: Bool[np.ndarray, " m"], middle: int) -> tuple[int, int]:
    """First and last place of the connected run through `middle`."""
    outside = np.flatnonzero(~inside)
    below, above = outside[outside < middle], outside[outside > middle]
    first = int(below[-1]) + 1 if len(below) else 0
    return first, int(above[0]) - 1 if len(above) else len(inside) - 1
