"""Counts of responses at each distinct point: for repeated stimuli only the counts of the categories matter."""

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
    """Counts (M, n, C) of the responses of M participants in C categories, at individual points (M, n, d).

    Rows beyond a participant's points have counts 0. `context` (M, n): of each point, as an index; None without a
    random effect.
    """

    x: Float[Array, "M n d"]
    counts: Float[Array, "M n C"]
    """All 0 in rows beyond a person's points."""
    context: Int[Array, "M n"] | None = None
    """Of each point, of `contexts` in all; None without a random effect."""
    contexts: int = eqx.field(static=True, default=0)

    @property
    def asked(self) -> Bool[Array, "M n"]:
        """Mask (M, n) of rows with at least one response."""
        return jnp.sum(self.counts, axis=-1) > 0

    @property
    def blank(self) -> Float[Array, "M n"]:
        """Zeros (M, n), one for each row: weights that stand for no start."""
        return jnp.zeros(self.x.shape[:2], self.x.dtype)


def tallied(trials: Trials, categories: int, room: int = 0) -> Tallies:
    """Counts of stacked trials (M, n): each participant's distinct points (in one context), in the order of their first
    trial.

    `room`: least number of rows for each participant, so that shapes equal those of other counts. Not under `jit`.
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
    """Log-likelihood terms for `hilbo.laplace`, of `counts` (n, C) of responses in each category at n points."""

    likelihood: OrdinalProbit
    counts: Float[Array, "n C"]

    def __call__(self, eta: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, " n"], Float[Array, " n"]]:
        """Values, slopes and curvatures at the latent values `eta` (n,), (n,) each; 0 without responses."""
        return jax.vmap(partial(expand_counts, self.likelihood))(eta, self.counts)[:3]


@program
def fit_counts(gp: OrdinalGP, x: Float[Array, "n d"], counts: Float[Array, "n C"]) -> Posterior:
    """Laplace posterior of one participant from `counts` (n, C) of responses at points `x` (n, d), equal to that of
    `fit`.

    The posterior's `trials` have these points, and all categories 0. Never raises: read `certificate.converged`.
    """
    latent = laplace(gram(gp.kernel, x, x), CountTerms(gp.likelihood, counts))
    return Posterior(gp, Trials(x, jnp.zeros(len(x), jnp.int32), jnp.sum(counts, axis=1) > 0), latent)


def expand_counts(likelihood: OrdinalProbit, f: Float[Array, ""], counts: Float[Array, " C"]) -> Expansion:
    """Log-likelihood of `counts` (C,) of responses at one latent value `f`, its derivatives, and the sum of absolute
    slopes; scalars, 0 without responses.
    """
    parts = jax.vmap(lambda q: jnp.stack(likelihood.expand(f, q)))(jnp.arange(counts.shape[0]))
    parts = jnp.where(counts[:, None] > 0, counts[:, None] * parts, 0.0)
    value, slope, curvature = jnp.sum(parts, axis=0)
    return Expansion(value, slope, curvature, jnp.sum(jnp.abs(parts[:, 1])))
