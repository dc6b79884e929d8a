"""Simulated participants and studies with known truth.

A simulated person prefers one stimulus and perceives every other at a dissimilarity

    s = sqrt( sum_i ((x_i - optimum_i) / tolerance_i)^2 ) + drift * (trial / trials) + noise * e,    e ~ N(0, 1),

and responds with the highest category whose criterion exceeds s; with probability `lapse` the response is random. Two
different levels of a parameter have the distance of half a range. Where the study's goal is the lowest response, s is
negative: -(distance + drift). Where it is between other responses, as of "too soft", "right", "too hard", the person
perceives in place of the distance the signed sum of the differences

    sum_i (optimum_i - x_i) / tolerance_i / sqrt(d),

so that the preferred stimuli are those of a plane through the optimum. This is deliberately not the model that is
fitted: its tails are linear where the GP's are bounded. A whole study (all participants' space-filling and acquisition
trials) runs in one compiled call.
"""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Array, Float, Int, Key, PRNGKeyArray

from hilbo.errors import InputError
from hilbo.likelihoods import Goal
from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import Trials
from hilbo.search.apart import differences, levels_of
from hilbo.session.choose.selection import Design, design, next_point
from hilbo.study.config import Study

__all__ = ["Person", "Population", "people", "simulate_study", "to_table", "truth_table"]

_MOST_DRAWS = 2000  # of 64 people each
_LEVELS_APART = 0.5  # of a range


class Person(eqx.Module):
    """Simulated participant; leading axes for several. All in unit-cube coordinates."""

    optimum: Float[Array, "*M d"]
    tolerance: Float[Array, "*M d"]
    """Distance along each parameter that is perceived as one unit of dissimilarity."""
    criteria: Float[Array, "*M c"]
    """Decreasing, C - 1 of them: an s below all of them gives the highest category. As many are positive as there are
    categories below the goal."""
    noise: Float[Array, "*M"]
    lapse: Float[Array, "*M"]
    drift: Float[Array, "*M"]
    levels: tuple[int, ...] = eqx.field(static=True, default=())
    """For each parameter its number of unordered levels, 0 for numbers; empty where all are numbers."""
    goal: Goal | None = eqx.field(static=True, default=None)
    """Of the study; None is the highest response."""

    @property
    def direction(self) -> int:
        """Sign of s: -1 if the lowest response is the goal."""
        return 1 if self.goal is None or self.goal.category else -1

    def perceived(self, x: Float[Any, "*#M d"]) -> Float[Any, "*#M"]:
        """The value s of stimuli without drift and noise, an array for which NumPy or JAX is used as for `x`."""
        xp = jnp if isinstance(x, jax.Array) else np
        away = felt_apart(self.levels, x, self.optimum) / self.tolerance
        if self.goal is not None and self.goal.is_between:
            return -xp.sum(away, axis=-1) / away.shape[-1] ** 0.5
        return self.direction * xp.sqrt(xp.sum(away**2, axis=-1))

    def answer(self, key: PRNGKeyArray, x: Float[Array, " d"], progress: Float[Array, ""]) -> Int[Array, ""]:
        """Simulate the response to the stimulus `x` after the fraction `progress` of the session.

        `x` (d,) in the unit cube, `progress` from 0 to 1 -> a category, a scalar in 0..C-1.
        """
        perceive, lapse, guess = jax.random.split(key, 3)
        steady = self.perceived(x) + self.direction * self.drift * progress
        felt = steady + self.noise * jax.random.normal(perceive, (), x.dtype)
        judged = jnp.sum(felt < self.criteria)
        guessed = jax.random.randint(guess, (), 0, self.criteria.shape[-1] + 1, judged.dtype)
        return jnp.where(jax.random.uniform(lapse, (), x.dtype) < self.lapse, guessed, judged)


def felt_apart(levels: tuple[int, ...], x: Float[Any, "*#batch d"], y: Float[Any, "*#batch d"]) -> Float[Any, "... d"]:
    """Perceived differences x - y (..., d) of points, before division by the tolerances; half a range between different
    levels."""
    return differences(levels, x, y, _LEVELS_APART)


class Population(eqx.Module):
    """Distribution from which simulated participants are drawn.

    `truth` is the stimulus, in physical units, around which the optima lie with the standard deviations `spread` (unit
    cube; redrawn until inside the box and feasible); for a categorical parameter `spread` is the proportion of
    participants who prefer another level. Tolerances are log-normal around `tolerance` with the log standard deviation
    `tolerance_sd`, one factor per person; `drift` has mean 0 and standard deviation `drift_sd`.
    """

    truth: Mapping[str, float] = eqx.field(static=True)
    spread: tuple[float, ...] = eqx.field(static=True)
    tolerance: tuple[float, ...] = eqx.field(static=True)
    tolerance_sd: float = eqx.field(static=True)
    criteria: tuple[float, ...] = eqx.field(static=True)
    noise: float = eqx.field(static=True)
    lapse: float = eqx.field(static=True)
    drift_sd: float = eqx.field(static=True)
    contrast: float = eqx.field(static=True, default=0.0)
    """In a validation: fraction of the perceived difference between two stimuli that is added when they are compared
    side by side."""


