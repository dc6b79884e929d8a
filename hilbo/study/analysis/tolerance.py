"""Reading a population map: best, mid and worst stimuli, and the tolerance interval of each parameter.

A map is any function `predict(x) -> mean, variance` of the latent score at points (m, d) of the unit cube. *Best* is
the feasible maximum of the mean. *Worst* is the deepest local minimum of the mean in the feasible set at which the map
is informed by responses: sd <= `known` times that without responses. *Mid* is the candidate whose mean is nearest to
the middle of the two, among those at least `apart` from both, and equally known. All three follow from the map alone
(paper, section VI-C).

The *tolerance interval* of a parameter is the connected feasible interval through the optimum on which the highest
response is the most probable one under `predict`, a new participant's function (paper, section VII-C). Along any
parameter but K1 the slice stays passive: K1 is kept where it is passive, and reduced to the passive boundary where it
is not; along K1 the interval ends, one-sided, where the boundary cuts it. Each end has a reason: another response, the
range, or the limit that the next value violates: a constraint of the study, the passive boundary, or the range of
effective damping.
"""

from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from hilbo import acquisition
from hilbo.errors import InputError
from hilbo.numerics.climbing import Choice
from hilbo.numerics.tracing import program
from hilbo.population.newcomer import class_probabilities
from hilbo.population.shared.scale_use import ScaleUse
from hilbo.search.apart import differences
from hilbo.search.space import Bound
from hilbo.study.config import Study

__all__ = ["End", "Predict", "Sets", "Tolerance", "best_mid_worst", "dominant", "slice_through", "tolerance"]

Predict = Callable[[Float[Array, "m d"]], tuple[Float[Array, " m"], Float[Array, " m"]]]
End = Literal["other answer", "range"] | Bound

_STARTS = 24  # minima that are looked into,
_SEPARATE = 0.1  # from starts so far apart
_GRID = 1025  # points of a slice; its ends are then found by bisection
_HALVINGS = 40


class Sets(eqx.Module):
    """Best, mid and worst stimulus: points (3, d) of the unit cube, and mean and sd of the map there."""

    x: Float[Array, "3 d"]
    mean: Float[Array, "3"]
    sd: Float[Array, "3"]


class Tolerance(eqx.Module):
    """The tolerance interval of one parameter, in its physical unit."""

    parameter: str = eqx.field(static=True)
    low: float
    high: float
    low_end: End = eqx.field(static=True)
    high_end: End = eqx.field(static=True)


def best_mid_worst(
    study: Study,
    predict: Predict,
    candidates: Float[Array, "m d"],
    *,
    known: float = 0.8,
    apart: float = 0.2,
    prior: ArrayLike | None = None,
) -> Sets:
    """Best, mid and worst stimulus of a validation session, as the module defines them. Deterministic.

    **Arguments:** `candidates`: feasible points (`search_points`); `known`: largest sd of worst and mid, in units of
    the prior's; `apart`: smallest distance of mid from both, in the unit cube; `prior`: the map's variance without
    responses (`RuleMap.map_prior`), a scalar or (m,), by default one participant's. Raises InputError if no minimum is
    known well enough, or no candidate qualifies as mid.
    """
    candidates = jnp.asarray(candidates)
    mean, sd = _mean_and_sd(predict, candidates)
    limit = known * jnp.sqrt(study.gp.kernel.diagonal(candidates[0]) if prior is None else prior)
    best = _highest(study, predict, candidates, mean)
    minima = _minima(study, predict, candidates, jnp.where(sd <= limit, mean, jnp.inf))
    depth, doubt = _mean_and_sd(predict, minima)
    usable = np.asarray((doubt <= limit) & study.space.feasible(minima))
    if not usable.any():
        raise InputError(
            f"best_mid_worst: the map has no minimum with an sd below {known:g} of the prior's; more answers are"
            " needed, or a larger `known`."
        )
    worst = minima[int(np.argmin(np.where(usable, depth, np.inf)))]
    ends = jnp.stack([best, worst])
    middle = jnp.mean(_mean_and_sd(predict, ends)[0])
    far = (
        jnp.min(jnp.linalg.norm(differences(study.gp.kernel.levels, candidates[:, None], ends[None]), axis=-1), axis=1)
        >= apart
    )
    fits = np.asarray(far & (sd <= limit))
    if not fits.any():
        raise InputError(
            f"best_mid_worst: no point is {apart:g} of the ranges away from both best and worst and known well enough;"
            " use a smaller `apart` or a larger `known`."
        )
    mid = candidates[int(np.argmin(np.where(fits, np.abs(np.asarray(mean - middle)), np.inf)))]
    x = jnp.stack([best, mid, worst])
    return Sets(x, *_mean_and_sd(predict, x))


