"""Probability that a new participant gives the response that is the goal at a stimulus, with its uncertainty."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float
from scipy.special import ndtri

from hilbo.likelihoods import Goal, OrdinalProbit
from hilbo.population.learnt.rule import DrawnMap
from hilbo.population.maps import RuleMap
from hilbo.population.newcomer import log_goal
from hilbo.population.rules.registry import RULES
from hilbo.population.shared.scale_use import ScaleUse
from hilbo.study.config import Study

__all__ = ["HighestAnswer", "highest_answer", "with_interval"]

_QUANTILES = ndtri((np.arange(1000) + 0.5) / 1000)  # of the shared function at the stimulus, in each draw


class HighestAnswer(NamedTuple):
    """Probability of the goal, and the ends of its 95 % credible interval."""

    probability: float
    low: float
    high: float


def highest_answer(
    study: Study, map_: RuleMap, x: Float[ArrayLike, " d"], drawn: Sequence[DrawnMap] = ()
) -> HighestAnswer | None:
    """Probability that a new participant's response is the study's goal at a point `x` (d,) of the unit cube.

    The interval covers the uncertainty of the shared function there and, through `drawn`, of the hyperparameters; that
    participants differ is part of the probability itself. None for methods that do not predict a new
    participant (`Rule.predicts`).
    """
    if not RULES[map_.rule].predicts:
        return None
    return with_interval(study.gp.likelihood, study.goal, map_, x, drawn)


def with_interval(
    likelihood: OrdinalProbit,
    goal: Goal,
    map_: RuleMap,
    x: Float[ArrayLike, " d"],
    drawn: Sequence[DrawnMap] = (),
) -> HighestAnswer:
    """As `highest_answer`, also of methods that do not predict a new participant. `likelihood`: the median
    participant's; without `drawn` the interval is that of the given hyperparameters."""
    point = jnp.asarray(x)[None, :]
    of_map = likelihood, *map_.predict(point), map_.apart, map_.scale
    mean, variance, apart = (float(jnp.squeeze(value)) for value in of_map[1:4])
    probability = _chances(of_map[0], goal, np.array([mean]), apart + variance, map_.scale)[0]
    draws = [_drawn(each, point) for each in drawn] or [of_map]
    chances = np.concatenate([_over_the_function(goal, *each) for each in draws])
    low, high = np.quantile(chances, [0.025, 0.975])
    return HighestAnswer(float(probability), float(low), float(high))


def _drawn(drawn: DrawnMap, point: Float[Array, "1 d"]) -> tuple:
    """Arguments of `_over_the_function` but the goal, for drawn hyperparameters."""
    model = drawn.model
    apart = model.own if model.effect is None else model.own + model.effect
    return model.likelihood, *drawn.function.predict(point), apart, drawn.scale


def _over_the_function(
    goal: Goal,
    likelihood: OrdinalProbit,
    mean: Float[Array, " 1"],
    variance: Float[Array, " 1"],
    apart: Float[Array, ""],
    scale: ScaleUse | None,
) -> Float[np.ndarray, " 1000"]:
    """Probability of the goal at even quantiles of the shared function; `apart`: variance of participants'
    functions about it."""
    functions = float(mean[0]) + np.sqrt(float(variance[0])) * _QUANTILES
    return _chances(likelihood, goal, functions, float(apart), scale)


def _chances(
    likelihood: OrdinalProbit, goal: Goal, mean: Float[np.ndarray, " m"], variance: float, scale: ScaleUse | None
) -> Float[np.ndarray, " m"]:
    """Probabilities (m,) of the goal for participants' functions of this mean and variance."""
    return np.exp(np.asarray(log_goal(likelihood, goal, jnp.asarray(mean), jnp.full(len(mean), variance), scale)))
