"""Warm start of a new participant's session from the population's map; it affects only the choice of renderings.

A new participant's score is modelled as the population's g and an individual deviation h, f = g + h, where the variance
of h is the share 1 - p of the prior's, k. The prediction of f at a point before the first answer is then

    m0 = mean of the map,    v0 = variance of the map + (1 - p) k,

which replaces the prior in the formula of the committee (bcm): with the participant's own posterior m, v under the
study's prior k,

    1 / s = 1 / v0 + (1 / v - 1 / k),    mu = s (m0 / v0 + m / v).

The next rendering has the highest mu + weight · sqrt(s) among fixed feasible points; without answers mu = m0, s = v0.
Where the map has no information, this differs from a cold start only by p. Each point is treated by itself, as in the
committee: what one answer tells about h at other points follows from the study's kernel.

Aggregation, reports and the participant's own optimum are computed from their answers under the study's prior only;
docs/guides/sessions.md has how many trials a warm start saves (benchmarks/warm_start.py).
"""

import os

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hilbo.errors import InputError
from hilbo.ordinal_gp import Posterior
from hilbo.population.rules.registry import RULES
from hilbo.search.apart import differences
from hilbo.search.candidates import search_points
from hilbo.study.config import Study
from hilbo.study.formats.json_file import digest_of, read_bytes

__all__ = ["SHARE", "WarmStart", "informed", "read_warm_start", "warm_point", "warm_start"]

SHARE = 0.5
"""p: the part of the prior variance that people are taken to have in common."""


class WarmStart(eqx.Module):
    """Candidates (m, d) of the unit cube, and the map's prediction there before the first answer: m0 and v0, (m,)."""

    points: Float[Array, "m d"]
    mean: Float[Array, " m"]
    variance: Float[Array, " m"]
    source: str = eqx.field(static=True)
    """Start of the SHA-256 of the map's file, or another name for it, as in the log."""


def warm_start(
    study: Study,
    points: Float[Array, "m d"],
    mean: Float[Array, " m"],
    variance: Float[Array, " m"],
    source: str = "",
    share: float = SHARE,
) -> WarmStart:
    """Create a warm start from the map's latent mean and variance, (m,), at candidates `points` (m, d) of the unit
    cube.

    The individual variance (1 - p) k is added to `variance`; `share` is p. `source`: name of the map.
    """
    prior = float(study.gp.kernel.diagonal(points[0]))
    return WarmStart(points, mean, variance + (1.0 - share) * prior, source)


def informed(study: Study, warm: WarmStart, posterior: Posterior) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Mean mu and variance s (m,) at the candidates after a participant's answers, whose posterior under the study's
    prior is `posterior`; formulas in the module."""
    mean, explained = posterior.predict_explained(warm.points)
    prior = study.gp.kernel.diagonal(warm.points[0])
    gained = explained / (prior * (prior - explained))
    variance = 1.0 / (1.0 / warm.variance + gained)
    return variance * (warm.mean / warm.variance + mean / (prior - explained)), variance


def warm_point(
    study: Study,
    warm: WarmStart,
    posterior: Posterior,
    excluded: Float[Array, "k d"] | None = None,
    distance: float = 0.0,
) -> Float[Array, " d"]:
    """The candidate (d,) with the highest UCB, by closeness to the goal, after a participant's answers, at least
    `distance` from the points `excluded` (k, d; None: no condition), all in the unit cube; traceable. If none is
    that far, the first candidate."""
    mean, variance = informed(study, warm, posterior)
    score = study.goal.closeness(study.gp.likelihood, mean) + study.file.selection.weight * jnp.sqrt(variance)
    if excluded is not None:
        away = differences(study.gp.kernel.levels, warm.points[:, None, :], excluded[None, :, :])
        squared = jnp.sum(away**2, axis=2)
        score = jnp.where(jnp.all(squared >= distance**2, axis=1), score, -jnp.inf)
    return warm.points[jnp.argmax(score)]


def read_warm_start(path: str | os.PathLike, study: Study, seed: int = 0, share: float = SHARE) -> WarmStart:
    """Read a warm start from the map.nc of a results folder: at its points, or interpolated linearly from its grid at
    points that are drawn with `seed`; `share` as in `warm_start`. Raises InputError for a map of other parameters, for
    a goal between learnt thresholds, or for a damaged file."""
    from scipy.interpolate import RegularGridInterpolator

    from hilbo.study.results.map_netcdf import on_grid, read_map

    if study.goal.is_between and RULES[study.rule].learns:
        raise InputError(
            f'{path}: a map by the rule "{study.rule}" has learnt thresholds, which it does not contain, and the goal'
            f' "{study.goal_label}" is between two of them; start without the map.'
        )
    grid = read_map(path, study)
    source = digest_of(read_bytes(path))
    mean, variance = np.asarray(grid["mean"]), np.asarray(grid["variance"])
    if not on_grid(study.space):
        values = np.stack([grid[name].values for name in study.space.names], axis=-1)
        points = jnp.asarray(study.space.to_unit(values))
        return warm_start(study, points, jnp.asarray(mean), jnp.asarray(variance), source=source, share=share)
    sides = [np.linspace(0.0, 1.0, size) for size in mean.shape]
    points = search_points(study.space, seed)
    at = np.asarray(points)
    values = [jnp.asarray(RegularGridInterpolator(sides, v)(at), points.dtype) for v in (mean, variance)]
    return warm_start(study, points, *values, source=source, share=share)
