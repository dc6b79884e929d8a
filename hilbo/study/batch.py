"""A population of any size in bounded memory: everybody refitted and merged in blocks, on any number of devices.

The committee machine (`hilbo.bcm`) needs two sums over people, of the precision each adds to the prior and of their
precision-weighted means. They are made block by block: a device fits the people of its block, adds up what they say at
the asked points, and forgets their posteriors. What stays of a person are the answers and Laplace's mode (n numbers),
from which the posterior is made again without a search: slopes and curvatures there. Another inference is fitted again.

Blocks depend on the number of people alone and are added in their order, whichever device made them, so that results do
not depend on how many there are. A block is padded with people without answers, who add exactly 0.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec
from jaxtyping import Array, Float

from hilbo.gaussian import factor, mean_and_explained
from hilbo.kernels import RBF, gram
from hilbo.ordinal_gp import Trials, fit
from hilbo.population.pointwise import Rule, Sums, terms
from hilbo.study.aggregate import Optimum, individual_optima
from hilbo.study.cohort import Cohort
from hilbo.study.config import Inference, Study
from hilbo.study.distributed import AXIS, Crew

__all__ = ["Fitted", "Jets", "Population", "Say", "block_size", "jets", "population_of", "refit", "sums"]

_TOGETHER = 64  # people whose predictions are made at once, except on CPUs: those hold one person's in their caches

_LARGEST = {True: 256, False: 1024}  # people of a block, on CPUs and elsewhere

Say = Callable[[str, int, int], None]
"""What is being done, to how many people so far, of how many."""


def _silent(words: str, done: int, people: int) -> None:
    del words, done, people


class Jets(NamedTuple):
    """Sums at points (s,), with their gradients (s, d) and Hessians (s, d, d)."""

    value: Sums
    gradient: Sums
    hessian: Sums


class Population(eqx.Module):
    """Everybody's answers (host arrays), the devices that work on them, and what is known of the posteriors."""

    study: Study
    trials: Trials
    modes: np.ndarray | None
    """(M, n) of everybody's latent values, once they have been fitted by Laplace's method."""
    crew: Crew = eqx.field(static=True)
    block: int = eqx.field(static=True)
    group: int = eqx.field(static=True)
    """Blocks that a device makes in one round."""
    inference: Inference = eqx.field(static=True)
    say: Say = eqx.field(static=True)
    rule: Rule = eqx.field(static=True, default="bcm")
    share: float = eqx.field(static=True, default=1.0)
    """Of the hierarchical rule; 1 otherwise."""

    @property
    def people(self) -> int:
        """M."""
        return self.trials.q.shape[0]

    def every(self, count: int) -> "Population":
        """About `count` of the people, evenly chosen, and nobody watching."""
        rows = np.unique(np.linspace(0, self.people - 1, min(max(count, 1), self.people)).round().astype(int))
        trials = jax.tree.map(lambda leaf: leaf[rows], self.trials)
        modes = None if self.modes is None else self.modes[rows]
        return dataclasses.replace(self, trials=trials, modes=modes, say=_silent)

    def by(self, inference: Inference) -> "Population":
        """The same people's answers for another inference."""
        return dataclasses.replace(self, modes=None, inference=inference)


class Fitted(NamedTuple):
    """What a first pass finds: certificates (M,) by field, individual optima if asked for, and sums at the points."""

    population: Population
    sums: Sums
    certificate: dict[str, np.ndarray]
    individuals: Optimum | None


