"""The hierarchical model with hyperparameters learnt from all responses, by a recipe of `rules.recipes`.

The hyperparameters maximise the Laplace evidence of all responses times the recipe's priors, by L-BFGS from the priors'
medians, at first with the same use of the scale for all participants; then with individual sensitivities and widths,
which are kept if they are worth it by the evidence. Hyperparameters that the study specifies are fixed, and with a
specified noise, or variance, all others are in its unit. Their uncertainty is from a normal approximation of the
posterior; one that is hardly narrower than its prior is not identified.
"""

import dataclasses
from collections.abc import Callable
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
from hilbo.population.learnt.factors import Chosen, with_factors_if_worth
from hilbo.population.learnt.posterior import (
    KERNELS,
    LEFT,
    NOTHING,
    Coordinates,
    Stated,
    cost_at,
    medians,
    model_at,
)
from hilbo.population.learnt.search import LARGEST, first_search, searched
from hilbo.population.learnt.spread import posterior_spread
from hilbo.population.rules.recipes import LEARNT_1, WIDTHS, Recipe
from hilbo.population.shared.features import Pivots, pivots_for, unexplained
from hilbo.population.shared.people_model import PeopleModel
from hilbo.population.shared.posterior import SharedFunction, shared_function
from hilbo.population.shared.scale_use import INDIVIDUAL, ScaleUse
from hilbo.population.shared.tallies import Tallies, tallied

__all__ = [
    "DrawnMap",
    "Learnt",
    "drawn_maps",
    "learn",
    "learnt_features",
    "learnt_function",
    "not_learnt",
]

_ROUGH = 0.05, 0.5  # what features may leave at an answered point: of the shared variance, and over the noise variance
_OFF = 0.25  # posterior standard deviations, by which too few features may shift a hyperparameter
_AT_A_TIME = 2  # draws: much of their arithmetic is of one core
_MOST_FEATURES, _NUMBERS = 1024, 64_000_000  # of the shared function; of all people's features, half a gigabyte


class Learnt(eqx.Module):
    """Hyperparameters learnt from all responses, with a normal approximation of their posterior: `sd` by coordinate,
    and `covariance` (k, k) without individual ones. `converged`: the search ended at a maximum, with enough features.
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
    """Of their posterior, without widths and sensitivities: one after the other, as `ravel_pytree` has them."""
    gains: dict[str, Float[Array, ""]]
    """Gain of log evidence by individual "sensitivities" and "widths", as far as they were tried; those that gained
    enough (`factors`) are in the model."""
    steps: Int[Array, ""]
    rank: Int[Array, ""]
    left: Float[Array, ""]
    """Largest part of the shared function's prior variance, at an answered point, that is not followed."""
    converged: Bool[Array, ""]
    people: int = eqx.field(static=True)
    """From whose answers they were learnt."""

    def __repr__(self) -> str:
        """One line: theta, thresholds and noise of the model, log evidence, and whether the search converged."""
        model, sure = self.model, shown(self.converged)
        values = {name: shown(getattr(model, name)) for name in ("theta", "thresholds", "noise")}
        words = ", ".join(f"{name} {value}" for name, value in values.items())
        return f"Learnt({words}, log evidence {shown(self.log_evidence)}, converged {sure})"

    @property
    def scale(self) -> ScaleUse | None:
        """How participants differ in the use of the scale; None if they do not, by the evidence."""
        return _scale_at(self.coordinates, self.model.fixed_point)


def learnt_function(learnt: Learnt, trials: Trials) -> SharedFunction:
    """Posterior of the shared function, and of a random effect, with learnt hyperparameters, which are not fitted
    again.

    `trials`: stacked (M, n), those that were learnt from, or some of them. Never raises for a fit that has not
    converged.
    """
    answers, pivots = learnt_features(learnt, trials)
    return shared_function(learnt.model, answers, learnt.weights, pivots)


def learnt_features(learnt: Learnt, trials: Trials) -> tuple[Tallies, Pivots]:
    """Counts of the responses, and the pivots of the shared function's features; arguments as for
    `learnt_function`."""
    answers = _as_learnt(learnt, trials)
    return answers, pivots_for(learnt.model.unit, answers, most=_most_features(answers))


