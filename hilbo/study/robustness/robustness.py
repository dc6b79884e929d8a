"""The paper's robustness check: does the population optimum move if the hyperparameters maximise the evidence?

The criterion is that of the study's aggregation method (`optimised`). Both maps are by that method, with fixed and with
optimised hyperparameters; both population optima, and the individual ones, are compared in units of the search ranges
(NRMSE). Three places are described under the optimised map: its optimum, the local optimum nearest uphill of the fixed
one, and the fixed optimum itself. A large move to a place of equal height is another peak; a large local move is
another hill. A bootstrap over participants gives the sampling variation of the fixed optimum, and the moves in the same
resamples. For methods with given hyperparameters the derivative of the fixed optimum by each of them is added.

Paper, section IV-3: less than 3 %.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hilbo.errors import InputError
from hilbo.hyperparameters.maximum_evidence import optimum_sensitivity
from hilbo.likelihoods import Goal
from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import Posterior, Trials, fit
from hilbo.population.maps import point_rule
from hilbo.population.rules.registry import RULES
from hilbo.search.apart import nrmse
from hilbo.search.candidates import search_points
from hilbo.search.space import SearchSpace
from hilbo.study.cohort import Cohort
from hilbo.study.config import Study
from hilbo.study.estimate.aggregate import Aggregate, aggregate_cohort
from hilbo.study.estimate.bootstrap import can_resample, resampled_tops
from hilbo.study.estimate.optimum import Optimum, map_optimum, population_optimum, predict_people, score
from hilbo.study.robustness.optimised import LEARNABLE, FixedAndOptimised, differentiable, fixed_and_optimised

__all__ = ["LIMIT", "NEAR", "Place", "Resampled", "Robustness", "nearby", "robustness"]

_NEAR_POINTS, _NEARBY = 1000, (0.001, 0.2)  # points near the optimum, and their distances from it
LIMIT = 0.03
"""NRMSE from which an optimum is flagged as not robust (paper, section IV-3)."""
NEAR = 0.1
"""NRMSE up to which a response counts as one near an optimum."""


class Place(NamedTuple):
    """An optimum, and the responses given within `NEAR` of it: their number, and how many were the goal."""

    optimum: Optimum
    answers: int
    highest: int


class Resampled(NamedTuple):
    """NRMSE in resamples of the participants, (draws,) each, of optima of maps that are aggregated point by point: with
    fixed hyperparameters to that of all participants, and with optimised ones to that with fixed ones in the same
    resample.
    """

    fixed: Float[np.ndarray, " draws"]
    moves: Float[np.ndarray, " draws"]


class Robustness(NamedTuple):
    """Optima with fixed and with optimised hyperparameters, and the distances between them.

    `fixed`: under the fixed map; `optimised`, `local` and `fixed_again` under the optimised one: its optimum, the local
    one uphill of the fixed optimum (None for a method that learns, whose optimum is no maximum of the mean), and the
    fixed optimum. `nrmse`, `local_nrmse`: of the optimised and of the local
    optimum to the fixed one; `individual_nrmse` (M,); `resampled`: None with fewer than two participants;
    `sensitivity`: d(fixed optimum, unit cube) / d(log theta, log noise, first threshold in prior standard deviations,
    log gaps), None for a method that learns them.
    """

    hyperparameters: FixedAndOptimised
    fixed_aggregate: Aggregate
    optimised_aggregate: Aggregate
    fixed: Place
    optimised: Place
    local: Place | None
    fixed_again: Place
    nrmse: float
    local_nrmse: float | None
    individual_nrmse: Float[np.ndarray, " M"]
    resampled: Resampled | None
    sensitivity: dict[str, Float[Array, "..."]] | None

    @property
    def flagged(self) -> bool:
        """Whether the population optimum moves by 3 % of the search ranges or more."""
        return self.nrmse >= LIMIT


def robustness(study: Study, cohort: Cohort, seed: int = 0, *, learn: Sequence[str] = LEARNABLE) -> Robustness:
    """Repeat the paper's robustness check for a cohort.

    `learn`: hyperparameters to optimise, of "theta", "noise" and "thresholds"; a method that learns hyperparameters
    learns all. Raises `InputError` for another hyperparameter.
    """
    _check(learn)
    learns = RULES[study.rule].learns
    given = None if learns else aggregate_cohort(study, cohort, seed, alternatives=False)  # raises before the search
    both = fixed_and_optimised(study, cohort, tuple(learn))
    fixed = aggregate_cohort(both.fixed, cohort, seed, alternatives=False) if given is None else given
    optimised = aggregate_cohort(both.optimised, cohort, seed, alternatives=False)
    levels, best = study.gp.kernel.levels, fixed.optimum.x
    local = None if learns else map_optimum(both.optimised, optimised.map, best[None, :])
    place = partial(_place, goal=study.goal, cohort=cohort, levels=levels)
    return Robustness(
        hyperparameters=both,
        fixed_aggregate=fixed,
        optimised_aggregate=optimised,
        fixed=place(fixed.optimum),
        optimised=place(optimised.optimum),
        local=None if local is None else place(local),
        fixed_again=place(_at(both.optimised, optimised, best)),
        nrmse=float(nrmse(optimised.optimum.x, best, levels)),
        local_nrmse=None if local is None else float(nrmse(local.x, best, levels)),
        individual_nrmse=np.asarray(nrmse(optimised.individuals.x, fixed.individuals.x, levels)),
        resampled=_resampled((both.fixed, fixed), (both.optimised, optimised), seed),
        sensitivity=None if learns or not study.one_optimum else _sensitivity_of(study, fixed, tuple(learn), seed),
    )


def _check(learn: Sequence[str]) -> None:
    """Raise InputError for hyperparameters that cannot be optimised here, and for none."""
    if "variance" in learn:
        raise InputError("robustness: the prior variance is kept, since it fixes the scale of the latent function.")
    unknown = [name for name in learn if name not in LEARNABLE]
    if unknown or not learn:
        asked = f'"{unknown[0]}"' if unknown else "nothing"
        raise InputError(f"robustness: cannot learn {asked}; choose from {', '.join(LEARNABLE)}.")


def _at(study: Study, aggregate: Aggregate, x: Float[Array, " d"]) -> Optimum:
    """The map at a point (d,) in the form of an optimum."""
    mean, variance = aggregate.surface(x[None, :])
    return Optimum(x, mean[0], jnp.sqrt(variance[0]), aggregate.class_probabilities(study.gp.likelihood, x[None, :])[0])


def _place(optimum: Optimum, goal: Goal, cohort: Cohort, levels: tuple[int, ...]) -> Place:
    """An optimum with the number of responses within an NRMSE of `NEAR`, and how many of them were the goal. `levels`:
    of the study's kernel."""
    mask = np.asarray(cohort.trials.mask)
    away = np.asarray(nrmse(np.asarray(cohort.trials.x), np.asarray(optimum.x), levels))
    answers = np.asarray(cohort.trials.q)[mask & (away <= NEAR)]
    return Place(optimum, len(answers), int(np.sum(answers == goal.category)))


