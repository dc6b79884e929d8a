"""The hierarchical model with hyperparameters learnt from all responses, by a recipe of `rules.recipes`.

The hyperparameters maximise the Laplace evidence of all responses times the recipe's priors, by L-BFGS from the priors'
medians, at first with the same widths for all participants; then with individual ones, which are kept if they add 3 or
more to the log evidence. Hyperparameters that the study specifies are fixed, and with a specified noise, or variance,
all others are in its unit. Their uncertainty is from a normal approximation of the posterior; one that is hardly
narrower than its prior is not identified.
"""

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
from hilbo.population.learnt.posterior import (
    KERNELS,
    NOTHING,
    Coordinates,
    Problem,
    Stated,
    cost_at,
    medians,
    model_at,
)
from hilbo.population.learnt.search import LARGEST, Search, first_search, searched
from hilbo.population.rules.recipes import LEARNT_1, Recipe
from hilbo.population.shared.features import pivots_for, unexplained
from hilbo.population.shared.people_model import PeopleModel
from hilbo.population.shared.posterior import SharedFunction, shared_function
from hilbo.population.shared.tallies import Tallies, tallied

__all__ = [
    "Learnt",
    "drawn_functions",
    "learn",
    "learnt_function",
    "not_learnt",
]

_FINE = 1e-3  # of the finite differences for the curvature
_WORTH = 3.0  # log Bayes factor from which people have widths of their own, about 20 to 1
_ROUGH = 0.05
_AT_A_TIME = 2  # draws: much of their arithmetic is of one core
_MOST_FEATURES, _NUMBERS = 1024, 64_000_000  # of the shared function; of all people's features, half a gigabyte
_WHOLE = 32  # people, up to whom the curvature in all widths is made: a gradient or two each


class Learnt(eqx.Module):
    """Hyperparameters learnt from all responses, with a normal approximation of their posterior: `sd` by coordinate,
    and `covariance` (k, k) without widths. `converged`: the search ended at a maximum with accurate features.
    """

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
    people: int = eqx.field(static=True)
    """From whose answers they were learnt."""

    def __repr__(self) -> str:
        model, sure = self.model, shown(self.converged)
        values = {name: shown(getattr(model, name)) for name in ("theta", "thresholds", "noise")}
        words = ", ".join(f"{name} {value}" for name, value in values.items())
        return f"Learnt({words}, log evidence {shown(self.log_evidence)}, converged {sure})"

    @property
    def widths(self) -> bool:
        """Whether participants have individual widths of the middle categories."""
        return "widths" in self.coordinates