def _as_learnt(learnt: Learnt, trials: Trials) -> Tallies:
    """Counts of the responses, with as many rows for each participant as those that were learnt from."""
    return tallied(trials, learnt.model.thresholds.size + 1, learnt.weights.shape[1])


class DrawnMap(NamedTuple):
    """Posterior of the shared function by drawn hyperparameters, and these: the model, and how participants differ in
    the use of the scale.
    """

    function: Posterior
    model: PeopleModel
    scale: ScaleUse | None


def drawn_maps(
    learnt: Learnt,
    trials: Trials,
    stated: Stated,
    seed: int,
    count: int,
    say: Callable[[int, int], None] = lambda done, count: None,
) -> list[DrawnMap]:
    """Maps for `count` draws of the hyperparameters from their normal posterior; individual sensitivities and widths
    stay.

    Draws whose fit does not converge are left out; the list is empty if the covariance is not positive definite, since
    the search then ended at no maximum. `trials` and `stated`: those that were learnt from. `say`:
    called with the number of maps done, and of all.
    """
    covariance = np.asarray(learnt.covariance + learnt.covariance.T) / 2
    if not np.all(np.isfinite(covariance)):
        return []
    values, vectors = np.linalg.eigh(covariance)
    if not np.all(values > 0):
        return []
    flat, restore = ravel_pytree({name: value for name, value in learnt.coordinates.items() if name not in INDIVIDUAL})
    individual = {name: value for name, value in learnt.coordinates.items() if name in INDIVIDUAL}
    steps = np.random.default_rng([seed, count]).standard_normal((count, flat.size)) * np.sqrt(values) @ vectors.T
    unit, answers = learnt.model.unit, _as_learnt(learnt, trials)
    rank = len(pivots_for(unit, answers).points)

    def drawn(step: Float[np.ndarray, " k"]) -> DrawnMap:
        coordinates = individual | restore(flat + step)
        model = model_at(coordinates, answers, stated, type(unit), learnt.model.fixed_point)
        pivots = pivots_for(model.unit, answers, fewest=rank, most=rank)
        function = jax.block_until_ready(shared_function(model, answers, learnt.weights, pivots).function)
        return DrawnMap(function, model, _scale_at(coordinates, learnt.model.fixed_point))

    with ThreadPoolExecutor(_AT_A_TIME) as pool:
        maps = []
        for drawn_map in pool.map(drawn, steps):
            maps.append(drawn_map)
            say(len(maps), count)
    return [each for each in maps if bool(each.function.certificate.converged)]


def _scale_at(coordinates: Coordinates, fixed_point: Float[Array, ""] | None) -> ScaleUse | None:
    """How participants differ in the use of the scale at these coordinates; None if they do not."""
    width = jnp.asarray(WIDTHS.sd, coordinates["widths"].dtype) if "widths" in coordinates else None
    sensitivity = jnp.exp(coordinates["spread"]) if "spread" in coordinates else None
    return None if width is None and sensitivity is None else ScaleUse(width, sensitivity, fixed_point)


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
        raise InputError(f"{recipe.name}: there are no responses; at least one participant's are needed.")
    answers = tallied(trials, categories, 0 if near is None else near.weights.shape[1])
    start = medians(answers, stated, recipe.priors, KERNELS[recipe.kernel])
    common = frozenset(start) - {"widths"}
    if near is not None:
        start |= {name: near.coordinates[name] for name in common}
    begun, problem = first_search(start, answers, stated, recipe)
    if near is not None and not bool(begun.cost.usable):
        return learn(trials, categories, stated, recipe)
    chosen = with_factors_if_worth(*searched(begun, problem, common), recipe)
    return _recorded(*_with_enough_features(chosen, *posterior_spread(chosen)), recipe)


