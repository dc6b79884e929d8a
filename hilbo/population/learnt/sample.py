"""Hyperparameters of a large population, learnt from a random sample of participants, to bound time and memory.

docs/methods/which_method.md has a table of the shift of the optimum by the size of the sample. The map uses the
responses of all participants. Where the model has individual threshold widths, those of participants outside the sample
are fitted block by block, with the other hyperparameters fixed.
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
from hilbo.population.shared.tallies import tallied

__all__ = ["SAMPLE", "learn_from_sample"]

SAMPLE = 1000
"""Largest sample of people from which the hyperparameters are learnt."""
_FINE = 1e-3  # of the finite difference for the curvature in a width


def learn_from_sample(
    trials: Trials, categories: int, stated: Stated = NOTHING, recipe: Recipe = LEARNT_1, most: int = SAMPLE
) -> Learnt:
    """Hyperparameters by `recipe`, learnt from a random sample of at most `most` of the participants with responses.

    `trials`: stacked, (M, n), in `categories` categories; `stated`: specified hyperparameters, which are fixed. The
    sample is the same in every call. Weights outside the sample are 0; individual widths, if the model has them, are
    fitted for all participants. Raises `InputError` without responses; a search that fails does not raise: read
    `converged`.
    """
    answered = np.flatnonzero(np.asarray(trials.mask).any(axis=1))
    if len(answered) <= most:
        return learn(trials, categories, stated, recipe)
    rows = np.sort(np.random.default_rng(0).choice(answered, most, replace=False))
    learnt = learn(_of(trials, rows), categories, stated, recipe)
    people, room = len(trials.mask), tallied(trials, categories).x.shape[1]
    weights = np.zeros((people, room))
    weights[rows, : learnt.weights.shape[1]] = learnt.weights
    widths, sd, ended = np.zeros(people), np.zeros(people), True
    if learnt.scale is not None:
        widths[rows], sd[rows] = learnt.coordinates["widths"], learnt.sd["widths"]
        others = np.setdiff1d(np.arange(people), rows)
        for block in np.array_split(others, -(-len(others) // most)):
            own = _widths(learnt, _of(trials, block), categories, stated, recipe)
            widths[block], sd[block], ended = own.log, own.sd, ended and own.ended
        learnt = dataclasses.replace(
            learnt,
            coordinates=learnt.coordinates | {"widths": jnp.asarray(widths)},
            sd=learnt.sd | {"widths": jnp.asarray(sd)},
            converged=learnt.converged & ended,
        )
    model = dataclasses.replace(learnt.model, log_widths=jnp.asarray(widths))
    return dataclasses.replace(learnt, model=model, weights=jnp.asarray(weights), people=most)


class _Widths(NamedTuple):
    """Log widths (M,), their posterior standard deviations (M,), infinite where the curvature is not positive, and
    whether the search converged.
    """

    log: Float[np.ndarray, " M"]
    sd: Float[np.ndarray, " M"]
    ended: bool


def _widths(learnt: Learnt, trials: Trials, categories: int, stated: Stated, recipe: Recipe) -> _Widths:
    """Log widths of participants outside the sample, with the other hyperparameters of `learnt` fixed.

    Standard deviations are from the curvature in each width alone, as for many participants in `learn`.
    """
    answers = tallied(trials, categories)
    start = learnt.coordinates | {"widths": jnp.zeros(len(trials.mask))}
    pivots = pivots_for(learnt.model.unit, answers, LEFT, most=LARGEST)
    problem = Problem(answers, stated, recipe.priors, KERNELS[recipe.kernel], pivots, learnt.model.theta)
    begun = Search(start, cost_at(start, answers.blank, problem), 0, True)
    search, problem = searched(begun, problem, frozenset({"widths"}))
    moved = search.coordinates | {"widths": search.coordinates["widths"] + _FINE}
    ahead = cost_at(moved, search.cost.weights, problem).gradient["widths"]
    curvature = np.asarray(ahead - search.cost.gradient["widths"]) / _FINE
    sd = np.where(curvature > 0, 1 / np.sqrt(np.where(curvature > 0, curvature, 1.0)), np.inf)
    return _Widths(np.asarray(search.coordinates["widths"]), sd, search.ended and bool(search.cost.usable))


def _of(trials: Trials, rows: Int[np.ndarray, " r"]) -> Trials:
    """Stacked trials of the participants in these rows."""
    return jax.tree.map(lambda leaf: leaf[rows], trials)
