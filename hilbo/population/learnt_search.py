"""The search for the hyperparameters that maximise what a recipe maximises: L-BFGS on its value and gradient."""

import dataclasses
from collections.abc import Set
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from hilbo.population.learnt_posterior import LEFT, Coordinates, Cost, Problem, Stated, cost_at, model_at
from hilbo.population.recipes import Recipe
from hilbo.population.shared_features import pivots_for
from hilbo.population.tallies import Tallies

__all__ = ["Search", "first_search", "searched"]

_STEPS, _ROUNDS = 100, 10  # of one descent; descents
_NEAR = 2e-6  # of the cost: another choice of features moves it as much as a nearer step would
_LARGEST = 256  # features: functions that need more are too rugged to be shared by few answers
_MOVED = 0.35  # of log theta: lengths that differ by a fifth have as good features
# About the standard deviations that 600 answers leave: in these units a search is as wide in all directions.
_UNITS = {"theta": 0.7, "shared": 0.5, "own": 0.4, "middle": 0.5, "gaps": 0.1, "widths": 0.3, "effect": 0.5}


class Search(NamedTuple):
    """Where a search is."""

    coordinates: Coordinates
    cost: Cost
    """There."""
    steps: int
    ended: bool


def first_search(start: Coordinates, answers: Tallies, stated: Stated, recipe: Recipe) -> tuple[Search, Problem]:
    """A search that has not moved yet, and its problem."""
    model = model_at(start, answers, stated, recipe.kernel)
    pivots = pivots_for(model.unit, answers, LEFT, most=_LARGEST)
    problem = Problem(answers, stated, recipe.priors, recipe.kernel, pivots, model.theta)
    return Search(start, cost_at(start, answers.blank, problem), 0, True), problem


def searched(search: Search, problem: Problem, free: Set[str]) -> tuple[Search, Problem]:
    """The maximum over the coordinates that are `free`, from where a search is, and the problem there.

    While it descends the features stay as they are, because the cost would jump with others. Where the lengths at its
    end ask for others, it goes on with those. If they do so again and again it has not `ended`.
    """
    for _ in range(_ROUNDS):
        search = _descended(search, problem, free)
        model = model_at(search.coordinates, problem.answers, problem.stated, problem.kernel)
        rank = len(problem.pivots.points)
        pivots = pivots_for(model.unit, problem.answers, LEFT, fewest=rank, most=_LARGEST)
        moved = np.abs(np.log(np.asarray(model.theta)) - np.log(np.asarray(problem.theta)))
        if len(pivots.points) == rank and not np.any(moved > _MOVED):
            return search, problem
        problem = dataclasses.replace(problem, pivots=pivots, theta=model.theta)
        search = search._replace(cost=cost_at(search.coordinates, search.cost.weights, problem))
    return search._replace(ended=False), problem


def _descended(search: Search, problem: Problem, free: Set[str]) -> Search:
    """L-BFGS from where a search is; each mode is sought from the one before's."""
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
            here = search._replace(coordinates=coordinates, cost=cost_at(coordinates, latest.cost.weights, problem))
        if not bool(here.cost.usable):  # the line search is to turn back
            return np.inf, np.zeros(flat.size)
        latest = here
        lowest = min(lowest, here, key=lambda each: float(each.cost.value))
        slope = ravel_pytree({name: here.cost.gradient[name] for name in free})[0]
        return float(here.cost.value), np.asarray(units * slope, float)

    options = {"maxiter": _STEPS, "ftol": _NEAR, "gtol": 1e-3}
    result = minimize(cost, np.zeros(flat.size), jac=True, method="L-BFGS-B", options=options)
    return lowest._replace(steps=search.steps + int(result.nit), ended=bool(result.success))
