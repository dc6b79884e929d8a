"""Bayesian committee machine: the posteriors of M participants aggregated into one population map.

Paper, section V, for one latent score with prior variance k and participants' posteriors N(mu_j, sigma_j^2):

    1 / sigma^2 = sum_j 1 / sigma_j^2 - (M - 1) / k,        mu = sigma^2 sum_j mu_j / sigma_j^2.

It is computed as 1 / sigma^2 = 1 / k + sum_j s_j with s_j = e_j / (k (k - e_j)): the precision that person j *adds*,
from the variance e_j = k - sigma_j^2 that the answers explain. A person without data adds exactly 0, and 100,000 weak
experts keep the digits that a difference of two large sums would lose. The sum over people is one reduction; when
M x m does not fit in memory, [`stream`][] makes it one expert at a time.
Reference: Tresp (2000), Neural Computation 12:2719.
"""

import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, PyTree

from hilbo.errors import InputError

__all__ = ["Evidence", "average", "combine", "combine_explained", "stream"]


def __dir__() -> list[str]:
    return __all__


_Map = tuple[Float[Array, " m"], Float[Array, " m"]]
"""Mean and variance (m,) of the population map."""

_one_program = functools.partial(jax.jit, inline=True)
"""Decorator: called outside of any program it is one program, not one for each operation."""


class Evidence(eqx.Module):
    """What people add to the prior at m points, a running sum: added precision, and precision-weighted means."""

    added: Float[Array, " m"]
    weighted: Float[Array, " m"]

    def merge(self, prior_variance: Float[Array, "..."]) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
        """Mean and variance (m,) of the population map."""
        variance = prior_variance / (1.0 + prior_variance * self.added)
        return variance * self.weighted, variance


