"""A population of any size in bounded memory: everybody refitted and aggregated in blocks, on any number of devices.

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
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from hilbo.gaussian import factor, mean_and_explained
from hilbo.kernels import Stationary, gram
from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import Posterior, Trials, fit
from hilbo.population.pointwise import Sums, terms
from hilbo.study.cohort import Cohort
from hilbo.study.config import Inference, Study
from hilbo.study.estimate.distributed import AXIS, Crew
from hilbo.study.estimate.optimum import Optimum, individual_optima

__all__ = ["Fitted", "Jets", "SayCount", "StreamedCohort", "block_size", "jets", "refit", "streamed_cohort", "sums"]

_TOGETHER = 64  # people whose predictions are made at once, except on CPUs: those hold one person's in their caches

_LARGEST = {True: 256, False: 1024}  # people of a block, on CPUs and elsewhere

SayCount = Callable[[str, int, int], None]
"""What is being done, to how many people so far, of how many."""


def _silent(words: str, done: int, people: int) -> None:
    del words, done, people


class Jets(NamedTuple):
    """Sums at points (s,), with their gradients (s, d) and Hessians (s, d, d)."""

    value: Sums
    gradient: Sums
    hessian: Sums


class StreamedCohort(eqx.Module):
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
    say: SayCount = eqx.field(static=True)
    rule: str = eqx.field(static=True, default="bcm")
    share: float = eqx.field(static=True, default=1.0)
    """Of the hierarchical rule; 1 otherwise."""

    @property
    def people(self) -> int:
        """M."""
        return self.trials.q.shape[0]

    def every(self, count: int) -> "StreamedCohort":
        """About `count` of the people, evenly chosen, and nobody watching."""
        rows = np.unique(np.linspace(0, self.people - 1, min(max(count, 1), self.people)).round().astype(int))
        trials = jax.tree.map(lambda leaf: leaf[rows], self.trials)
        modes = None if self.modes is None else self.modes[rows]
        return dataclasses.replace(self, trials=trials, modes=modes, say=_silent)

    def by(self, inference: Inference) -> "StreamedCohort":
        """The same people's answers for another inference."""
        return dataclasses.replace(self, modes=None, inference=inference)


class Fitted(NamedTuple):
    """What a first pass finds: certificates (M,) by field, individual optima if asked for, and sums at the points."""

    population: StreamedCohort
    sums: Sums
    certificate: dict[str, np.ndarray]
    individuals: Optimum | None