def people(study: Study, population: Population, count: int, seed: int) -> Person:
    """Draw `count` participants from the population, stacked.

    Raises `InputError` if their criteria do not fit the study's number of responses, and if too few optima are
    feasible.
    """
    if len(population.criteria) != len(study.responses) - 1:
        raise InputError(
            f"simulate: the population has {len(population.criteria)} criteria, but the study's {len(study.responses)}"
            f" responses need {len(study.responses) - 1}."
        )
    rng = np.random.default_rng(seed)
    truth = np.asarray(study.space.to_unit(np.array([population.truth[name] for name in study.space.names])))
    optima, levels = np.empty((0, study.space.dim)), levels_of(study.space.parameters)
    for _ in range(_MOST_DRAWS):
        if len(optima) >= count:
            break
        drawn = truth + np.array(population.spread) * rng.standard_normal((64, study.space.dim))
        drawn = _with_levels(drawn, levels, truth, population.spread, rng) if levels else drawn
        drawn = np.asarray(study.space.completed(drawn))
        within = np.clip(drawn, 0, 1)
        liked = np.all(drawn == within, axis=1) & np.asarray(study.space.feasible(within))
        optima = np.concatenate([optima, drawn[liked]])
    if len(optima) < count:
        raise InputError(
            f"simulate: of {64 * _MOST_DRAWS:,} people drawn around the truth only {len(optima)} like a rendering of"
            " this study; move the truth of [simulation] into the feasible region, or reduce its spread."
        )
    factor = np.exp(population.tolerance_sd * rng.standard_normal((count, 1)))
    return Person(
        optimum=jnp.asarray(optima[:count]),
        tolerance=jnp.asarray(np.array(population.tolerance) * factor),
        criteria=jnp.asarray(np.tile(population.criteria, (count, 1))),
        noise=jnp.full(count, population.noise),
        lapse=jnp.full(count, population.lapse),
        drift=jnp.asarray(population.drift_sd * rng.standard_normal(count)),
        levels=levels,
        goal=None if study.goal.is_highest else study.goal,
    )


def _with_levels(
    drawn: Float[np.ndarray, "n d"],
    levels: tuple[int, ...],
    truth: Float[np.ndarray, " d"],
    spread: tuple[float, ...],
    rng: np.random.Generator,
) -> Float[np.ndarray, "n d"]:
    """Set the categorical coordinates of drawn optima, in place: the truth's level, or with probability `spread`
    another, random one. Returns the same array."""
    for i, count in ((i, count) for i, count in enumerate(levels) if count):
        moved = np.where(rng.random(len(drawn)) < spread[i], rng.integers(1, count, len(drawn)), 0)
        drawn[:, i] = (np.rint(truth[i] * (count - 1)) + moved) % count / (count - 1)
    return drawn


def simulate_study(study: Study, persons: Person, seed: int) -> Trials:
    """Simulate all sessions, space-filling and acquisition trials, in one compiled call. Returns stacked trials (M,
    ...).

    Each participant has an individual Latin hypercube; the candidates of the acquisition are shared.
    """
    count = persons.noise.shape[0]
    plan = design(study, seed)
    hypercubes = [study.space.latin_hypercube(len(plan.initial), 1 + seed * count + i) for i in range(count)]
    answering, drawing = (jax.random.split(key, count) for key in (plan.key, jax.random.fold_in(plan.key, 1)))
    return _simulate(study, plan, jnp.asarray(np.stack(hypercubes)), persons, answering, drawing)


@program
def _simulate(
    study: Study,
    plan: Design,
    initial: Float[Array, "M k d"],
    persons: Person,
    answering: Key[Array, " M"],
    drawing: Key[Array, " M"],
) -> Trials:
    """Compiled part of `simulate_study`.

    `initial`: space-filling points; `answering`: random keys of the responses, `drawing`: those of the acquisition's
    draws.
    """
    trials = study.file.selection.trials

    def answered(state, point, trial):
        def one(person, key, data, x):
            progress = (trial / trials).astype(x.dtype)
            return data.append(x, person.answer(jax.random.fold_in(key, trial), x, progress))

        return jax.vmap(one)(persons, answering, state, point)

    def filling(state, trial):
        return answered(state, initial[:, trial], trial), None

    def choosing(state, trial):
        def point(key, data):
            return next_point(study, eqx.tree_at(lambda p: p.key, plan, key), data, trial)

        points = jax.vmap(point)(drawing, state)
        return answered(state, points, trial), None

    empty = jax.vmap(lambda _: Trials.empty(trials, study.space.dim))(jnp.arange(initial.shape[0]))
    state, _ = jax.lax.scan(filling, empty, jnp.arange(initial.shape[1]))
    return jax.lax.scan(choosing, state, jnp.arange(initial.shape[1], trials))[0]


def to_table(study: Study, trials: Trials) -> pd.DataFrame:
    """The trial table of a simulated study: participants P01, P02, ..., points in physical units."""
    physical = np.asarray(study.space.to_physical(trials.x))
    people_count = len(trials.mask)
    width = max(2, len(str(people_count)))
    rows = np.argwhere(np.asarray(trials.mask))
    table = pd.DataFrame(
        {
            "participant": [f"P{person + 1:0{width}d}" for person, _ in rows],
            "trial": rows[:, 1] + 1,
            "response": np.array(study.responses)[np.asarray(trials.q)[tuple(rows.T)]],
        }
    )
    for i, p in enumerate(study.space.parameters):
        table[p.name] = p.column(physical[..., i][tuple(rows.T)])
    if study.file.random_effect is not None:
        table[study.file.random_effect] = "simulated"  # one level, and so no effect
    return table


def truth_table(study: Study, population: Population, persons: Person) -> pd.DataFrame:
    """True optima in physical units: a column `source` ("population", then "individual:P01" and so on) and one per
    parameter."""
    individual_sets = np.asarray(study.space.to_physical(persons.optimum))
    width = max(2, len(str(len(individual_sets))))
    centre = [population.truth[name] for name in study.space.names]
    values = np.vstack([centre, individual_sets])
    table = pd.DataFrame({p.name: p.column(values[:, i]) for i, p in enumerate(study.space.parameters)})
    table.insert(0, "source", ["population", *(f"individual:P{i + 1:0{width}d}" for i in range(len(individual_sets)))])
    return table
