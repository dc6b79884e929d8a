"""Everybody's answers, the repeated ones added up: at one point only how often each category was chosen counts."""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hilbo.kernels import gram
from hilbo.laplace import laplace
from hilbo.likelihoods import OrdinalProbit
from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import OrdinalGP, Posterior, Trials

__all__ = ["CountTerms", "Expansion", "Tallies", "expand_counts", "fit_counts", "tallied"]


class Tallies(eqx.Module):
    """How often each of M people chose each of C categories, at points of their own."""

    x: Float[Array, "M n d"]
    counts: Float[Array, "M n C"]
    """All 0 in rows beyond a person's points."""
    context: Int[Array, "M n"] | None = None
    """Of each point, of `contexts` in all; None without a random effect."""
    contexts: int = eqx.field(static=True, default=0)

    @property
    def asked(self) -> Bool[Array, "M n"]:
        """Where a person gave an answer."""
        return jnp.sum(self.counts, axis=-1) > 0

    @property
    def blank(self) -> Float[Array, "M n"]:
        """A zero for each point."""
        return jnp.zeros(self.x.shape[:2], self.x.dtype)


def tallied(trials: Trials, categories: int, room: int = 0) -> Tallies:
    """Stacked trials (M, n), each person's points once in each context, in the order in which they were first asked.

    `room`: for how many points at least, for the shapes to be those of other answers.
    """
    x, q, mask = (np.asarray(leaf) for leaf in (trials.x, trials.q, trials.mask))
    context = np.zeros(q.shape, np.int32) if trials.context is None else np.asarray(trials.context)
    people, capacity, d = x.shape
    capacity, longest = max(capacity, room), max(room, 1)
    points, counts = np.zeros((people, capacity, d), x.dtype), np.zeros((people, capacity, categories), x.dtype)
    contexts = np.zeros((people, capacity), np.int32)
    for person in range(people):
        asked, answers, of = (each[person][mask[person]] for each in (x, q, context))
        both = np.concatenate([asked, of[:, None]], axis=1)
        _, first, place = np.unique(both, axis=0, return_index=True, return_inverse=True)
        order = np.argsort(first)  # of the sorted points, by their first trial
        rank = np.empty_like(order)
        rank[order] = np.arange(len(order))
        points[person, : len(order)] = asked[first[order]]
        contexts[person, : len(order)] = of[first[order]]
        np.add.at(counts[person], (rank[place.reshape(-1)], answers), 1.0)
        longest = max(longest, len(order))
    held = Tallies(jnp.asarray(points[:, :longest]), jnp.asarray(counts[:, :longest]))
    if trials.context is None:
        return held
    return Tallies(held.x, held.counts, jnp.asarray(contexts[:, :longest]), int(context.max()) + 1)


class Expansion(NamedTuple):
    """Log-likelihoods of answers, and their derivatives, at latent values."""

    value: Float[Array, "..."]
    slope: Float[Array, "..."]
    curvature: Float[Array, "..."]
    """Minus the second derivative."""
    slopes: Float[Array, "..."]
    """The sum of the answers' absolute slopes, by which the slope's rounding error is judged."""


class CountTerms(eqx.Module):
    """Log-likelihood terms of `hilbo.laplace`, of so many answers in each category at each of n points."""

    likelihood: OrdinalProbit
    counts: Float[Array, "n C"]

    def __call__(self, eta: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, " n"], Float[Array, " n"]]:
        """Values, slopes and curvatures at the latent values."""
        return jax.vmap(partial(expand_counts, self.likelihood))(eta, self.counts)[:3]


@program
def fit_counts(gp: OrdinalGP, x: Float[Array, "n d"], counts: Float[Array, "n C"]) -> Posterior:
    """Laplace's posterior of one person, as `fit` has it, from how often each category was chosen at n points. Never
    raises: read `certificate.converged`."""
    latent = laplace(gram(gp.kernel, x, x), CountTerms(gp.likelihood, counts))
    return Posterior(gp, Trials(x, jnp.zeros(len(x), jnp.int32), jnp.sum(counts, axis=1) > 0), latent)


def expand_counts(likelihood: OrdinalProbit, f: Float[Array, ""], counts: Float[Array, " C"]) -> Expansion:
    """At one latent value, of so many answers in each category; 0 of none."""
    parts = jax.vmap(lambda q: jnp.stack(likelihood.expand(f, q)))(jnp.arange(counts.shape[0]))
    parts = jnp.where(counts[:, None] > 0, counts[:, None] * parts, 0.0)
    value, slope, curvature = jnp.sum(parts, axis=0)
    return Expansion(value, slope, curvature, jnp.sum(jnp.abs(parts[:, 1])))
