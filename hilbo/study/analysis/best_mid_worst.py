"""Best, mid and worst stimulus of a map, which a validation presents (paper, section VI-C).

*Best* is the feasible maximum of `score`, for the highest response of the mean. *Worst* is the deepest local minimum of
the mean in the feasible set at which the map is informed by responses: sd <= `known` times that without responses.
*Mid* is the candidate whose mean is nearest to the middle of the two, among those at least `apart` from both, and
equally known. All three follow from the map alone. For a goal other than the highest response the closeness to it
replaces the mean.

Where no such minimum exists, as on the map of a participant with few responses, *worst* is a second choice: the lowest
mean among the candidates that are known and at least `apart` from the best. Where no candidate fulfils a condition, the
best-known tenth of the candidates replaces the known ones, and the farthest candidates those that are far enough.
"""

from collections.abc import Callable
from functools import partial

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
from hilbo.search.apart import differences
from hilbo.study.analysis.tolerance import Predict
from hilbo.study.config import Study
from hilbo.study.estimate.optimum import score

__all__ = ["Sets", "best_mid_worst", "second_choice_sentence"]

_STARTS = 24  # minima that are looked into,
_SEPARATE = 0.1  # least distance between starts
_BEST_KNOWN = 0.1  # of the candidates, those with the smallest sd, where none is known


class Sets(eqx.Module):
    """Best, mid and worst stimulus: points (3, d) of the unit cube, and mean and sd of the map there.

    `second_choice`: those of "mid" and "worst" that do not meet the definition.
    """

    x: Float[Array, "3 d"]
    mean: Float[Array, "3"]
    sd: Float[Array, "3"]
    second_choice: tuple[str, ...] = eqx.field(static=True, default=())


def best_mid_worst(
    study: Study,
    predict: Predict,
    candidates: Float[Array, "m d"],
    *,
    known: float | None = None,
    apart: float | None = None,
    prior: ArrayLike | None = None,
) -> Sets:
    """Best, mid and worst stimulus of a validation session, as the module defines them. Deterministic.

    **Arguments:** `candidates`: feasible points (`search_points`); `known`: largest sd of worst and mid, in units of
    the prior's; `apart`: smallest distance of mid from both, in the unit cube; both by default as the study file has
    them in [validation]; `prior`: the map's variance without responses (`RuleMap.map_prior`), a scalar or (m,), by
    default one participant's. A map that knows too little has sets of second choice. Raises InputError only if fewer
    than three stimuli are feasible, or the map is not finite.
    """
    candidates, keys = jnp.asarray(candidates), study.file.validation
    known, apart = keys.known if known is None else known, keys.apart if apart is None else apart
    mean, sd = _mean_and_sd(predict, candidates)
    limit = known * jnp.sqrt(study.gp.kernel.diagonal(candidates[0]) if prior is None else prior)
    height, within = study.goal.closeness(study.gp.likelihood, mean), np.asarray(sd <= limit)

    def away(x: Float[Array, " d"]) -> Float[np.ndarray, " m"]:
        """Distances of the candidates from x."""
        return np.linalg.norm(np.asarray(differences(study.gp.kernel.levels, candidates, x[None])), axis=1)

    best = _highest(study, predict, candidates, score(study.goal, study.gp.likelihood, mean, sd**2))
    worst = _known_minimum(study, predict, candidates, jnp.where(sd <= limit, height, jnp.inf), limit)
    worst = None if worst is None or bool(jnp.all(worst == best)) else worst
    second = () if worst is not None else ("worst",)
    if worst is None:
        usable, _ = _usable(within, away(best), np.asarray(sd), apart)
        worst = candidates[int(np.argmin(np.where(usable, height, np.inf)))]
    usable, as_defined = _usable(within, np.minimum(away(best), away(worst)), np.asarray(sd), apart)
    ends = _mean_and_sd(predict, jnp.stack([best, worst]))[0]
    middle = float(jnp.mean(study.goal.closeness(study.gp.likelihood, ends)))
    mid = candidates[int(np.argmin(np.where(usable, np.abs(np.asarray(height) - middle), np.inf)))]
    x = jnp.stack([best, mid, worst])
    if not np.isfinite(mean).all() or len(np.unique(np.asarray(x), axis=0)) < len(x):
        raise InputError("best_mid_worst: the map has no three different stimuli; add parameters, levels or responses.")
    return Sets(x, *_mean_and_sd(predict, x), second if as_defined else ("mid", *second))