def not_learnt(trials: Trials, categories: int, stated: Stated = NOTHING, recipe: Recipe = LEARNT_1) -> Learnt:
    """The model at the medians of the recipe's priors, with nothing learnt, to compare with `learn`.

    Arguments, and the error raised without responses, as for `learn`; all people have the same widths.
    """
    if not np.asarray(trials.mask).any():
        raise InputError(f"{recipe.name}: there are no responses; at least one participant's are needed.")
    answers = tallied(trials, categories)
    search, problem = first_search(
        medians(answers, stated, recipe.priors, KERNELS[recipe.kernel]), answers, stated, recipe
    )
    nothing = jnp.zeros((0, 0), trials.x.dtype)
    return _recorded(Chosen(search, problem, frozenset(), {}), {}, nothing, True, recipe)


def _with_enough_features(
    chosen: Chosen, sd: Coordinates, covariance: Float[Array, "k k"]
) -> tuple[Chosen, Coordinates, Float[Array, "k k"], bool]:
    """The end of a search and its posterior spread, continued with more features if too few of them shift a
    hyperparameter by more than `_OFF`; and whether the features are enough in the end.

    The shift is one Newton step by the gradient with more features, computed only where the features leave more of the
    shared function's variance than `_ROUGH`. Whether participants differ in the use of the scale is not decided again.
    """
    search, problem, free, _ = chosen
    most, rough = _most_features(problem.answers), _is_rough(chosen)
    if not rough or most <= len(problem.pivots.points):
        return chosen, sd, covariance, not rough
    model = _model_of(chosen)
    pivots = pivots_for(model.unit, problem.answers, LEFT, fewest=len(problem.pivots.points), most=most)
    finer = dataclasses.replace(problem, pivots=pivots, theta=model.theta)
    cost = cost_at(search.coordinates, search.cost.weights, finer)
    names = free - set(INDIVIDUAL)
    shift = covariance @ ravel_pytree({name: cost.gradient[name] - search.cost.gradient[name] for name in names})[0]
    if np.all(np.abs(shift) <= _OFF * ravel_pytree({name: sd[name] for name in names})[0]):
        return chosen, sd, covariance, True
    further, finer = searched(search._replace(cost=cost), finer, free, most)
    more = chosen._replace(search=further, problem=finer)
    return more, *posterior_spread(more), not _is_rough(more)


def _most_features(answers: Tallies) -> int:
    """Largest number of features that memory allows for these responses."""
    return max(LARGEST, min(_MOST_FEATURES, _NUMBERS // answers.blank.size))


def _model_of(chosen: Chosen) -> PeopleModel:
    """The model at the end of a search."""
    problem = chosen.problem
    return model_at(chosen.search.coordinates, problem.answers, problem.stated, problem.kernel, problem.fixed_point)


def _left(chosen: Chosen) -> Float[Array, ""]:
    """Largest part of the shared function's prior variance, at an answered point, that the features leave."""
    return unexplained(_model_of(chosen).unit, chosen.problem.answers, chosen.problem.pivots)


def _is_rough(chosen: Chosen) -> bool:
    """Whether the features leave more than `_ROUGH`."""
    model, left = _model_of(chosen), float(_left(chosen))
    return left > _ROUGH[0] or left * float(model.shared / model.noise**2) > _ROUGH[1]


def _recorded(chosen: Chosen, sd: Coordinates, covariance: Float[Array, "k k"], enough: bool, recipe: Recipe) -> Learnt:
    """Result of a search, with the standard deviations and the covariance of its coordinates; `enough`: whether its
    features are enough."""
    search, problem, free, gains = chosen
    model, left = _model_of(chosen), _left(chosen)
    return Learnt(
        recipe=recipe.name,
        model=model,
        weights=search.cost.weights,
        log_evidence=search.cost.log_evidence,
        coordinates={name: value for name, value in search.coordinates.items() if name in free},
        sd=sd,
        covariance=covariance,
        gains={name: jnp.asarray(gain) for name, gain in gains.items()},
        steps=jnp.asarray(search.steps),
        rank=jnp.asarray(len(problem.pivots.points)),
        left=left,
        converged=search.cost.usable & jnp.asarray(search.ended) & enough,
        people=len(problem.answers.x),
    )
