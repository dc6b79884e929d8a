"""Search for the hyperparameters that maximise a recipe's log posterior, by L-BFGS."""

import dataclasses
from collections.abc import Set
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from hilbo.numerics.descent import Point, descended
from hilbo.population.learnt.posterior import KERNELS, LEFT, Coordinates, Cost, Problem, Stated, cost_at, model_at
from hilbo.population.rules.recipes import Recipe
from hilbo.population.shared.features import pivots_for
from hilbo.population.shared.tallies import Tallies

__all__ = ["LARGEST", "Search", "first_search", "searched"]

_STEPS, _ROUNDS = 100, 8  # of one descent; descents
_NEAR = 1e-3  # nats that a step must gain for another: a small part of what answers leave open, however many they are
_REMEMBERED = 30  # steps; with widths of people's own, the 10 of SciPy take a quarter more of them
LARGEST = 256
"""Features of a search, unless its end needs more (`rule`)."""
_MOVED = 0.35  # of log theta: features of other lengths leave more, but the RBF's no more than 0.004 of the variance
_REACH = 1.5  # of log theta, in one descent: where lengths grow far beyond it, features become singular
# About the standard deviations that 600 answers leave: in these units a search is as wide in all directions.
_UNITS = {"theta": 0.7, "shared": 0.5, "own": 0.4, "middle": 0.5, "gaps": 0.1, "widths": 0.3, "effect": 0.5}
_UNITS |= {"sensitivities": 0.3, "spread": 0.3}


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


def searched(search: Search, problem: Problem, free: Set[str], most: int | None = None) -> tuple[Search, Problem]:
    """Maximise the log posterior over the coordinates in `free`, from the state of `search`, by at most `most`
    features (None: `LARGEST`); return the end and its problem.

    The features stay fixed during a descent, because the cost would jump with others. If the length scales at its end
    need other features, or the descent stopped early, it is repeated with new ones; after eight descents `ended` is
    False.
    """
    for _ in range(_ROUNDS):
        search = _descended(search, problem, free)
        model = model_at(search.coordinates, problem.answers, problem.stated, problem.kernel)
        rank = len(problem.pivots.points)
        pivots = pivots_for(model.unit, problem.answers, LEFT, fewest=rank, most=most or LARGEST)
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
    held = {name: value for name, value in search.coordinates.items() if name not in free}
    begin = {name: value for name, value in search.coordinates.items() if name in free}
    units = ravel_pytree({name: jnp.full_like(value, _UNITS[name]) for name, value in begin.items()})[0]
    flat, restore = ravel_pytree(begin)
    weights = search.cost.weights

    def point(here: Search) -> Point[Search]:
        slope = ravel_pytree({name: here.cost.gradient[name] for name in free})[0]
        value = float(here.cost.value) if bool(here.cost.usable) else np.inf
        return Point(value, np.asarray(units * slope, float), here)

    def cost(z: np.ndarray) -> Point[Search]:
        nonlocal weights
        coordinates = held | restore(flat + units * jnp.asarray(z, flat.dtype))
        here = Search(coordinates, cost_at(coordinates, weights, problem), 0, False)
        weights = here.cost.weights
        return point(here)

    options = {"most": _STEPS, "remembered": _REMEMBERED}
    end = descended(cost, np.zeros(flat.size), point(search), _NEAR, _bounds(begin, problem), **options)
    return end.lowest._replace(steps=search.steps + end.steps, ended=end.ended)


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