def population_of(study: Study, cohort: Cohort, crew: Crew, say: Say = _silent) -> Population:
    """The people of a cohort, not yet fitted; by the study's inference."""
    trials = jax.tree.map(np.asarray, cohort.trials)
    people = len(cohort.names)
    block = block_size(people, crew.platform)
    group = min(_LARGEST[crew.platform == "cpu"] // block, -(-people // (block * crew.devices)))
    return Population(study, trials, None, crew, block, group, study.inference, say)


def block_size(people: int, platform: str = "cpu") -> int:
    """People of a block: a power of two that makes 16 blocks or more, at most 256, on GPUs 1,024."""
    return min(_LARGEST[platform == "cpu"], 2 ** math.ceil(math.log2(max(1.0, people / 16))))


def refit(population: Population, points: Float[np.ndarray, "m d"], individuals: bool = False) -> Fitted:
    """Fit everybody and add up what they say at points (m, d); `individuals`: and find everybody's own optimum, the
    points being its candidates."""
    words = "participants fitted, each with an optimum of their own (--no-individuals leaves these out)"
    words = words if individuals else "participants fitted"
    found, people = _pass(population, "individuals" if individuals else "first", points, words)
    fitted = dataclasses.replace(population, modes=people.get("modes"))
    optima = Optimum(*map(jnp.asarray, people["optima"])) if individuals else None
    return Fitted(fitted, found, people["certificate"], optima)


def sums(population: Population, points: Float[np.ndarray, "m d"], words: str = "participants merged") -> Sums:
    """The sums over people at points (m, d)."""
    return _pass(population, "sums", points, words)[0]


def jets(population: Population, points: Float[np.ndarray, "s d"], words: str = "participants merged") -> Jets:
    """The sums over people at points (s, d), with two derivatives."""
    return _pass(population, "jets", points, words)[0]


# --- one pass over all people

_Task = Literal["first", "individuals", "sums", "jets"]


def _pass(population, task: _Task, points, words) -> Any:
    """Block sums added in the order of the blocks, and what is kept of everybody in the order of people."""
    crew, people, size = population.crew, population.people, population.block
    together = crew.devices * population.group * size
    total, kept = None, []
    for begin in range(0, people, together):
        rows = slice(begin, min(begin + together, people))
        count = rows.stop - begin
        blocks = crew.deal(_padded(population, rows))
        by = population.rule, population.share
        found = _round(population.study, np.asarray(points), blocks, task, population.inference, crew, by)
        block_sums, each = jax.tree.map(lambda leaf: np.asarray(leaf).reshape(-1, *leaf.shape[2:]), found)
        for i in range(-(-count // size)):
            block = jax.tree.map(lambda leaf, i=i: leaf[i], block_sums)
            total = block if total is None else jax.tree.map(np.add, total, block)
        kept.append(jax.tree.map(lambda leaf, n=count: leaf.reshape(-1, *leaf.shape[2:])[:n], each))
        population.say(words, rows.stop, people)
    return total, jax.tree.map(lambda *leaves: np.concatenate(leaves), *kept)


def _padded(population, rows):
    """Trials and modes of some rows as (devices, group, block, ...), filled up with people who gave no answer."""
    shape = population.crew.devices, population.group, population.block

    def block(leaf):
        filled = np.zeros((math.prod(shape), *leaf.shape[1:]), leaf.dtype)
        filled[: rows.stop - rows.start] = leaf[rows]
        return filled.reshape(*shape, *leaf.shape[1:])

    return jax.tree.map(block, (population.trials, population.modes))


@eqx.filter_jit
def _round(study, points, blocks, task, inference, crew, by):
    """A group of blocks on each device, one after the other; everything comes back to everybody."""

    def on_device(study, points, blocks):
        def make(block):
            trials, modes = block
            return _block(study, points, trials, modes, task, inference, crew.platform, by)

        out = jax.lax.map(make, jax.tree.map(lambda leaf: leaf[0], blocks))
        return jax.tree.map(lambda leaf: leaf[None], out)

    dealt, copied = PartitionSpec(AXIS), PartitionSpec()
    spread = jax.shard_map(
        on_device, mesh=crew.mesh, in_specs=(copied, copied, dealt), out_specs=dealt, check_vma=False
    )
    return jax.lax.with_sharding_constraint(spread(study, points, blocks), crew.everywhere)


def _block(study, points, trials, modes, task, inference, platform, by=("bcm", 1.0)):
    if task in ("sums", "jets"):
        say = _sums_of if task == "sums" else _jets_of
        experts = _each(lambda person: _expert(study, inference, *person), (trials, modes), platform)
        return _added(lambda expert: say(expert, points, by), experts, platform), {}
    posteriors = _each(lambda person: fit(study.gp, person, inference=inference, throw=False), trials, platform)
    total = _added(lambda posterior: _sums_of(_of(posterior), points, by), posteriors, platform)
    kept: dict[str, Any] = {"certificate": _fields(posteriors.certificate)}
    if inference == "laplace":
        kept["modes"] = posteriors.latent.mode
    if task == "individuals":
        optima = individual_optima(study, posteriors, points)
        kept["optima"] = (optima.x, optima.mean, optima.sd, optima.class_probabilities)
    return total, kept


class _Expert(eqx.Module):
    """What it takes of a posterior to predict."""

    kernel: RBF
    x: Float[Array, "n d"]
    weights: Float[Array, " n"]
    factor: Float[Array, "n n"]
    inverse: Float[Array, "n n"]


def _of(posterior):
    latent = posterior.latent
    return _Expert(posterior.gp.kernel, posterior.trials.x, latent.weights, latent.factor, latent.inverse)


def _expert(study, inference, trials, mode):
    """One person's: Laplace's from the mode, the same numbers as the fit's; else by another fit."""
    if mode is None or inference != "laplace":
        return _of(fit(study.gp, trials, inference=inference, throw=False))
    kernel = study.gp.kernel
    _, slope, curvature = jax.vmap(study.gp.likelihood.expand)(mode, trials.q)
    weights, curvature = (jnp.where(trials.mask, part, jnp.zeros_like(part)) for part in (slope, curvature))
    root, _ = factor(gram(kernel, trials.x, trials.x), curvature)
    return _Expert(kernel, trials.x, weights, root, root.T @ root)


def _fields(record):
    return {name: getattr(record, name) for name in record.__dataclass_fields__}


def _each(function, people, platform):
    """A function of one person for all: one after the other on a CPU, at once elsewhere."""
    return jax.lax.map(function, people) if platform == "cpu" else jax.vmap(function)(people)


def _added(function, people, platform):
    """The sum of a function of one person over all people of a block."""
    count = jax.tree.leaves(people)[0].shape[0]
    together = 1 if platform == "cpu" else min(count, _TOGETHER)
    groups = jax.tree.map(lambda leaf: leaf.reshape(count // together, together, *leaf.shape[1:]), people)

    def of_group(group):
        if together == 1:
            return function(jax.tree.map(lambda leaf: leaf[0], group))
        return jax.tree.map(lambda leaf: jnp.sum(leaf, axis=0), jax.vmap(function)(group))

    shapes = jax.eval_shape(of_group, jax.tree.map(lambda leaf: leaf[0], groups))
    nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    return jax.lax.scan(lambda total, group: (jax.tree.map(jnp.add, total, of_group(group)), None), nothing, groups)[0]


def _sums_of(expert, points, by):
    rule, share = by
    cross = gram(expert.kernel, expert.x, points)
    means, explained = mean_and_explained(expert.weights, expert.factor, expert.inverse, cross)
    return terms(rule, means, explained, jax.vmap(expert.kernel.diagonal)(points), share)


def _jets_of(expert, points, by):
    def at(x):
        return jax.tree.map(lambda leaf: leaf[0], _sums_of(expert, x[None, :], by))

    slope = jax.jacrev(at)
    return jax.vmap(lambda x: Jets(at(x), slope(x), jax.jacfwd(slope)(x)))(points)
