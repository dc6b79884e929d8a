"""Populations whose best rendering is known, for benchmarks/populations.py.

A population makes, for one seed, people who take part and what a new person's highest answer depends on:

* *places*: the simulator of `hilbo.simulation` (everybody has a rendering that they like best), with the differences
  between people scaled, without lapses, in two groups, with widths of their own, or with its truth anywhere in the
  feasible set, every third time at a wall;
* *functions*: drawn from the hierarchical model, RBF or Matern 5/2, by random Fourier features; answers by thresholds.

None of these is the model that is fitted, but *functions, RBF*.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from hilbo.simulation.presets import PRESETS
from hilbo.simulation.simulate import people
from hilbo.study.config import Study

FEATURES, CROWD = 400, 2000
PAPER = Study.load(Path(__file__).parents[1] / "hilbo" / "data" / "paper.toml")


class Scene(NamedTuple):
    """People who take part, and the probability (m,) that a new person gives the highest answer at points (m, d)."""

    persons: eqx.Module
    chance: Callable[[jax.Array], jax.Array]


class Places(NamedTuple):
    """People of a preset, changed."""

    preset: str = "paper-individuals"
    differences: float = 1.0
    lapse: float | None = None
    groups: bool = False
    widths: float = 0.0
    anywhere: bool = False

    @property
    def study(self):
        return PAPER

    def scene(self, study, count, seed):
        population = PRESETS[self.preset]
        rng = np.random.default_rng([seed, 7])
        shift = np.zeros(study.space.dim)
        if self.anywhere:
            truth = unit_truth(study, population)
            shift = anywhere(study, rng, at_wall=seed % 3 == 0) - truth
        persons, crowd = (
            self._changed(study, people(study, population, m, s), shift, np.random.default_rng([s, 8]))
            for m, s in ((count, seed), (CROWD, 10**6 + seed % 3))
        )
        return Scene(persons, ChanceOfPlaces(crowd))

    def _changed(self, study, persons, shift, rng):
        truth = unit_truth(study, PRESETS[self.preset])
        optimum = truth + self.differences * (np.asarray(persons.optimum) - truth)
        if self.groups:
            other = rng.uniform(size=len(optimum)) < 0.5
            optimum = np.where(other[:, None], optimum + np.array([0.25, 0.2, 0.2]), optimum)
        optimum = inside(study, optimum + shift)
        criteria = np.asarray(persons.criteria)
        if self.widths:
            factor = np.exp(self.widths * rng.standard_normal((len(optimum), 1)))
            criteria = criteria[:, -1:] + factor * (criteria - criteria[:, -1:])
        lapse = np.asarray(persons.lapse) if self.lapse is None else np.full(len(optimum), self.lapse)
        arrays = (optimum, criteria, lapse)
        return eqx.tree_at(lambda p: (p.optimum, p.criteria, p.lapse), persons, tuple(map(jnp.asarray, arrays)))


class ChanceOfPlaces(eqx.Module):
    """Of the highest answer, on average over a crowd."""

    crowd: eqx.Module

    def __call__(self, x):
        crowd = self.crowd

        def one(x):
            distance = jnp.sqrt(jnp.sum(((x - crowd.optimum) / crowd.tolerance) ** 2, axis=1))
            felt = jax.scipy.special.ndtr((crowd.criteria[:, -1] - distance) / crowd.noise)
            return jnp.mean((1 - crowd.lapse) * felt + crowd.lapse / (crowd.criteria.shape[-1] + 1))

        return jax.lax.map(one, x)


def unit_truth(study, population):
    return np.asarray(study.space.to_unit(np.array([population.truth[name] for name in study.space.names])))


def inside(study, points):
    """Points that may be rendered: moved into the box, then along their column of the feasible set."""
    box = np.asarray(study.space.to_box(jnp.asarray(np.clip(points, 0.0, 1.0))))
    return np.asarray(study.space.from_box(jnp.asarray(np.clip(box, 0.0, 1.0))))


def anywhere(study, rng, at_wall):
    box = rng.uniform(size=study.space.dim)
    if at_wall:
        box[rng.integers(study.space.dim)] = float(rng.integers(2))
    return np.asarray(study.space.from_box(jnp.asarray(box)))


class Functions(NamedTuple):
    """People whose functions are drawn; thresholds where the classes have these shares on the whole. `dim`: parameters,
    each of 0 to 1; None for the paper's space."""

    theta: float
    share: float = 0.6
    matern: bool = False
    shares: tuple[float, ...] = (0.55, 0.2, 0.25)
    dim: int | None = None

    @property
    def study(self):
        """With the paper's fixed hyperparameters for the rules that take them as they are."""
        if self.dim is None and len(self.shares) == 3:
            return PAPER
        raw = {"schema": 1} | json.loads(PAPER.file.content)
        raw["study"] = {"name": "functions", "responses": [f"c{c}" for c in range(len(self.shares))]}
        raw["gp"] |= {"thresholds": np.linspace(-0.5, 0.5, len(self.shares) - 1).tolist()}
        if self.dim is not None:
            del raw["renderer"]
            raw["parameters"] = {f"p{i}": {"low": 0.0, "high": 1.0, "unit": ""} for i in range(self.dim)}
        return Study.from_dict(raw)

    def scene(self, study, count, seed):
        rng, d = np.random.default_rng([seed, 9]), study.space.dim
        scale = np.sqrt(rng.chisquare(5.0, (FEATURES, 1)) / 5.0) if self.matern else 1.0
        waves = np.sqrt(2.0 * self.theta) * rng.standard_normal((FEATURES, d)) / scale
        phases = rng.uniform(0, 2 * np.pi, FEATURES)
        variance, noise = 4.0, 1.0
        amplitude = np.sqrt(2.0 * variance / FEATURES)
        common = amplitude * np.sqrt(self.share) * rng.standard_normal(FEATURES)
        own = amplitude * np.sqrt(1.0 - self.share) * rng.standard_normal((count, FEATURES))
        points = np.asarray(study.space.candidates(512, 0))
        level = np.cos(points @ waves.T + phases) @ (common + own).T
        thresholds = np.quantile(level, np.cumsum(self.shares)[:-1])
        shape = (jnp.asarray(waves), jnp.asarray(phases))
        persons = Drawn(
            jnp.asarray(common + own),
            *(jnp.broadcast_to(leaf, (count, *leaf.shape)) for leaf in shape),
            jnp.asarray(np.tile(thresholds, (count, 1))),
            jnp.full(count, noise),
        )
        spread = np.sqrt(noise**2 + (1.0 - self.share) * variance)
        chance = ChanceOfFunctions(jnp.asarray(common), *shape, jnp.asarray(thresholds[-1]), jnp.asarray(spread))
        return Scene(persons, chance)


