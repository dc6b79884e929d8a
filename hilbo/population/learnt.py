"""The hierarchical model with hyperparameters learnt from all answers, by a recipe of `recipes`.

What maximises the Laplace evidence of all answers times the recipe's priors is taken, by L-BFGS from the priors'
medians, at first with the same widths for all; then with people's own, which are kept if they add 3 or more to the log
evidence. A hyperparameter that the study states is kept, and with a stated noise, or variance, everything is in its
unit. The normal approximation of their posterior says how well each is known; one that is known hardly better than
before the answers is not identified.
"""

import dataclasses
from collections.abc import Set
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from hilbo.errors import InputError
from hilbo.numerics.shown import shown
from hilbo.ordinal_gp import Posterior, Trials
from hilbo.population.learnt_posterior import (
    LEFT,
    NOTHING,
    Coordinates,
    Cost,
    Problem,
    Stated,
    cost_at,
    medians,
    model_at,
)
from hilbo.population.people_model import PeopleModel
from hilbo.population.recipes import LEARNT_1, Recipe
from hilbo.population.shared_features import rank_for
from hilbo.population.shared_posterior import SharedFunction, shared_function
from hilbo.population.tallies import tallied

__all__ = [
    "Learnt",
    "drawn_functions",
    "learn",
    "learnt_function",
]

_STEPS, _FINE = 100, 1e-3  # of the search; of the finite differences for the curvature
_NEAR = 2e-6  # of the evidence: another choice of features moves it as much as a nearer step would
_WORTH = 3.0  # log Bayes factor from which people have widths of their own, about 20 to 1
_LARGEST = 256  # features: functions that need more are too rugged to be shared by few answers
_ROUGH = 0.05
_AT_A_TIME = 2  # draws: much of their arithmetic is of one core
_WHOLE = 32  # people, up to whom the curvature in all widths is made: a gradient or two each


class Learnt(eqx.Module):
    """Hyperparameters of all people's answers, and how well they are known."""

    recipe: str = eqx.field(static=True)
    """Its name."""
    model: PeopleModel
    weights: Float[Array, "M n"]
    """Near which the posterior's mode is; one for each point that a person was asked at (`tallied`)."""
    log_evidence: Float[Array, ""]
    coordinates: Coordinates
    """Logarithms in units of the noise, and the middle of the thresholds, as in the priors."""
    sd: Coordinates
    """Standard deviations of their posterior."""
    covariance: Float[Array, "k k"]
    """Of their posterior, without widths: one after the other, as `ravel_pytree` has them."""
    gain_of_widths: Float[Array, ""]
    """What widths of people's own add to the log evidence; they are in the model if it is above 3."""
    steps: Int[Array, ""]
    rank: Int[Array, ""]
    left: Float[Array, ""]
    """Largest part of the shared function's prior variance, at an answered point, that is not followed."""
    converged: Bool[Array, ""]

    def __repr__(self) -> str:
        model, sure = self.model, shown(self.converged)
        values = {name: shown(getattr(model, name)) for name in ("theta", "thresholds", "noise")}
        words = ", ".join(f"{name} {value}" for name, value in values.items())
        return f"Learnt({words}, log evidence {shown(self.log_evidence)}, converged {sure})"

    @property
    def widths(self) -> bool:
        """Whether people have widths of their own."""
        return "widths" in self.coordinates


def learnt_function(learnt: Learnt, trials: Trials) -> SharedFunction:
    """The posterior of the shared function, and of a random effect, by learnt hyperparameters, from stacked trials (M,
    n)."""
    answers = tallied(trials, learnt.model.thresholds.size + 1)
    return shared_function(learnt.model, answers, learnt.weights, rank_for(learnt.model.unit, answers))


