"""Optima of maps: the feasible point at which a population map, or a participant's posterior mean, is largest.

A population map is a committee machine over posteriors (`hilbo.bcm`), or that of another aggregation method
(`hilbo.population.maps`); its optimum is searched as in a session.
"""

import dataclasses
from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from hilbo import acquisition
from hilbo.likelihoods import Goal, OrdinalProbit
from hilbo.numerics.climbing import Choice
from hilbo.numerics.sharding import of_each_person
from hilbo.numerics.shown import shown
from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import OrdinalGP, Posterior
from hilbo.population import pointwise
from hilbo.population.maps import RuleMap
from hilbo.population.newcomer import class_probabilities, log_goal
from hilbo.population.rules.registry import RULES
from hilbo.population.shared.scale_use import ScaleUse
from hilbo.search.space import SearchSpace
from hilbo.study.config import Study
from hilbo.study.estimate.best_places import best_places, nearness

__all__ = [
    "Optimum",
    "best_point",
    "individual_optima",
    "map_optimum",
    "population_optimum",
    "predict_map",
    "predict_people",
    "score",
]

_LOSS = 0.05  # of the probability of the goal, for an optimum in the middle of where the best may be


class Optimum(eqx.Module):
    """A point `x` of the unit cube at which a map is largest, and mean and standard deviation of the latent score
    there; leading axes for several. Of a population, `mean` and `sd` are the map's own, and the class probabilities
    those of a new participant's response."""

    x: Float[Array, "*s d"]
    mean: Float[Array, "*s"]
    sd: Float[Array, "*s"]
    class_probabilities: Float[Array, "*s C"]

    def __repr__(self) -> str:
        """One line with the point, mean ± sd, and class probabilities."""
        f, chances = f"{shown(self.mean)} ± {shown(self.sd)}", shown(self.class_probabilities)
        return f"Optimum(x={shown(self.x)} of the unit cube, f = {f}, answers {chances})"