def learnt_function(learnt: Learnt, trials: Trials) -> SharedFunction:
    """Posterior of the shared function, and of a random effect, with learnt hyperparameters, which are not fitted
    again.

    `trials`: stacked (M, n), those that were learnt from, or some of them. Never raises for a fit that has not
    converged.
    """
    answers = _as_learnt(learnt, trials)
    most = max(LARGEST, min(_MOST_FEATURES, _NUMBERS // answers.blank.size))
    pivots = pivots_for(learnt.model.unit, answers, most=most)
    return shared_function(learnt.model, answers, learnt.weights, pivots)


def _as_learnt(learnt: Learnt, trials: Trials) -> Tallies:
    """Counts of the responses, with as many rows for each participant as those that were learnt from."""
    return tallied(trials, learnt.model.thresholds.size + 1, learnt.weights.shape[1])


def drawn_functions(learnt: Learnt, trials: Trials, stated: Stated, seed: int, count: int) -> list[Posterior]:
    """Posteriors of the shared function for `count` draws of the hyperparameters from their normal posterior; widths
    stay.

    Draws whose fit does not converge are left out; the list is empty if the covariance is not positive definite, since
    the search then ended at no maximum. `trials` and `stated`: those that were learnt from.
    """
    covariance = np.asarray(learnt.covariance + learnt.covariance.T) / 2
    if not np.all(np.isfinite(covariance)):
        return []
    values, vectors = np.linalg.eigh(covariance)
    if not np.all(values > 0):
        return []
    flat, restore = ravel_pytree({name: value for name, value in learnt.coordinates.items() if name != "widths"})
    widths = {name: value for name, value in learnt.coordinates.items() if name == "widths"}
    steps = np.random.default_rng([seed, count]).standard_normal((count, flat.size)) * np.sqrt(values) @ vectors.T
    unit, answers = learnt.model.unit, _as_learnt(learnt, trials)
    rank = len(pivots_for(unit, answers).points)

    def function(step: Float[np.ndarray, " k"]) -> Posterior:
        model = model_at(widths | restore(flat + step), answers, stated, type(unit))
        pivots = pivots_for(model.unit, answers, fewest=rank, most=rank)
        return jax.block_until_ready(shared_function(model, answers, learnt.weights, pivots).function)

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
    """Learn the hyperparameters from stacked trials (M, n) with responses in `categories` categories.

    **Arguments:** `stated`: specified hyperparameters, which are fixed; `near`: result of the same recipe from nearly
    the same responses of as many participants, where the search starts; if it cannot, it starts at the priors' medians.

    A search that fails does not raise: read `converged`. Raises `InputError` without responses.
    """
    if not np.asarray(trials.mask).any():
        raise InputError(f"{recipe.name}: nobody gave an answer; at least one person's answers are needed.")
    answers = tallied(trials, categories, 0 if near is None else near.weights.shape[1])
    start = medians(answers, stated, recipe.priors, KERNELS[recipe.kernel])
    common = frozenset(start) - {"widths"}
    if near is not None:
        start |= {name: near.coordinates[name] for name in common}
    begun, problem = first_search(start, answers, stated, recipe)
    if near is not None and not bool(begun.cost.usable):
        return learn(trials, categories, stated, recipe)
    chosen = _with_widths_if_worth(*searched(begun, problem, common), frozenset(start))
    return _recorded(chosen, *_posterior_spread(chosen.search, chosen.problem, chosen.free), recipe)


def not_learnt(trials: Trials, categories: int, stated: Stated = NOTHING, recipe: Recipe = LEARNT_1) -> Learnt:
    """The model at the medians of the recipe's priors, with nothing learnt, to compare with `learn`.

    Arguments, and the error raised without responses, as for `learn`; all people have the same widths.
    """
    if not np.asarray(trials.mask).any():
        raise InputError(f"{recipe.name}: nobody gave an answer; at least one person's answers are needed.")
    answers = tallied(trials, categories)
    search, problem = first_search(
        medians(answers, stated, recipe.priors, KERNELS[recipe.kernel]), answers, stated, recipe
    )
    nothing = jnp.zeros((0, 0), trials.x.dtype)
    return _recorded(_Chosen(search, problem, frozenset(), 0.0), {}, nothing, recipe)


def _recorded(chosen: "_Chosen", sd: Coordinates, covariance: Float[Array, "k k"], recipe: Recipe) -> Learnt:
    """Result of a search, with the standard deviations and the covariance of its coordinates."""
    search, problem, free, gain = chosen
    answers = problem.answers
    model = model_at(search.coordinates, answers, problem.stated, problem.kernel)
    left = unexplained(model.unit, answers, problem.pivots)
    return Learnt(
        recipe=recipe.name,
        model=model,
        weights=search.cost.weights,
        log_evidence=search.cost.log_evidence,
        coordinates={name: value for name, value in search.coordinates.items() if name in free},
        sd=sd,
        covariance=covariance,
        gain_of_widths=jnp.asarray(gain),
        steps=jnp.asarray(search.steps),
        rank=jnp.asarray(len(problem.pivots.points)),
        left=left,
        converged=search.cost.usable & jnp.asarray(search.ended) & (left <= _ROUGH),
        people=len(answers.x),
    )


class _Chosen(NamedTuple):
    """The search that is used, its problem, the coordinates that were free in it, and the gain of log evidence by
    individual widths.
    """

    search: Search
    problem: Problem
    free: Set[str]
    gain: float


def _with_widths_if_worth(alike: Search, problem: Problem, coordinates: Set[str]) -> _Chosen:
    """Continue the search `alike`, with equal widths, with individual ones; return it if the log evidence gains more
    than 3, else `alike`.

    `coordinates`: names of all that are learnt; without "widths" among them nothing is searched, and the gain is 0.
    """
    without = _Chosen(alike, problem, coordinates - {"widths"}, 0.0)
    if "widths" not in coordinates:
        return without
    different, its_own = searched(alike, problem, coordinates)
    same = alike
    if its_own is not problem:  # costs by other features differ by more than a gain may
        same = alike._replace(cost=cost_at(alike.coordinates, alike.cost.weights, its_own))
    gain = _gain_of_widths(same, different, its_own)
    return _Chosen(different, its_own, coordinates, gain) if gain > _WORTH else without._replace(gain=gain)


def _gain_of_widths(alike: Search, different: Search, problem: Problem) -> float:
    """Gain of log evidence by individual widths, in nats, by Laplace's method with widths that are taken as
    independent: the row sums of the Hessian replace its diagonal, as in `_posterior_spread`.

    -inf if some curvature is not positive: the search then ended at no maximum. `problem`: of which both costs are.
    """
    widths = different.coordinates["widths"]

    def slope(step):
        moved = different.coordinates | {"widths": widths + step}
        return np.asarray(cost_at(moved, different.cost.weights, problem).gradient["widths"])

    curvature = (slope(_FINE) - slope(-_FINE)) / (2 * _FINE)
    if not np.all(curvature > 0):
        return -np.inf
    gain = float(alike.cost.value - different.cost.value)
    return gain - float(np.sum(np.log(problem.priors["widths"].sd * np.sqrt(curvature))))


def _posterior_spread(search: Search, problem: Problem, free: Set[str]) -> tuple[Coordinates, Float[Array, "k k"]]:
    """Posterior standard deviations of the `free` coordinates, by a normal approximation, and their covariance (k, k)
    without widths.

    The curvature is from differences of gradients at the end of the search. A standard deviation is infinite where the
    variance comes out not positive: then there is no maximum.

    Widths of more than 32 participants are taken as independent given the rest. Each one's curvature is then the row
    sum of the Hessian, which keeps that of all widths together: they may rise where the gaps fall.
    """
    coordinates, end = search.coordinates, search.cost
    common = {name: value for name, value in coordinates.items() if name in free - {"widths"}}
    flat, restore = ravel_pytree(common)

    def difference(way: Coordinates) -> Coordinates:
        moved = coordinates | {name: coordinates[name] + _FINE * step for name, step in way.items()}
        ahead = cost_at(moved, end.weights, problem).gradient
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
    """Standard deviations (k,) of a covariance; infinite where a variance is not positive."""
    variances = np.diagonal(covariance)
    return np.sqrt(np.where(variances > 0, variances, np.inf))