def drawn_functions(learnt: Learnt, trials: Trials, stated: Stated, seed: int, count: int) -> list[Posterior]:
    """Posteriors of the shared function by `count` draws of the hyperparameters from their posterior, taken for normal;
    widths stay as learnt. None where the search ended at no maximum, which that approximation does not describe.

    **Arguments:** `trials` and `stated`: those that were learnt from.
    """
    values, vectors = np.linalg.eigh(np.asarray(learnt.covariance + learnt.covariance.T) / 2)
    if not np.all(values > 0):
        return []
    flat, restore = ravel_pytree({name: value for name, value in learnt.coordinates.items() if name != "widths"})
    widths = {name: value for name, value in learnt.coordinates.items() if name == "widths"}
    steps = np.random.default_rng([seed, count]).standard_normal((count, flat.size)) * np.sqrt(values) @ vectors.T
    answers, unit = tallied(trials, learnt.model.thresholds.size + 1), learnt.model.unit
    rank = rank_for(unit, answers)

    def function(step: Float[np.ndarray, " k"]) -> Posterior:
        model = model_at(widths | restore(flat + step), answers, stated, type(unit))
        return jax.block_until_ready(shared_function(model, answers, learnt.weights, rank).function)

    with ThreadPoolExecutor(_AT_A_TIME) as pool:
        functions = list(pool.map(function, steps))
    return [each for each in functions if bool(each.certificate.converged)]


def learn(
    trials: Trials,
    categories: int,
    stated: Stated = NOTHING,
    recipe: Recipe = LEARNT_1,
    near: Learnt | None = None,
) -> Learnt:
    """The hyperparameters of stacked trials (M, n) of answers in `categories`.

    **Arguments:** `stated`: what is kept; `near`: what was learnt by the same recipe from nearly the same answers of as
    many people, where the search may begin. Raises InputError where nobody answered.
    """
    if not np.asarray(trials.mask).any():
        raise InputError(f"{recipe.name}: nobody gave an answer; at least one person's answers are needed.")
    answers = tallied(trials, categories)
    start = medians(answers, stated, recipe.priors, recipe.kernel)
    common = frozenset(start) - {"widths"}
    if near is not None:
        start |= {name: near.coordinates[name] for name in common}
    problem = Problem(answers, stated, recipe.priors, 0, recipe.kernel)
    alike = _Search(start, answers.blank, 0, True)
    alike, problem = _searched(alike, problem, common)
    chosen, free, gain = alike, common, 0.0
    if "widths" in start:
        different, wider = _searched(alike, problem, frozenset(start))
        gain = _gain_of_widths(alike, different, wider)
        if gain > _WORTH:
            chosen, free, problem = different, frozenset(start), wider
    end = cost_at(chosen.coordinates, chosen.weights, problem, chosen.coordinates)
    sd, covariance = _spread(chosen.coordinates, end, problem, free)
    return Learnt(
        recipe=recipe.name,
        model=model_at(chosen.coordinates, answers, stated, recipe.kernel),
        weights=end.weights,
        log_evidence=end.log_evidence,
        coordinates={name: value for name, value in chosen.coordinates.items() if name in free},
        sd=sd,
        covariance=covariance,
        gain_of_widths=jnp.asarray(gain),
        steps=jnp.asarray(chosen.steps),
        rank=jnp.asarray(problem.rank),
        left=end.left,
        converged=end.usable & jnp.asarray(chosen.ended) & (end.left <= _ROUGH),
    )


class _Search(NamedTuple):
    """Where a search is."""

    coordinates: Coordinates
    weights: Float[Array, "M n"]
    steps: int
    ended: bool


def _searched(search: _Search, problem: Problem, free: Set[str]) -> tuple[_Search, Problem]:
    """The maximum over the coordinates that are `free`, from where a search is; and the problem with the features that
    it takes: lengths that became shorter need more of them."""
    problem = _with_features(search, problem)
    while True:
        search = _descended(search, problem, free)
        larger = _with_features(search, problem)
        if larger.rank == problem.rank:
            return search, problem
        problem = larger


def _with_features(search: _Search, problem: Problem) -> Problem:
    kernel = model_at(search.coordinates, problem.answers, problem.stated, problem.kernel).unit
    needed = min(rank_for(kernel, problem.answers, LEFT), _LARGEST)
    return dataclasses.replace(problem, rank=max(problem.rank, needed))


