"""Hyperparameters of a large population, learnt from a random sample of participants, to bound time and memory.

docs/methods/which_method_models.md has a table of the shift of the optimum by the size of the sample. The map uses the
responses of all participants. Individual widths and sensitivities of participants outside the sample are fitted block
by block, with the other hyperparameters fixed.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from hilbo.ordinal_gp import Trials
from hilbo.population.learnt.posterior import KERNELS, LEFT, NOTHING, Problem, Stated, cost_at
from hilbo.population.learnt.rule import Learnt, learn
from hilbo.population.learnt.search import LARGEST, Search, searched
from hilbo.population.rules.recipes import LEARNT_1, Recipe
from hilbo.population.shared.features import pivots_for
from hilbo.population.shared.scale_use import INDIVIDUAL
from hilbo.population.shared.tallies import tallied

__all__ = ["SAMPLE", "learn_from_sample"]

SAMPLE = 1000
"""Largest sample of people from which the hyperparameters are learnt."""
_FINE = 1e-3  # of the finite difference for the curvature in a factor


def learn_from_sample(
    trials: Trials, categories: int, stated: Stated = NOTHING, recipe: Recipe = LEARNT_1, most: int = SAMPLE
) -> Learnt:
    """Hyperparameters by `recipe`, learnt from a random sample of at most `most` of the participants with responses.

    `trials`: stacked, (M, n), in `categories` categories; `stated`: specified hyperparameters, which are fixed. The
    sample is the same in every call. Weights outside the sample are 0; individual widths and sensitivities, if the
    model has them, are fitted for all participants. Raises `InputError` without responses; a search that fails does not
    raise: read `converged`.
    """
    answered = np.flatnonzero(np.asarray(trials.mask).any(axis=1))
    if len(answered) <= most:
        return learn(trials, categories, stated, recipe)
    rows = np.sort(np.random.default_rng(0).choice(answered, most, replace=False))
    learnt = learn(_of(trials, rows), categories, stated, recipe)
    people, room = len(trials.mask), tallied(trials, categories).x.shape[1]
    weights = np.zeros((people, room))
    weights[rows, : learnt.weights.shape[1]] = learnt.weights
    model, others = learnt.model, np.setdiff1d(np.arange(people), rows)
    own = [name for name in INDIVIDUAL if name in learnt.coordinates]
    values, sd, ended = {name: np.zeros(people) for name in own}, {name: np.zeros(people) for name in own}, True
    for name in own:
        values[name][rows], sd[name][rows] = learnt.coordinates[name], learnt.sd[name]
    for block in np.array_split(others, -(-len(others) // most)) if own else []:
        factors = _individual(learnt, own, _of(trials, block), categories, stated, recipe)
        for name in own:
            values[name][block], sd[name][block] = factors.values[name], factors.sd[name]
        ended = ended and factors.ended
    coordinates = learnt.coordinates | {name: jnp.asarray(value) for name, value in values.items()}
    model = dataclasses.replace(
        model,
        log_widths=coordinates.get("widths", jnp.zeros(people)),
        log_sensitivities=coordinates.get("sensitivities"),
    )
    return dataclasses.replace(
        learnt,
        model=model,
        weights=jnp.asarray(weights),
        coordinates=coordinates,
        sd=learnt.sd | {name: jnp.asarray(value) for name, value in sd.items()},
        converged=learnt.converged & ended,
        people=most,
    )


class _Individual(NamedTuple):
    """Log factors (M,) by name, their posterior standard deviations (M,), infinite where the curvature is not positive,
    and whether the search converged.
    """

    values: dict[str, Float[np.ndarray, " M"]]
    sd: dict[str, Float[np.ndarray, " M"]]
    ended: bool


def _individual(
    learnt: Learnt, own: list[str], trials: Trials, categories: int, stated: Stated, recipe: Recipe
) -> _Individual:
    """Log factors, those named in `own`, of participants outside the sample, with their standard deviations and whether
    the search ended; the other hyperparameters of `learnt` are fixed.
    """
    answers = tallied(trials, categories)
    start = learnt.coordinates | {name: jnp.zeros(len(trials.mask)) for name in own}
    pivots = pivots_for(learnt.model.unit, answers, LEFT, most=LARGEST)
    model, kernel = learnt.model, KERNELS[recipe.kernel]
    problem = Problem(answers, stated, recipe.priors, kernel, pivots, model.theta, fixed_point=model.fixed_point)
    begun = Search(start, cost_at(start, answers.blank, problem), 0, True)
    search, problem = searched(begun, problem, frozenset(own))

    values = {name: np.asarray(search.coordinates[name]) for name in own}
    return _Individual(values, _own_spread(search, problem, own), search.ended and bool(search.cost.usable))


def _own_spread(search: Search, problem: Problem, own: list[str]) -> dict[str, Float[np.ndarray, " M"]]:
    """Posterior standard deviations (M,) of the factors in `own`, of each participant's factors together, with all else
    fixed; infinite where the curvature is not positive definite.
    """

    def slopes(name: str) -> list[Float[np.ndarray, " M"]]:
        moved = search.coordinates | {name: search.coordinates[name] + _FINE}
        ahead = cost_at(moved, search.cost.weights, problem).gradient
        return [np.asarray(ahead[other] - search.cost.gradient[other]) / _FINE for other in own]

    if len(own) == 1:
        curvature = slopes(own[0])[0]
    else:
        (first, cross), (again, second) = map(slopes, own)
        cross = (cross + again) / 2
        determinant = np.where((first > 0) & (second > 0), first * second - cross**2, -1.0)
        curvature = np.stack([determinant / np.where(other > 0, other, 1.0) for other in (second, first)])
    sd = np.where(curvature > 0, 1 / np.sqrt(np.where(curvature > 0, curvature, 1.0)), np.inf)
    return dict(zip(own, np.atleast_2d(sd), strict=True))


def _of(trials: Trials, rows: Int[np.ndarray, " r"]) -> Trials:
    """Stacked trials of the participants in these rows."""
    return jax.tree.map(lambda leaf: leaf[rows], trials)