class ChanceOfFunctions(eqx.Module):
    """Of the highest answer of a person whose own function is not known."""

    weights: jax.Array
    waves: jax.Array
    phases: jax.Array
    threshold: jax.Array
    spread: jax.Array

    def __call__(self, x):
        mean = jnp.cos(x @ self.waves.T + self.phases) @ self.weights
        return jax.scipy.special.ndtr((mean - self.threshold) / self.spread)


class Drawn(eqx.Module):
    """A person with a function of random waves."""

    weights: jax.Array
    waves: jax.Array
    phases: jax.Array
    thresholds: jax.Array
    noise: jax.Array

    def answer(self, key, x, progress):
        del progress
        felt = jnp.cos(self.waves @ x + self.phases) @ self.weights + self.noise * jax.random.normal(key, (), x.dtype)
        return jnp.sum(felt > self.thresholds)


POPULATIONS = {
    "paper-individuals": Places(),
    "paper-individuals, differences × 0": Places(differences=0.0),
    "paper-individuals, differences × 1/2": Places(differences=0.5),
    "paper-individuals, differences × 2": Places(differences=2.0),
    "paper-individuals, no lapses": Places(lapse=0.0),
    "two groups": Places(groups=True),
    "widths of their own": Places(widths=0.5),
    "truth anywhere, a third at a wall": Places(anywhere=True),
    "functions, RBF, theta 4": Functions(4.0),
    "functions, RBF, theta 12": Functions(12.0),
    "functions, Matérn 5/2, theta 4": Functions(4.0, matern=True),
    "functions, Matérn 5/2, theta 12": Functions(12.0, matern=True),
    "functions, RBF, two parameters": Functions(12.0, dim=2),
    "functions, RBF, four parameters": Functions(4.0, dim=4),
    "functions, RBF, five categories": Functions(4.0, shares=(0.3, 0.2, 0.2, 0.15, 0.15)),
} | {name: Places(name) for name in PRESETS if name not in ("paper", "paper-individuals")}