def streamed_cohort(study: Study, cohort: Cohort, crew: Crew, say: SayCount = _silent) -> StreamedCohort:
    """The people of a cohort, not yet fitted; by the study's inference."""
    trials = jax.tree.map(np.asarray, cohort.trials)
    people = len(cohort.names)
    block = block_size(people, crew.platform)
    group = min(_LARGEST[crew.platform == "cpu"] // block, -(-people // (block * crew.devices)))
    return StreamedCohort(study, trials, None, crew, block, group, study.inference, say)


def block_size(people: int, platform: str = "cpu") -> int:
    """People of a block: a power of two that makes 16 blocks or more, at most 256, on GPUs 1,024."""
    return min(_LARGEST[platform == "cpu"], 2 ** math.ceil(math.log2(max(1.0, people / 16))))


def refit(population: StreamedCohort, points: Float[np.ndarray, "m d"], individuals: bool = False) -> Fitted:
    """Fit everybody and add up what they say at points (m, d); `individuals`: and find everybody's own optimum, the
    points being its candidates."""
    words = "participants fitted"
    if individuals:
        words += ", each with an optimum of their own (--no-individuals leaves these out)"
    total, per_person = _sum_over_people(population, "individuals" if individuals else "first", points, words)
    fitted = dataclasses.replace(population, modes=per_person.get("modes"))
    optima = Optimum(*map(jnp.asarray, per_person["optima"])) if individuals else None
    return Fitted(fitted, total, per_person["certificate"], optima)


def sums(population: StreamedCohort, points: Float[np.ndarray, "m d"], words: str = "participants aggregated") -> Sums:
    """The sums over people at points (m, d)."""
    return _sum_over_people(population, "sums", points, words)[0]


def jets(population: StreamedCohort, points: Float[np.ndarray, "s d"], words: str = "participants aggregated") -> Jets:
    """The sums over people at points (s, d), with two derivatives."""
    return _sum_over_people(population, "jets", points, words)[0]


# --- one pass over all people

_Task = Literal["first", "individuals", "sums", "jets"]


def _sum_over_people(
    population: StreamedCohort, task: _Task, points: Float[np.ndarray, "m d"], words: str
) -> tuple[Any, Any]:
    """Block sums added in the order of the blocks, and what is kept of everybody in the order of people."""
    crew, people, size = population.crew, population.people, population.block
    per_round = crew.devices * population.group * size
    total, kept = None, []
    for first in range(0, people, per_round):
        rows = slice(first, min(first + per_round, people))
        count = rows.stop - first
        blocks = crew.deal(_padded_blocks(population, rows))
        by = population.rule, population.share
        on_devices = _blocks_on_devices(
            population.study, np.asarray(points), blocks, task, population.inference, crew, by
        )
        block_sums, per_person = jax.tree.map(lambda leaf: np.asarray(leaf).reshape(-1, *leaf.shape[2:]), on_devices)
        for i in range(-(-count // size)):
            block = jax.tree.map(lambda leaf, i=i: leaf[i], block_sums)
            total = block if total is None else jax.tree.map(np.add, total, block)
        kept.append(jax.tree.map(lambda leaf, n=count: leaf.reshape(-1, *leaf.shape[2:])[:n], per_person))
        population.say(words, rows.stop, people)
    return total, jax.tree.map(lambda *leaves: np.concatenate(leaves), *kept)


def _padded_blocks(population: StreamedCohort, rows: slice) -> tuple[Trials, np.ndarray | None]:
    """Trials and modes of some rows as (devices, group, block, ...), filled up with people who gave no answer."""
    shape = population.crew.devices, population.group, population.block

    def block(leaf):
        filled = np.zeros((math.prod(shape), *leaf.shape[1:]), leaf.dtype)
        filled[: rows.stop - rows.start] = leaf[rows]
        return filled.reshape(*shape, *leaf.shape[1:])

    return jax.tree.map(block, (population.trials, population.modes))


@program
def _blocks_on_devices(
    study: Study,
    points: Float[ArrayLike, "m d"],
    blocks: tuple[Trials, Float[Array, "devices group block n"] | None],
    task: _Task,
    inference: Inference,
    crew: Crew,
    by: tuple[str, float],
) -> tuple[Any, Any]:
    """A group of blocks on each device, one after the other; everything comes back to everybody."""

    def on_device(study, points, blocks):
        def make(block):
            trials, modes = block
            return _one_block(study, points, trials, modes, task, inference, crew.platform, by)

        out = jax.lax.map(make, jax.tree.map(lambda leaf: leaf[0], blocks))
        return jax.tree.map(lambda leaf: leaf[None], out)

    dealt, copied = PartitionSpec(AXIS), PartitionSpec()
    spread = jax.shard_map(
        on_device, mesh=crew.mesh, in_specs=(copied, copied, dealt), out_specs=dealt, check_vma=False
    )
    return jax.lax.with_sharding_constraint(spread(study, points, blocks), crew.everywhere)


def _one_block(
    study: Study,
    points: Float[Array, "m d"],
    trials: Trials,
    modes: Float[Array, "block n"] | None,
    task: _Task,
    inference: Inference,
    platform: str,
    by: tuple[str, float] = ("bcm", 1.0),
) -> tuple[Any, dict[str, Any]]:
    """Sums over the people of one block at the points, and what is kept of each of them."""
    if task in ("sums", "jets"):
        person_terms = _person_sums if task == "sums" else _person_jets
        predictors = _map_people(lambda person: _predictor_again(study, inference, *person), (trials, modes), platform)
        return _sum_of_block(lambda predictor: person_terms(predictor, points, by), predictors, platform), {}
    posteriors = _map_people(lambda person: fit(study.gp, person, inference=inference, throw=False), trials, platform)
    total = _sum_of_block(lambda posterior: _person_sums(_predictor(posterior), points, by), posteriors, platform)
    kept: dict[str, Any] = {"certificate": _as_dict(posteriors.certificate)}
    if inference == "laplace":
        kept["modes"] = posteriors.latent.mode
    if task == "individuals":
        optima = individual_optima(study, posteriors, points)
        kept["optima"] = (optima.x, optima.mean, optima.sd, optima.class_probabilities)
    return total, kept


class _Predictor(eqx.Module):
    """What it takes of a posterior to predict."""

    kernel: Stationary
    x: Float[Array, "n d"]
    weights: Float[Array, " n"]
    factor: Float[Array, "n n"]
    inverse: Float[Array, "n n"]


def _predictor(posterior: Posterior) -> _Predictor:
    latent = posterior.latent
    return _Predictor(posterior.gp.kernel, posterior.trials.x, latent.weights, latent.factor, latent.inverse)


def _predictor_again(study: Study, inference: Inference, trials: Trials, mode: Float[Array, " n"] | None) -> _Predictor:
    """One person's: Laplace's from the mode, the same numbers as the fit's; else by another fit."""
    if mode is None or inference != "laplace":
        return _predictor(fit(study.gp, trials, inference=inference, throw=False))
    kernel = study.gp.kernel
    _, slope, curvature = jax.vmap(study.gp.likelihood.expand)(mode, trials.q)
    weights, curvature = (jnp.where(trials.mask, values, jnp.zeros_like(values)) for values in (slope, curvature))
    root, _ = factor(gram(kernel, trials.x, trials.x), curvature)
    return _Predictor(kernel, trials.x, weights, root, root.T @ root)


def _as_dict(record: eqx.Module) -> dict[str, Array]:
    return {name: getattr(record, name) for name in record.__dataclass_fields__}


def _map_people(of_person: Callable, people: PyTree, platform: str) -> PyTree:
    """A function of one person for all: one after the other on a CPU, at once elsewhere."""
    return jax.lax.map(of_person, people) if platform == "cpu" else jax.vmap(of_person)(people)


def _sum_of_block(of_person: Callable, people: PyTree, platform: str) -> PyTree:
    """The sum of a function of one person over all people of a block."""
    count = jax.tree.leaves(people)[0].shape[0]
    group_size = 1 if platform == "cpu" else min(count, _TOGETHER)
    groups = jax.tree.map(lambda leaf: leaf.reshape(count // group_size, group_size, *leaf.shape[1:]), people)

    def of_group(group):
        if group_size == 1:
            return of_person(jax.tree.map(lambda leaf: leaf[0], group))
        return jax.tree.map(lambda leaf: jnp.sum(leaf, axis=0), jax.vmap(of_person)(group))

    shapes = jax.eval_shape(of_group, jax.tree.map(lambda leaf: leaf[0], groups))
    zero = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    return jax.lax.scan(lambda total, group: (jax.tree.map(jnp.add, total, of_group(group)), None), zero, groups)[0]


def _person_sums(predictor: _Predictor, points: Float[Array, "m d"], by: tuple[str, float]) -> Sums:
    """What one person adds to the sums of a rule at the points."""
    _, share = by
    cross = gram(predictor.kernel, predictor.x, points)
    means, explained = mean_and_explained(predictor.weights, predictor.factor, predictor.inverse, cross)
    return terms(means, explained, jax.vmap(predictor.kernel.diagonal)(points), share)


def _person_jets(predictor: _Predictor, points: Float[Array, "s d"], by: tuple[str, float]) -> Jets:
    """The same with gradient and Hessian at each point."""

    def sums_at(x):
        return jax.tree.map(lambda leaf: leaf[0], _person_sums(predictor, x[None, :], by))

    gradient_at = jax.jacrev(sums_at)
    return jax.vmap(lambda x: Jets(sums_at(x), gradient_at(x), jax.jacfwd(gradient_at)(x)))(points)