def dominant(
    study: Study, predict: Predict, x: Float[Array, "m d"], scale: ScaleUse | None = None
) -> Bool[Array, " m"]:
    """Whether the highest response is the most probable one at points (m, d) (paper, section VII-C). `scale`: how
    participants differ in the use of the scale."""
    return _lead(study, predict, x, scale) > 0


def slice_through(
    study: Study, x: Float[Array, " d"], parameter: str, values: Float[Array, " m"]
) -> tuple[Float[Array, "m d"], Bool[Array, " m"]]:
    """Points (m, d): copies of x with the coordinate of `parameter` at `values` (unit scale), and whether each is
    feasible (m,). Where needed, K1 is lowered to the passive boundary, except in slices along K1."""
    space = study.space
    index = space.names.index(parameter)
    points = jnp.broadcast_to(x, (values.shape[0], x.shape[0])).at[:, index].set(values)
    if space.mechanics is not None and parameter != "K1":
        K1 = space.names.index("K1")
        wall = space.from_box(points.at[:, K1].set(1.0))[:, K1]
        points = points.at[:, K1].set(jnp.minimum(points[:, K1], wall))
    return points, space.feasible(points)


def tolerance(
    study: Study, predict: Predict, x: Float[Array, " d"], parameter: str, scale: ScaleUse | None = None
) -> Tolerance | None:
    """Tolerance interval of a parameter through the optimum `x` (d,); None if the highest response is not the most
    probable one there. `scale`: how participants differ in the use of the scale."""
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
    """Mask of the parameter values (unit scale) at which the slice is feasible and the highest response is the most
    probable."""
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
    """Narrow down an interval's end between a value inside and one outside, by 40 bisections; returns both, inside
    first."""
    for _ in range(_HALVINGS):
        middle = (inner + outer) / 2
        if _tolerated(study, predict, x, parameter, jnp.asarray([middle], x.dtype), scale)[0]:
            inner = middle
        else:
            outer = middle
    return inner, outer


@program
def _lead(study: Study, predict: Predict, x: Float[Array, "m d"], scale: ScaleUse | None) -> Float[Array, " m"]:
    """Probability of the highest response minus that of the most probable other one. (m,)."""
    p = class_probabilities(study.gp.likelihood, *predict(x), scale)
    return p[:, -1] - jnp.max(p[:, :-1], axis=1)


@program
def _mean_and_sd(predict: Predict, x: Float[Array, "m d"]) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Mean and standard deviation of the map at the points."""
    mean, variance = predict(x)
    return mean, jnp.sqrt(variance)


@program
def _highest(
    study: Study, predict: Predict, candidates: Float[Array, "m d"], mean: Float[Array, " m"]
) -> Float[Array, " d"]:
    """Feasible maximum of the map's mean, searched from the three highest candidates."""
    return _maximum(study, lambda x: predict(x[None, :])[0][0], candidates, mean, starts=3).x


def _minima(
    study: Study, predict: Predict, candidates: Float[Array, "m d"], depth: Float[Array, " m"]
) -> Float[Array, "s d"]:
    """Local minima (s, d) of the mean, searched downhill from up to 24 separate candidates of small `depth`, inf
    excluding a candidate. Some may repeat; none if all are excluded."""
    points, left = np.asarray(candidates), np.asarray(depth).copy()
    rows = []
    while len(rows) < _STARTS and np.isfinite(left).any():
        rows.append(int(left.argmin()))
        away = differences(study.gp.kernel.levels, points, points[rows[-1]])
        left[np.linalg.norm(away, axis=1) < _SEPARATE] = np.inf
    if not rows:
        return candidates[:0]
    padded = rows + [rows[0]] * (_STARTS - len(rows))  # one shape, one compilation
    return _downhill(study, predict, candidates[np.array(padded)])


@program
def _downhill(study: Study, predict: Predict, starts: Float[Array, "s d"]) -> Float[Array, "s d"]:
    """The local minimum of the mean below each start, (s, d)."""

    def one(x):
        return _maximum(study, lambda x: -predict(x[None, :])[0][0], x[None, :], jnp.zeros(1, x.dtype), 1).x

    return jax.lax.map(one, starts)


def _maximum(
    study: Study,
    height: Callable[[Float[Array, " d"]], Float[Array, ""]],
    candidates: Float[Array, "m d"],
    values: Float[Array, " m"],
    starts: int,
) -> Choice:
    """Feasible maximum of `height`, a function of one point, searched from the `starts` candidates with the largest
    `values`."""
    space = study.space
    return acquisition.maximise(
        values,
        candidates,
        height,
        **space.searched,
        starts=starts,
        steps=300,
    )