@program
def predict_people(
    posteriors: Posterior, x: Float[Array, "m d"], rule: str = "bcm", share: Float[Array, ""] | None = None
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Mean and variance (m,) of the population map of stacked posteriors at points of the unit cube.

    Participants are added one by one, which bounds memory. `rule`: an aggregation method that works point by point;
    `share`: shared fraction of the prior variance, for the hierarchical one, otherwise None.
    """
    prior = jax.vmap(jax.tree.map(lambda leaf: leaf[0], posteriors.gp).kernel.diagonal)(x)
    return pointwise.merged(rule, posteriors, x, prior, share)


def predict_map(map_: RuleMap, x: Float[Array, "m d"]) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Mean and variance (m,) of a population map at points of the unit cube."""
    return _predict_map(_nameless(map_), x)


@program
def _predict_map(map_: RuleMap, x: Float[Array, "m d"]) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Mean and variance (m,) of a map at points of the unit cube, compiled."""
    return map_.predict(x)


def population_optimum(
    study: Study,
    posteriors: Posterior,
    candidates: Float[Array, "m d"],
    rule: str = "bcm",
    share: Float[Array, ""] | None = None,
) -> Optimum:
    """Optimum of a map of stacked posteriors by a method that works point by point: the feasible maximum of `score`.

    `posteriors`: stacked, M participants; `candidates` (m, d): feasible points of the unit cube from which the search
    starts; `rule`, `share`: as in `predict_people`.
    """
    return _population_optimum(study.gp, study.goal, study.space, posteriors, candidates, rule, share)


@program
def _population_optimum(gp: OrdinalGP, goal: Goal, space: SearchSpace, posteriors, candidates, rule, share) -> Optimum:
    """Feasible maximum of `score` of a point-by-point map of stacked posteriors, compiled. `rule`, `share`: as in
    `predict_people`; `candidates` (m, d): start of the search."""
    apart = 0.0 if share is None else (1.0 - share) * gp.kernel.variance
    predict = partial(_predict_people, posteriors, rule, share)
    values = score(goal, gp.likelihood, *predict(candidates), apart)
    return _optimum(gp.likelihood, goal, space, predict, candidates, values, apart)


def _predict_people(posteriors, rule, share, x):
    """`predict_people` with the points last."""
    return predict_people(posteriors, x, rule, share)


def map_optimum(study: Study, map_: RuleMap, candidates: Float[Array, "m d"]) -> Optimum:
    """Optimum of a map in the feasible set. `candidates` (m, d): feasible points of the unit cube from which the search
    starts.

    For a method with given hyperparameters it is the maximum of `score`. For one that learns them it is the maximum of
    the probability that a new participant's response is the study's goal, or, if the map is `centred`, of `nearness` to
    the best points of joint draws where that probability is within 0.05 of its maximum. In both cases only points where
    the map's variance is at most that of some tested stimulus are considered (`RuleMap.reach`).
    """
    if map_.centred:
        assert map_.shared is not None
        places = best_places(study.space, study.goal, [map_.shared])
        return _centre(study.gp.likelihood, study.goal, study.space, map_, candidates, places.points, places.share)
    return _map_optimum(study.gp.likelihood, study.goal, study.space, _nameless(map_), candidates)


def _nameless(map_: RuleMap) -> RuleMap:
    """The same map, renamed to "hierarchical" if it comes from one joint posterior with given hyperparameters:
    predictions are the same, and all such methods then share one compiled program."""
    exact = map_.method == "exact" and not RULES[map_.rule].learns
    return dataclasses.replace(map_, rule="hierarchical") if exact else map_


@program
def _map_optimum(
    likelihood: OrdinalProbit, goal: Goal, space: SearchSpace, map_: RuleMap, candidates: Float[Array, "m d"]
) -> Optimum:
    """Optimum of a map that is not centred, compiled: maximum of `score`, or, if the method learns hyperparameters, of
    the probability of the goal as a new participant's response where the map's variance is at most `_reach`."""
    if not RULES[map_.rule].learns:
        single = jnp.float32  # which ranks the candidates; the best are scored again
        moments = predict_map(map_.astype(single), candidates.astype(single))
        values = score(goal, likelihood, *moments, map_.apart)
        return _optimum(likelihood, goal, space, lambda x: predict_map(map_, x), candidates, values, map_.apart)

    log_chance = partial(_log_chance, likelihood, goal, map_)
    mean, variance = map_.predict(candidates)
    surest = _reach(map_, variance)
    return _optimum(
        likelihood,
        goal,
        space,
        map_.predict,
        candidates,
        log_chance(mean, variance),
        map_.apart,
        lambda x: log_chance(*map_.predict(x[None, :]))[0],
        lambda x: map_.predict(x[None, :])[1][0] <= surest,
        map_.scale,
    )


@program
def _centre(
    likelihood: OrdinalProbit,
    goal: Goal,
    space: SearchSpace,
    map_: RuleMap,
    candidates: Float[Array, "m d"],
    places: Float[Array, "p d"],
    share: Float[Array, " p"],
) -> Optimum:
    """Optimum of a centred map, compiled: the point nearest to most of the best points of joint draws (`nearness`),
    where the probability of the goal as a new participant's response is within 0.05 of its maximum and the variance at
    most `_reach`.

    `places` (p, d), `share` (p,): points, and how often each was the best of a joint draw.
    """
    assert map_.shared is not None
    near = partial(nearness, map_.shared.gp.kernel, places, share)
    mean, variance = map_.predict(candidates)
    surest = _reach(map_, variance)
    chances = jnp.exp(_log_chance(likelihood, goal, map_, mean, variance))
    least = jnp.max(jnp.where(variance <= surest, chances, 0.0)) - _LOSS

    def allowed(x):
        mean, variance = map_.predict(x[None, :])
        return (variance[0] <= surest) & (jnp.exp(_log_chance(likelihood, goal, map_, mean, variance)[0]) >= least)

    values = jax.vmap(near)(candidates)
    return _optimum(likelihood, goal, space, map_.predict, candidates, values, map_.apart, near, allowed, map_.scale)


def _log_chance(
    likelihood: OrdinalProbit, goal: Goal, map_: RuleMap, mean: Float[Array, " m"], variance: Float[Array, " m"]
) -> Float[Array, " m"]:
    """Log probability (m,) of the goal as a new participant's response, from the map's mean and variance."""
    return log_goal(likelihood, goal, mean, variance + map_.apart, map_.scale)


def _reach(map_: RuleMap, variances: Float[Array, " m"]) -> Float[Array, ""]:
    """Upper limit of the map's variance at an optimum: `RuleMap.reach` (largest variance at a tested stimulus), or the
    candidates' smallest variance if that is larger."""
    assert map_.reach is not None
    return jnp.maximum(map_.reach, jnp.min(variances))


def _optimum(
    likelihood: OrdinalProbit,
    goal: Goal,
    space: SearchSpace,
    predict: Callable,
    candidates: Float[Array, "m d"],
    values: Float[Array, " m"],
    apart: ArrayLike,
    height: Callable[[Float[Array, " d"]], Float[Array, ""]] | None = None,
    allowed: Callable[[Float[Array, " d"]], Bool[Array, ""]] | None = None,
    scale: ScaleUse | None = None,
) -> Optimum:
    """Maximise a height over the feasible set, and evaluate the map at the maximum.

    `predict`: points (m, d) -> mean and variance (m,). `values`: height of each candidate. `apart`: variance of an
    individual's function around the map, added for the class probabilities. `height`: of one point, by default its
    `score`. `allowed`: constraint on one point. `scale`: how participants differ in the use of the scale.
    """
    choice = acquisition.maximise(
        values,
        candidates,
        (lambda x: score(goal, likelihood, *predict(x[None, :]), apart=apart)[0]) if height is None else height,
        **space.searched,
        allowed=allowed,
        steps=300,
    )
    mean, variance = predict(choice.x[None, :])
    probabilities = class_probabilities(likelihood, mean, variance + apart, scale)[0]
    return Optimum(choice.x, mean[0], jnp.sqrt(variance[0]), probabilities)


def score(
    goal: Goal,
    likelihood: OrdinalProbit,
    mean: Float[Array, " m"],
    variance: Float[Array, " m"],
    apart: ArrayLike = 0.0,
) -> Float[Array, " m"]:
    """Height (m,) of a map or a posterior with given hyperparameters, whose maximum is its optimum: the closeness of
    the mean to the goal, or, of a goal between other responses, its log probability.

    All points at which the mean is in the middle of such a goal are equally close; the probability is largest where the
    variance is smallest. `apart`: variance of individuals' functions about the map.
    """
    if goal.is_between:
        return log_goal(likelihood, goal, mean, variance + jnp.asarray(apart, variance.dtype))
    return goal.closeness(likelihood, mean)


def individual_optima(study: Study, posteriors: Posterior, candidates: Float[Array, "m d"]) -> Optimum:
    """Optimum of each participant's posterior, by `score`, in the feasible set, stacked: all arrays of the result begin
    with M.

    `posteriors`: stacked, M participants; `candidates` (m, d): feasible points of the unit cube from which the searches
    start.
    """
    return _individual_optima(study.goal, study.space, posteriors, candidates)


@program
def _individual_optima(
    goal: Goal, space: SearchSpace, posteriors: Posterior, candidates: Float[Array, "m d"]
) -> Optimum:
    """Feasible maximum of each participant's `score`, stacked (M), compiled; one participant after the other on
    a CPU, in batches of 256 elsewhere."""

    def one(posterior, space, candidates):
        x = best_point(goal, space, posterior, candidates).x
        mean, variance = posterior.predict(x[None, :])
        probabilities = posterior.gp.likelihood.class_probabilities(mean[0], variance[0])
        return Optimum(x, mean[0], jnp.sqrt(variance[0]), probabilities)

    def each(people, space, candidates):
        # On a CPU one after the other: each search stops when it is done, where a batch waits for its slowest.
        batch = None if jax.default_backend() == "cpu" else 256
        return jax.lax.map(lambda posterior: one(posterior, space, candidates), people, batch_size=batch)

    return of_each_person(each, posteriors, space, candidates)


def best_point(goal: Goal, space: SearchSpace, posterior: Posterior, candidates: Float[Array, "m d"]) -> Choice:
    """Feasible maximum of one posterior's `score`, of the highest response its mean (paper, algorithm 1), searched from
    `candidates`; these are ranked in float32."""

    def values(posterior: Posterior, x: Float[Array, "m d"]) -> Float[Array, " m"]:
        if goal.is_between:
            return score(goal, posterior.gp.likelihood, *posterior.predict(x))
        return goal.closeness(posterior.gp.likelihood, posterior.mean(x))

    return acquisition.maximise(
        values(posterior.astype(jnp.float32), candidates.astype(jnp.float32)),
        candidates,
        lambda x: values(posterior, x[None, :])[0],
        **space.searched,
    )