def combine(
    means: Float[Array, "M m"],
    variances: Float[Array, "M m"],
    prior_variance: ArrayLike,
    *,
    mask: Bool[Array, " M"] | None = None,
    throw: bool = True,
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Population mean and variance (m,) from participants' posterior means and variances at the same m points.

    **Arguments:**

    - `means`, `variances`: (M, m).
    - `prior_variance`: k, a scalar or (m,), the same for all participants.
    - `mask`: (M,), False for absent participants.
    - `throw`: raise for variances that are not positive, for more variance after the answers than before as a
      whole (no positive precision), or for priors that differ; `False` returns NaN there.

    Where the explained variance is known directly, [`combine_explained`][] is more precise for weak experts.
    """
    means, variances = _people(means, variances, "variances")
    prior = _checked_prior(prior_variance, means)
    return combine_explained(means, prior[None, :] - variances, prior, mask=mask, throw=throw)


def combine_explained(
    means: Float[Array, "M m"],
    explained: Float[Array, "M m"],
    prior_variance: ArrayLike,
    *,
    mask: Bool[Array, " M"] | None = None,
    throw: bool = True,
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """As [`combine`][], with its errors, from the variances e_j = k - sigma_j^2 that the answers explain, (M, m).

    Raises `InputError` for other shapes.
    """
    means, explained = _people(means, explained, "explained")
    prior = _checked_prior(prior_variance, means)
    merged, invalid = _merged(means, explained, prior, mask)
    return _raise_if(invalid, merged) if throw else merged


def stream(
    expert: Callable[[PyTree], tuple[Float[Array, " m"], Float[Array, " m"]]],
    experts: PyTree,
    prior_variance: Float[Array, ""] | Float[Array, " m"],
) -> Evidence:
    """The evidence of many experts, one after the other: a CPU's caches hold one expert's predictions.

    **Arguments:** `expert`: gives mean and explained variance (m,) of one expert; `experts`: what it is called with,
    stacked along a leading axis of length M.
    """

    def evidence_of(one):
        means, explained = (row[None] for row in expert(one))
        return _evidence(means, explained, jnp.broadcast_to(prior_variance, means.shape[1:]), None)

    shape = jax.eval_shape(evidence_of, jax.tree.map(lambda leaf: leaf[0], experts))
    total = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shape)
    return jax.lax.scan(lambda sums, one: (_add(sums, evidence_of(one)), None), total, experts)[0]


def average(
    means: Float[Array, "M m"], variances: Float[Array, "M m"], *, mask: Bool[Array, " M"] | None = None
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Plain average of the latent functions, for comparison (paper, section II-C): every person counts the same,
    however little is known; mean (m,), and the variance (m,) of the mean of independent functions.

    Raises `InputError` for other shapes.
    """
    means, variances = _people(means, variances, "variances")
    return _averaged(means, variances, mask)


@_one_program
def _averaged(means: Float[Array, "M m"], variances: Float[Array, "M m"], mask: Bool[Array, " M"] | None) -> _Map:
    """Of `average`, with arrays that were checked."""
    present = jnp.ones(means.shape[0], bool) if mask is None else mask
    present = present.astype(means.dtype)
    share = present / jnp.sum(present)
    return share @ means, share**2 @ variances


@_one_program
def _merged(
    means: Float[Array, "M m"],
    explained: Float[Array, "M m"],
    prior: Float[Array, " m"],
    mask: Bool[Array, " M"] | None,
) -> tuple[_Map, Bool[Array, " m"]]:
    """The map by the committee machine, NaN where it cannot be; and where that is."""
    evidence = _evidence(means, explained, prior, mask)
    invalid = _invalid(explained, prior, mask) | ~(1.0 + prior * evidence.added > 0.0)
    mean, variance = evidence.merge(prior)
    return (jnp.where(invalid, jnp.nan, mean), jnp.where(invalid, jnp.nan, variance)), invalid


def _evidence(
    means: Float[Array, "M m"],
    explained: Float[Array, "M m"],
    prior: Float[Array, " m"],
    mask: Bool[Array, " M"] | None,
) -> Evidence:
    remaining = prior[None, :] - explained
    added, weighted = explained / (prior[None, :] * remaining), means / remaining
    if mask is not None:
        added, weighted = (jnp.where(mask[:, None], by_person, 0.0) for by_person in (added, weighted))
    return Evidence(jnp.sum(added, axis=0), jnp.sum(weighted, axis=0))


def _add(left: Evidence, right: Evidence) -> Evidence:
    return jax.tree.map(jnp.add, left, right)


def _people(
    means: Float[ArrayLike, "M m"], others: Float[ArrayLike, "M m"], name: str
) -> tuple[Float[Array, "M m"], Float[Array, "M m"]]:
    """Both as arrays of one shape. Raises `InputError` for others."""
    means, others = jnp.asarray(means), jnp.asarray(others)
    if means.ndim != 2 or means.shape != others.shape:
        raise InputError(
            f"bcm: means has shape {means.shape} and {name} {others.shape}; give both as (M, m): a row for each"
            " participant, a column for each point."
        )
    return means, others


def _checked_prior(prior_variance: ArrayLike, means: Float[Array, "M m"]) -> Float[Array, " m"]:
    """One value per point."""
    prior = jnp.asarray(prior_variance, means.dtype)
    if prior.ndim > 1 or (prior.ndim == 1 and prior.shape != means.shape[1:]):
        raise InputError(
            f"bcm: the prior variance has shape {prior.shape}; the committee machine needs one prior for all experts,"
            f" a scalar or one value per point {means.shape[1:]}."
        )
    return jnp.broadcast_to(prior, means.shape[1:])


def _invalid(
    explained: Float[Array, "M m"], prior: Float[Array, " m"], mask: Bool[Array, " M"] | None
) -> Bool[Array, " m"]:
    """Points at which some expert's variance is not positive (or NaN)."""
    wrong = ~(prior[None, :] - explained > 0.0)
    return jnp.any(wrong if mask is None else wrong & mask[:, None], axis=0)


def _raise_if(invalid: Bool[Array, " m"], merged: _Map) -> _Map:
    message = (
        "bcm: an expert's variance is not positive, or the experts' variances exceed the prior's so far that no"
        " positive precision is left; check that prior_variance is the one all experts were fitted with"
    )
    if isinstance(invalid, jax.core.Tracer):
        return eqx.error_if(merged, invalid, message)
    if np.any(invalid):
        raise InputError(f"{message} (first at point {int(np.argmax(invalid))}).")
    return merged
