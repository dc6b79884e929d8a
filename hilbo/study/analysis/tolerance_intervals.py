"""Tolerance intervals with their sampling uncertainty, by a bootstrap over participants.

`tolerance.tolerance` reads the interval from a population map. Here participants are resampled, the map is aggregated
again from the same posteriors, and the interval through the same optimum is read off a grid; percentiles of its ends
over these draws describe the variation due to the choice of participants. A draw in which the highest response is not
the most probable one at the optimum has no interval, and is counted. Nothing is refitted. With one participant all
draws are the same, so that the percentiles are not known.
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
from hilbo.population.newcomer import class_probabilities
from hilbo.population.pointwise import aggregate
from hilbo.population.shared.scale_use import ScaleUse
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
    """Fraction of draws in which the highest response is not the most probable one at the optimum."""


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
    grid = study.space.parameters[index].axis(_GRID)
    if not study.space.parameters[index].discrete:
        grid = np.unique(np.append(grid, float(x[index])))
        grid = np.interp(np.linspace(0, 1, _GRID + 1), np.linspace(0, 1, len(grid)), grid)  # one shape, one compilation
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
    """Whether the highest response is the most probable one of a new participant, (draws, m); `rows`: participants of
    each resample."""

    def one(chosen):
        mean, variance = aggregate(rule, means[chosen], explained[chosen], prior, share=share)
        apart = jnp.zeros_like(prior) if share is None else (1.0 - share) * prior  # a new person about the map
        p = class_probabilities(study.gp.likelihood, mean, variance + apart, scale)
        return p[:, -1] > jnp.max(p[:, :-1], axis=1)

    return jax.lax.map(one, rows)


def _ends(inside: Bool[np.ndarray, " m"], middle: int) -> tuple[int, int]:
    """First and last index of the run of True values through `middle`."""
    outside = np.flatnonzero(~inside)
    below, above = outside[outside < middle], outside[outside > middle]
    first = int(below[-1]) + 1 if len(below) else 0
    return first, int(above[0]) - 1 if len(above) else len(inside) - 1
