"""Hyperparameters of a crowd: learnt from a random sample of its people, at a bounded cost.

25,000 answers determine what people have in common far better than they determine the best rendering; docs/methods/
which_method.md has how little a smaller sample moves it. The map is of everybody's answers. Where people have widths of
their own, those outside the sample get theirs by what the sample says of all others, block by block.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from hilbo.ordinal_gp import Trials
from hilbo.population.learnt.posterior import LEFT, NOTHING, Problem, Stated, cost_at
from hilbo.population.learnt.recipes import LEARNT_1, Recipe
from hilbo.population.learnt.rule import Learnt, learn
from hilbo.population.learnt.search import LARGEST, Search, searched
from hilbo.population.shared.features import pivots_for
from hilbo.population.shared.tallies import tallied

__all__ = ["SAMPLE", "learn_from_sample"]

SAMPLE = 1000
"""People from whom the hyperparameters are learnt, where there are more."""
_FINE = 1e-3  # of the finite difference for the curvature in a width


def learn_from_sample(
    trials: Trials, categories: int, stated: Stated = NOTHING, recipe: Recipe = LEARNT_1, most: int = SAMPLE
) -> Learnt:
    """`learn` from the stacked trials (M, n) of at most so many people, drawn at random from those who answered."""
    answered = np.flatnonzero(np.asarray(trials.mask).any(axis=1))
    if len(answered) <= most:
        return learn(trials, categories, stated, recipe)
    rows = np.sort(np.random.default_rng(0).choice(answered, most, replace=False))
    learnt = learn(_of(trials, rows), categories, stated, recipe)
    people, room = len(trials.mask), tallied(trials, categories).x.shape[1]
    weights = np.zeros((people, room))
    weights[rows, : learnt.weights.shape[1]] = learnt.weights
    widths, sd = np.zeros(people), np.zeros(people)
    if learnt.widths:
        widths[rows], sd[rows] = learnt.coordinates["widths"], learnt.sd["widths"]
        others = np.setdiff1d(np.arange(people), rows)
        for block in np.array_split(others, -(-len(others) // most)):
            own = _widths(learnt, _of(trials, block), categories, stated, recipe)
            widths[block], sd[block] = own.log, own.sd
        learnt = dataclasses.replace(
            learnt,
            coordinates=learnt.coordinates | {"widths": jnp.asarray(widths)},
            sd=learnt.sd | {"widths": jnp.asarray(sd)},
        )
    model = dataclasses.replace(learnt.model, log_widths=jnp.asarray(widths))
    return dataclasses.replace(learnt, model=model, weights=jnp.asarray(weights), people=most)


class _Widths(NamedTuple):
    """Logarithms of people's widths, and the standard deviations of their posterior."""

    log: Float[np.ndarray, " M"]
    sd: Float[np.ndarray, " M"]


def _widths(learnt: Learnt, trials: Trials, categories: int, stated: Stated, recipe: Recipe) -> _Widths:
    """Of people whose answers were not learnt from; what all people have in common stays. Their widths are taken for
    independent, as those of many people are where they are learnt."""
    answers = tallied(trials, categories)
    start = learnt.coordinates | {"widths": jnp.zeros(len(trials.mask))}
    pivots = pivots_for(learnt.model.unit, answers, LEFT, most=LARGEST)
    problem = Problem(answers, stated, recipe.priors, recipe.kernel, pivots, learnt.model.theta)
    begun = Search(start, cost_at(start, answers.blank, problem), 0, True)
    search, problem = searched(begun, problem, frozenset({"widths"}))
    moved = search.coordinates | {"widths": search.coordinates["widths"] + _FINE}
    ahead = cost_at(moved, search.cost.weights, problem).gradient["widths"]
    curvature = np.asarray(ahead - search.cost.gradient["widths"]) / _FINE
    sd = np.where(curvature > 0, 1 / np.sqrt(np.where(curvature > 0, curvature, 1.0)), np.inf)
    return _Widths(np.asarray(search.coordinates["widths"]), sd)


def _of(trials: Trials, rows: Int[np.ndarray, " r"]) -> Trials:
    """Stacked trials of some people."""
    return jax.tree.map(lambda leaf: leaf[rows], trials)
