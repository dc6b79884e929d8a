"""Individual use of the response scale, by sensitivities and widths, where the evidence is for it."""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.linalg import hadamard

from hilbo.population.learnt.posterior import Coordinates, Problem, cost_at
from hilbo.population.learnt.search import Search, searched
from hilbo.population.rules.recipes import Recipe
from hilbo.population.shared.scale_use import INDIVIDUAL

__all__ = ["FINE", "Chosen", "diagonals", "with_factors_if_worth"]

FINE = 1e-3
"""Step of finite differences for curvatures, in units of the coordinates."""
_GRADED = 4  # least categories for identifying widths and the fixed point in addition to sensitivities


class Chosen(NamedTuple):
    """The search that is used, its problem, the coordinates that were free in it, and the gain of log evidence by each
    kind of individual factors that was tried, in nats.
    """

    search: Search
    problem: Problem
    free: frozenset[str]
    gains: dict[str, float]

    @property
    def gain(self) -> float:
        """Gain of log evidence by all factors in the model, in nats."""
        return sum(gain for name, gain in self.gains.items() if name in self.free)


def with_factors_if_worth(alike: Search, problem: Problem, recipe: Recipe) -> Chosen:
    """Continue the search `alike`, in which participants use the scale alike, with individual factors.

    Sensitivities come first, about the highest threshold, then widths. With fewer than four categories these are not
    tried in addition to sensitivities. With more, the model is also fitted with sensitivities about the middle of the
    thresholds, which is chosen if the log evidence is larger by more than the recipe's `worth`.
    """
    if "spread" not in recipe.priors:
        return _with_widths_if_worth(_without(alike, problem), recipe)
    highest = _with_sensitivities_if_worth(_without(alike, problem), 1.0)
    if problem.answers.counts.shape[-1] < _GRADED:
        return highest if "sensitivities" in highest.free else _with_widths_if_worth(highest, recipe)
    highest = _with_widths_if_worth(highest, recipe)
    middle = _with_sensitivities_if_worth(_without(alike, problem), 0.0)
    if "sensitivities" not in middle.free:
        return highest
    middle = _with_widths_if_worth(middle, recipe)
    return middle if middle.gain > highest.gain + recipe.worth else highest


def _without(alike: Search, problem: Problem) -> Chosen:
    """The search without individual factors."""
    return Chosen(alike, problem, frozenset(alike.coordinates) - {"widths"}, {})


def _with_sensitivities_if_worth(alike: Chosen, fixed_point: float) -> Chosen:
    """Continue the search with individual sensitivities; they are kept if the log posterior, with sensitivities
    integrated out and their spread at its maximum, is larger.
    """
    search, problem = _with_sensitivities(alike.search, alike.problem, fixed_point)
    gain = float(_with_features_of(problem, alike).cost.value - search.cost.value)
    return _if_worth(alike, "sensitivities", gain, 0.0, search, problem, alike.free | {"sensitivities", "spread"})


def _with_widths_if_worth(before: Chosen, recipe: Recipe) -> Chosen:
    """Continue the search with individual widths, if it has any; they are kept if the log evidence is larger by more
    than the recipe's `worth`.
    """
    if "widths" not in before.search.coordinates:
        return before
    search, problem = searched(before.search, before.problem, before.free | {"widths"})
    same = _with_features_of(problem, before)
    if problem.information is not None:
        problem, search = _with_information(search, problem)
    gain = float(same.cost.value - search.cost.value) - _occam_factor_of_widths(search, problem)
    return _if_worth(before, "widths", gain, recipe.worth, search, problem, before.free | {"widths"})


def _if_worth(
    before: Chosen, name: str, gain: float, worth: float, search: Search, problem: Problem, free: frozenset[str]
) -> Chosen:
    """The search with the factors `name` if their gain is more than `worth`, else the one before; with the gain."""
    gains = before.gains | {name: gain}
    return Chosen(search, problem, free, gains) if gain > worth else before._replace(gains=gains)


def _with_features_of(other: Problem, chosen: Chosen) -> Search:
    """The chosen search with the cost by the features of `other`: costs by different features differ by more than a
    gain may.
    """
    search, problem = chosen.search, chosen.problem
    if other.pivots is problem.pivots:
        return search
    problem = dataclasses.replace(problem, pivots=other.pivots, theta=other.theta)
    return search._replace(cost=cost_at(search.coordinates, search.cost.weights, problem))


