"""Search for the hyperparameters that maximise a recipe's log posterior, by L-BFGS."""

import dataclasses
from collections.abc import Set
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from hilbo.population.learnt.posterior import KERNELS, LEFT, Coordinates, Cost, Problem, Stated, cost_at, model_at
from hilbo.population.rules.recipes import Recipe
from hilbo.population.shared.features import pivots_for
from hilbo.population.shared.tallies import Tallies

__all__ = ["LARGEST", "Search", "first_search", "searched"]

_STEPS, _ROUNDS = 100, 8  # of one descent; descents
_NEAR = 1e-3  # nats that a step must gain for another: a small part of what answers leave open, however many they are
_REMEMBERED = 30  # steps; with widths of people's own, the 10 of SciPy take a quarter more of them
LARGEST = 256
"""Features of a search: functions that need more are too rugged to be shared by few answers."""
_MOVED = 0.35  # of log theta: features of other lengths leave more, but the RBF's no more than 0.004 of the variance
_REACH = 1.5  # of log theta, in one descent: where lengths grow far beyond it, features become singular
# About the standard deviations that 600 answers leave: in these units a search is as wide in all directions.
_UNITS = {"theta": 0.7, "shared": 0.5, "own": 0.4, "middle": 0.5, "gaps": 0.1, "widths": 0.3, "effect": 0.5}


class Search(NamedTuple):
    """State of a search: coordinates, the cost there, number of L-BFGS steps in all, and whether it converged
    (`ended`).
    """

    coordinates: Coordinates
    cost: Cost
    """There."""
    steps: int
    ended: bool


def first_search(start: Coordinates, answers: Tallies, stated: Stated, recipe: Recipe) -> tuple[Search, Problem]:
    """A search that is still at `start`, with the cost there; and its problem, with pivots for that kernel."""
    model = model_at(start, answers, stated, KERNELS[recipe.kernel])
    pivots = pivots_for(model.unit, answers, LEFT, most=LARGEST)
    problem = Problem(answers, stated, recipe.priors, KERNELS[recipe.kernel], pivots, model.theta)
    return Search(start, cost_at(start, answers.blank, problem), 0, True), problem


def searched(search: Search, problem: Problem, free: Set[str]) -> tuple[Search, Problem]:
    """Maximise the log posterior over the coordinates in `free`, from the state of `search`; return the end and its
    problem.

    The features stay fixed during a descent, because the cost would jump with others. If the length scales at its end
    need other features, or the descent stopped early, it is repeated with new ones; after eight descents `ended` is
    False.
    """
    for _ in range(_ROUNDS):
        search = _descended(search, problem, free)
        model = model_at(search.coordinates, problem.answers, problem.stated, problem.kernel)
        rank = len(problem.pivots.points)
        pivots = pivots_for(model.unit, problem.answers, LEFT, fewest=rank, most=LARGEST)
        moved = np.abs(np.log(np.asarray(model.theta)) - np.log(np.asarray(problem.theta)))
        if search.ended and len(pivots.points) == rank and not np.any(moved > _MOVED):
            return search, problem
        problem = dataclasses.replace(problem, pivots=pivots, theta=model.theta)
        search = search._replace(cost=cost_at(search.coordinates, search.cost.weights, problem))
    return search._replace(ended=False), problem


def _descended(search: Search, problem: Problem, free: Set[str]) -> Search:
    """One descent by L-BFGS, at most 100 steps, over the coordinates in `free`; each mode is searched from the previous
    one.

    Returns the lowest cost met, with the steps added; `ended` is False if a cost was not usable, or L-BFGS did not
    converge.
    """
    from scipy.optimize import minimize  # a fifth of a second, which commands that learn nothing need not wait

    held = {name: value for name, value in search.coordinates.items() if name not in free}
    begin = {name: value for name, value in search.coordinates.items() if name in free}
    units = ravel_pytree({name: jnp.full_like(value, _UNITS[name]) for name, value in begin.items()})[0]
    flat, restore = ravel_pytree(begin)
    latest, lowest = search, search

    def cost(z: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal latest, lowest
        here = search
        if np.any(z):
            coordinates = held | restore(flat + units * jnp.asarray(z, flat.dtype))
            here = Search(coordinates, cost_at(coordinates, latest.cost.weights, problem), 0, False)
        if not bool(here.cost.usable):
            raise _UnusableError
        latest = here
        lowest = min(lowest, here, key=lambda each: float(each.cost.value))
        slope = ravel_pytree({name: here.cost.gradient[name] for name in free})[0]
        return float(here.cost.value), np.asarray(units * slope, float)

    steps = 0

    def count(_: object) -> None:
        nonlocal steps
        steps += 1

    near = _NEAR / max(1.0, abs(float(search.cost.value)))  # SciPy's is a part of the cost
    options = {"maxiter": _STEPS, "ftol": near, "gtol": 1e-3, "maxcor": _REMEMBERED}
    bounds = _bounds(begin, problem)
    try:
        result = minimize(
            cost, np.zeros(flat.size), jac=True, method="L-BFGS-B", bounds=bounds, callback=count, options=options
        )
        ended = bool(result.success)
    except _UnusableError:  # L-BFGS-B does not turn back where the cost is infinite: it would say that it has ended
        ended = False
    return lowest._replace(steps=search.steps + steps, ended=ended)


class _UnusableError(Exception):
    """Raised within a descent where no mode was found, or a gradient is not finite."""


def _bounds(begin: Coordinates, problem: Problem) -> list[tuple[float, float]]:
    """Bounds (lower, upper) of each coordinate's step from `begin`, in units: log theta stays within 1.5 of the theta
    with which the features were chosen; others are unbounded.
    """
    ends = []
    for sign in (-1, 1):
        ways = {name: jnp.full_like(value, sign * jnp.inf) for name, value in begin.items()}
        if "theta" in begin:
            ways["theta"] = (jnp.log(problem.theta) + sign * _REACH - begin["theta"]) / _UNITS["theta"]
        ends.append(np.asarray(ravel_pytree(ways)[0], float))
    return list(zip(*ends, strict=True))