def _descended(search: _Search, problem: Problem, free: Set[str]) -> _Search:
    """L-BFGS from where a search is; each mode is sought from the one before's."""
    from scipy.optimize import minimize  # a fifth of a second, which commands that learn nothing need not wait

    held = {name: value for name, value in search.coordinates.items() if name not in free}
    flat, restore = ravel_pytree({name: value for name, value in search.coordinates.items() if name in free})
    latest = search.weights

    def cost(z: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal latest
        coordinates = held | restore(jnp.asarray(z, flat.dtype))
        here = cost_at(coordinates, latest, problem, coordinates)
        if not bool(here.usable):  # the line search is to turn back
            return np.inf, np.zeros(flat.size)
        latest = here.weights
        slope = ravel_pytree({name: here.gradient[name] for name in free})[0]
        return float(here.value), np.asarray(slope, float)

    options = {"maxiter": _STEPS, "ftol": _NEAR, "gtol": 1e-3}
    result = minimize(cost, np.asarray(flat, float), jac=True, method="L-BFGS-B", options=options)
    end = held | restore(jnp.asarray(result.x, flat.dtype))
    return _Search(end, latest, search.steps + int(result.nit), bool(result.success))


def _gain_of_widths(alike: _Search, different: _Search, problem: Problem) -> float:
    """What widths of people's own add to the log evidence, by Laplace's method in each width alone. -inf where the
    search ended at no maximum of some width: the method then says nothing, and nobody has a width."""
    costs = [float(cost_at(s.coordinates, s.weights, problem, s.coordinates).value) for s in (alike, different)]
    widths = different.coordinates["widths"]

    def slope(step):
        moved = different.coordinates | {"widths": widths + step}
        return np.asarray(cost_at(moved, different.weights, problem, moved).gradient["widths"])

    curvature = (slope(_FINE) - slope(-_FINE)) / (2 * _FINE)
    if not np.all(curvature > 0):
        return -np.inf
    return costs[0] - costs[1] - float(np.sum(np.log(problem.priors["widths"].sd * np.sqrt(curvature))))


def _spread(
    coordinates: Coordinates, end: Cost, problem: Problem, free: Set[str]
) -> tuple[Coordinates, Float[Array, "k k"]]:
    """Standard deviations of the posterior of what is `free`, taken for normal, and the covariance without widths: its
    curvature from differences of gradients with that at the `end` of the search. Standard deviations are infinite where
    the curvature says that there is no maximum.

    Widths of many people are taken for independent given the rest. What stands for each one's curvature is then its row
    of the Hessian added up, which keeps that of all widths together: they may rise where the gaps fall.
    """
    common = {name: value for name, value in coordinates.items() if name in free - {"widths"}}
    flat, restore = ravel_pytree(common)

    def difference(way: Coordinates) -> Coordinates:
        moved = coordinates | {name: coordinates[name] + _FINE * step for name, step in way.items()}
        ahead = cost_at(moved, end.weights, problem, coordinates).gradient
        return jax.tree.map(lambda a, b: (a - b) / _FINE, ahead, end.gradient)

    def of_common(moved: Coordinates) -> np.ndarray:
        return np.asarray(ravel_pytree({name: moved[name] for name in common})[0])

    columns = [difference(restore(unit)) for unit in jnp.eye(flat.size, dtype=flat.dtype)]
    hessian = np.stack([of_common(column) for column in columns])
    if "widths" not in free:
        covariance = np.linalg.inv(hessian)
        return restore(jnp.asarray(_root_of_diagonal(covariance))), jnp.asarray(covariance)
    mixed = np.stack([np.asarray(column["widths"]) for column in columns])
    widths = coordinates["widths"]
    if widths.size <= _WHOLE:
        columns_of_widths = [
            difference({"widths": unit})["widths"] for unit in jnp.eye(widths.size, dtype=widths.dtype)
        ]
        curvature = np.stack([np.asarray(row) for row in columns_of_widths])
    else:
        curvature = np.diag(np.asarray(difference({"widths": jnp.ones_like(widths)})["widths"]))
    covariance = np.linalg.inv(np.block([[hessian, mixed], [mixed.T, curvature]]))
    sd, k = _root_of_diagonal(covariance), flat.size
    return restore(jnp.asarray(sd[:k])) | {"widths": jnp.asarray(sd[k:])}, jnp.asarray(covariance[:k, :k])


def _root_of_diagonal(covariance: Float[np.ndarray, "k k"]) -> Float[np.ndarray, " k"]:
    """Square roots of the variances, where they are some."""
    variances = np.diagonal(covariance)
    return np.sqrt(np.where(variances > 0, variances, np.inf))