def _with_sensitivities(alike: Search, problem: Problem, fixed_point: float) -> tuple[Search, Problem]:
    """Continue the search `alike` with individual sensitivities, whose spread is learnt too: twice, by Laplace factors
    at its start and at its first end. The cost of the result has the factors of its end.
    """
    answers, free = problem.answers, frozenset(alike.coordinates) - {"widths"} | {"sensitivities", "spread"}
    dtype = answers.x.dtype
    search = alike._replace(
        coordinates=alike.coordinates
        | {
            "sensitivities": jnp.zeros(len(answers.x), dtype),
            "spread": jnp.asarray(problem.priors["spread"].mean, dtype),
        }
    )
    nothing = jnp.zeros(len(answers.x), dtype)
    problem = dataclasses.replace(problem, fixed_point=jnp.asarray(fixed_point, dtype), information=nothing)
    search = search._replace(cost=cost_at(search.coordinates, search.cost.weights, problem))
    for _ in range(2):
        problem, search = _with_information(search, problem)
        search, problem = searched(search, problem, free)
    problem, search = _with_information(search, problem)
    return search, problem


def _with_information(search: Search, problem: Problem) -> tuple[Problem, Search]:
    """The problem with the curvatures at the coordinates of `search` for its Laplace factors, and the search with the
    cost by these. Negative curvatures become 0: such responses do not constrain the sensitivity.
    """
    of_cost = diagonals(search, problem, "sensitivities")["sensitivities"]
    information = np.maximum(of_cost - np.exp(-2 * float(search.coordinates["spread"])), 0.0)
    problem = dataclasses.replace(problem, information=jnp.asarray(information, problem.answers.x.dtype))
    return problem, search._replace(cost=cost_at(search.coordinates, search.cost.weights, problem))


def diagonals(search: Search, problem: Problem, name: str) -> dict[str, Float[np.ndarray, " M"]]:
    """Diagonals (M,) of the blocks of the cost's Hessian in the coordinate `name` and each individual one.

    From 8 differences of its gradient along orthogonal signs, in whose mean most of what other participants' factors
    add cancels; exact for up to 8 participants. Reference: Bekas, Kokiopoulou & Saad (2007), Applied Numerical
    Mathematics 57:1214.
    """
    people, start = len(problem.answers.x), search.cost.gradient
    size = 1 << max(3, (people - 1).bit_length())
    total = {other: np.zeros(people) for other in INDIVIDUAL if other in start}
    for signs in hadamard(size)[size // 8 - 1 :: size // 8, :people]:
        ahead = _gradient(search, problem, name, FINE * signs)
        for other in total:
            total[other] += signs * (np.asarray(ahead[other]) - np.asarray(start[other]))
    return {other: value / (8 * FINE) for other, value in total.items()}


def _occam_factor_of_widths(search: Search, problem: Problem) -> float:
    """Occam factor (nats) of integrating over the log widths by Laplace's method; participants are treated as
    independent.

    Without sensitivities, row sums of the Hessian replace its diagonal, as in the posterior spread. With them, a
    participant's sensitivity is integrated out with the width. inf if some curvature is not positive: the search then
    ended at no maximum.
    """
    if problem.information is None:
        ahead, behind = (_gradient(search, problem, "widths", step)["widths"] for step in (FINE, -FINE))
        curvature = np.asarray(ahead - behind) / (2 * FINE)
    else:
        of_widths = diagonals(search, problem, "widths")
        of_sensitivities = np.asarray(problem.information) + np.exp(-2 * float(search.coordinates["spread"]))
        curvature = of_widths["widths"] - of_widths["sensitivities"] ** 2 / of_sensitivities
    if not np.all(curvature > 0):
        return np.inf
    return float(np.sum(np.log(problem.priors["widths"].sd * np.sqrt(curvature))))


def _gradient(search: Search, problem: Problem, name: str, step: float | Float[np.ndarray, " M"]) -> Coordinates:
    """Gradient of the cost where the coordinate `name` (M,) is larger by `step`."""
    value = search.coordinates[name]
    moved = search.coordinates | {name: value + jnp.asarray(step, value.dtype)}
    return cost_at(moved, search.cost.weights, problem).gradient
