"""Individual use of the response scale, by widths or sensitivities, where the evidence is for it."""

import dataclasses
from collections.abc import Set
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.linalg import hadamard

from hilbo.population.learnt.posterior import Problem, cost_at
from hilbo.population.learnt.search import Search, searched
from hilbo.population.rules.recipes import Recipe

__all__ = ["FACTORS", "FINE", "Chosen", "with_factors_if_worth"]

FACTORS = frozenset({"widths", "sensitivity"})
"""Coordinates of the use of the scale: without them all participants use it alike."""
FINE = 1e-3
"""Step of finite differences for curvatures, in units of the coordinates."""


class Chosen(NamedTuple):
    """The search that is used, its problem, the coordinates that were free in it, and the gain of log evidence by
    individual factors.
    """

    search: Search
    problem: Problem
    free: Set[str]
    gain: float


def with_factors_if_worth(alike: Search, problem: Problem, coordinates: Set[str], recipe: Recipe) -> Chosen:
    """Continue the search `alike`, in which participants use the scale alike, with individual factors; return it if the
    log evidence gains more than the recipe's `worth`, else `alike`.

    `coordinates`: names of all that are learnt; without "widths" among them nothing is searched, and the gain is 0.
    """
    without = Chosen(alike, problem, coordinates - FACTORS, 0.0)
    if "widths" not in coordinates:
        return without
    if "sensitivity" in coordinates:
        different, its_own = _with_sensitivities(alike, problem, coordinates)
    else:
        different, its_own = searched(alike, problem, coordinates)
    same = alike
    if its_own is not problem:  # costs by other features differ by more than a gain may
        bare = dataclasses.replace(its_own, information=None)
        same = alike._replace(cost=cost_at(alike.coordinates, alike.cost.weights, bare))
    if "sensitivity" in coordinates:
        gain = float(same.cost.value - different.cost.value)
    else:
        gain = _gain_of_widths(same, different, its_own)
    return Chosen(different, its_own, coordinates, gain) if gain > recipe.worth else without._replace(gain=gain)


def _with_sensitivities(alike: Search, problem: Problem, free: Set[str]) -> tuple[Search, Problem]:
    """Continue the search `alike` with individual sensitivities, whose spread is learnt too: twice, by Laplace factors
    at its start and at its first end. The cost of the result has the factors of its own end.
    """
    search = alike
    for _ in range(2):
        problem, search = _with_information(search, problem)
        search, problem = searched(search, problem, free)
    problem, search = _with_information(search, problem)
    return search, problem


def _with_information(search: Search, problem: Problem) -> tuple[Problem, Search]:
    """The problem with the curvatures at the coordinates of `search` for its Laplace factors, and the search with the
    cost by these. A participant for whom the curvature is negative has 0: nothing is known of that factor.
    """
    information = _curvature(search, problem) - np.exp(-2 * float(search.coordinates["sensitivity"]))
    problem = dataclasses.replace(problem, information=jnp.asarray(np.maximum(information, 0.0)))
    return problem, search._replace(cost=cost_at(search.coordinates, search.cost.weights, problem))


def _curvature(search: Search, problem: Problem) -> Float[np.ndarray, " M"]:
    """Diagonal (M,) of the cost's Hessian in the log factors, from 8 differences of its gradient along orthogonal
    signs, in whose mean most of what other participants' factors add cancels; exact for up to 8 participants.

    Reference: Bekas, Kokiopoulou & Saad (2007), Applied Numerical Mathematics 57:1214.
    """
    widths, start = search.coordinates["widths"], np.asarray(search.cost.gradient["widths"])
    size = 1 << max(3, (len(widths) - 1).bit_length())
    total = np.zeros(len(widths))
    for signs in hadamard(size)[size // 8 - 1 :: size // 8, : len(widths)]:
        moved = search.coordinates | {"widths": widths + FINE * jnp.asarray(signs, widths.dtype)}
        total += signs * (np.asarray(cost_at(moved, search.cost.weights, problem).gradient["widths"]) - start)
    return total / (8 * FINE)


def _gain_of_widths(alike: Search, different: Search, problem: Problem) -> float:
    """Gain of log evidence by individual widths, in nats, by Laplace's method with widths that are taken as
    independent: the row sums of the Hessian replace its diagonal, as in `_posterior_spread`.

    -inf if some curvature is not positive: the search then ended at no maximum. `problem`: of which both costs are.
    """
    widths = different.coordinates["widths"]

    def slope(step):
        moved = different.coordinates | {"widths": widths + step}
        return np.asarray(cost_at(moved, different.cost.weights, problem).gradient["widths"])

    curvature = (slope(FINE) - slope(-FINE)) / (2 * FINE)
    if not np.all(curvature > 0):
        return -np.inf
    gain = float(alike.cost.value - different.cost.value)
    return gain - float(np.sum(np.log(problem.priors["widths"].sd * np.sqrt(curvature))))