def second_choice_sentence(study: Study, name: str, whose: str = "the population") -> str:
    """The sentence for pages and plans that says how the set `name` of a map, of `whose` map, was chosen otherwise than
    defined."""
    keys = study.file.validation
    known = f"an sd of at most {keys.known:g} of the prior's"
    if name == "worst":
        return (
            f'The map of {whose} has no local minimum with {known}; its set "worst" is the least liked candidate with'
            " such an sd, or of the tenth with the smallest sd."
        )
    return (
        f"The map of {whose} has no candidate with {known} that is {keys.apart:g} of the ranges away from best and"
        ' worst; its set "mid" is the nearest to that.'
    )


def _known_minimum(
    study: Study, predict: Predict, candidates: Float[Array, "m d"], depth: Float[Array, " m"], limit: ArrayLike
) -> Float[Array, " d"] | None:
    """Deepest feasible local minimum (d,) of the map with an sd of at most `limit`; None if there is none. `depth`: the
    map at the candidates, infinite where it is not known."""
    minima = _minima(study, predict, candidates, depth)
    mean, sd = _mean_and_sd(predict, minima)
    usable = np.asarray((sd <= limit) & study.space.feasible(minima))
    there = study.goal.closeness(study.gp.likelihood, mean)
    return minima[int(np.argmin(np.where(usable, there, np.inf)))] if usable.any() else None


def _usable(
    within: Bool[np.ndarray, " m"], away: Float[np.ndarray, " m"], sd: Float[np.ndarray, " m"], apart: float
) -> tuple[Bool[np.ndarray, " m"], bool]:
    """Mask (m,) of the candidates for a set, and whether they meet its definition: known (`within` the limit of the
    sd), and at a distance `away` of at least `apart`. Otherwise the best-known tenth, and the farthest ones."""
    far, known = away >= apart, within
    if (far & known).any():
        return far & known, True
    far = far if far.any() else away >= away.max()
    if not (far & known).any():
        known = sd <= np.quantile(sd[far], _BEST_KNOWN)
    return far & known, False


@program
def _mean_and_sd(predict: Predict, x: Float[Array, "m d"]) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Mean and standard deviation of the map at the points."""
    mean, variance = predict(x)
    return mean, jnp.sqrt(variance)


@program
def _highest(
    study: Study, predict: Predict, candidates: Float[Array, "m d"], values: Float[Array, " m"]
) -> Float[Array, " d"]:
    """Feasible maximum of the map's `score`, searched from the three candidates with the largest `values`."""

    def height(x: Float[Array, " d"]) -> Float[Array, ""]:
        return score(study.goal, study.gp.likelihood, *predict(x[None, :]))[0]

    return _maximum(study, height, candidates, values, starts=3).x


def _minima(
    study: Study, predict: Predict, candidates: Float[Array, "m d"], depth: Float[Array, " m"]
) -> Float[Array, "s d"]:
    """Local minima (s, d) of the mean's closeness to the goal, searched downhill from up to 24 separate candidates of
    small `depth`, inf excluding a candidate. Some may repeat; none if all are excluded."""
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
    """The local minimum of the mean's closeness to the goal below each start, (s, d)."""

    near = partial(study.goal.closeness, study.gp.likelihood)

    def one(x):
        return _maximum(study, lambda x: -near(predict(x[None, :])[0][0]), x[None, :], jnp.zeros(1, x.dtype), 1).x

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