def _resampled(fixed: tuple[Study, Aggregate], optimised: tuple[Study, Aggregate], seed: int) -> Resampled | None:
    """Bootstrap over participants: the optima of each resample, among all candidates and 1,000 points near the
    optimum of all, with the hyperparameters of all, point by point. None for fewer than two participants with
    responses."""
    study, aggregate = fixed
    if not can_resample(aggregate.posteriors):
        return None
    candidates, levels = search_points(study.space, seed), study.gp.kernel.levels
    (whole, tops), (_, others) = (_tops(*each, candidates, seed) for each in (fixed, optimised))
    return Resampled(np.asarray(nrmse(tops, whole, levels)), np.asarray(nrmse(others, tops, levels)))


def _tops(
    study: Study, aggregate: Aggregate, candidates: Float[Array, "m d"], seed: int
) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, "draws d"]]:
    """Optimum (d,) of all participants, aggregated point by point, and those (draws, d) of resamples of them, among the
    candidates, the optimum of the map and points near it.
    """
    best = aggregate.optimum.x
    points = jnp.concatenate([best[None, :], nearby(study.space, best, _NEAR_POINTS, seed), candidates])
    rule, share = point_rule(study.rule, aggregate.map.share)
    apart = 0.0 if share is None else (1.0 - share) * study.gp.kernel.variance
    moments = predict_people(aggregate.posteriors, points, rule, share)
    whole = int(jnp.argmax(score(study.goal, study.gp.likelihood, *moments, apart)))
    tops = resampled_tops(study, aggregate.posteriors, points, rule, share, study.gp.kernel.variance, seed)
    return np.asarray(points)[whole], np.asarray(points)[tops]


def nearby(space: SearchSpace, x: Float[Array, " d"], count: int, seed: int) -> Float[Array, "count d"]:
    """Feasible points about `x` in the unit cube, at distances from .1 to 20 % of the range along each axis of the
    optimiser's box, evenly on a logarithmic scale; discrete coordinates stay. Infeasible ones are replaced by `x`.

    Among even points alone, the optimum of a resample would be the point itself or one that is far from it.
    """
    rng, box = np.random.default_rng(seed), np.asarray(space.to_box(x))
    (low, high), d = np.log(_NEARBY), len(box)
    away = np.exp(rng.uniform(low, high, (count, 1))) * rng.uniform(-1.0, 1.0, (count, d))
    points = space.from_box(np.clip(box + np.where(space.discrete, 0.0, away), 0.0, 1.0))
    return jnp.where(space.feasible(points)[:, None], points, x)


def _sensitivity_of(
    study: Study, aggregate: Aggregate, learn: tuple[str, ...], seed: int
) -> dict[str, Float[Array, "..."]]:
    """Derivatives by the hyperparameters `learn` of the optimum of participants who are aggregated point by point; it
    is searched again if the study's map is exact.
    """
    (rule, share), x = point_rule(study.rule, aggregate.map.share), aggregate.optimum.x
    if aggregate.map.method == "exact":
        x = population_optimum(study, aggregate.posteriors, search_points(study.space, seed), rule, share).x
    return _sensitivity(study, aggregate.cohort.trials, x, learn, rule, share)


@program
def _sensitivity(
    study: Study,
    trials: Trials,
    x: Float[Array, " d"],
    learn: tuple[str, ...],
    rule: str,
    share: Float[Array, ""] | None,
) -> dict[str, Float[Array, "..."]]:
    """Derivatives of the population optimum x by each hyperparameter in `learn`; see `Robustness.sensitivity`."""

    def refit(gp):
        return jax.vmap(lambda t: fit(gp, t, inference=differentiable(study.inference), throw=False))(trials)

    def height(w, posteriors: Posterior):
        gp = jax.tree.map(lambda leaf: leaf[0], posteriors.gp)
        moments = predict_people(posteriors, study.space.from_box(w)[None, :], rule, share)
        apart = 0.0 if share is None else (1.0 - share) * gp.kernel.variance
        return score(study.goal, gp.likelihood, *moments, apart)[0]

    box, searched = study.space.to_box(x), study.space.searched
    between = {name: searched.get(name) for name in ("walls", "held")}
    return optimum_sensitivity(height, refit, box, study.gp, study.space.from_box, learn, **between)
