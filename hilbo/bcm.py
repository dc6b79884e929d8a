"""Bayesian committee machine: aggregates the posteriors of M participants into one population map.

Paper, section V, for one latent score with prior variance k and participants' posteriors N(mu_j, sigma_j^2):

    1 / sigma^2 = sum_j 1 / sigma_j^2 - (M - 1) / k,        mu = sigma^2 sum_j mu_j / sigma_j^2.

It is computed as 1 / sigma^2 = 1 / k + sum_j s_j with s_j = e_j / (k (k - e_j)): the precision that participant j adds,
from the variance e_j = k - sigma_j^2 that the responses explain. A participant without data adds exactly 0, and 100,000
weak experts keep the digits that a difference of two large sums would lose. The sum over participants is one reduction;
when M x m does not fit in memory, [`stream`][] computes it one expert at a time. Reference: Tresp (2000), Neural
Computation 12:2719.
"""

import functools
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, PyTree

from hilbo.errors import InputError
from hilbo.numerics.host import to_device
from hilbo.numerics.shown import concrete, float_dtype, numbers

__all__ = ["Evidence", "average", "combine", "combine_explained", "stream"]


def __dir__() -> list[str]:
    return __all__


Numbers = ArrayLike | Sequence
"""An array, or lists of numbers."""
_Map = tuple[Float[Array, " m"], Float[Array, " m"]]
"""Mean and variance (m,) of the population map."""

_one_program = functools.partial(jax.jit, inline=True)
"""Decorator: compiles the whole function as one program when it is called outside of `jit`."""


class Evidence(eqx.Module):
    """Running sum of the participants' evidence at m points.

    `added` (m,): sum of the precisions that the participants add to the prior's; `weighted` (m,): sum of their
    posterior means, each divided by its posterior variance.
    """

    added: Float[Array, " m"]
    weighted: Float[Array, " m"]

    def merge(self, prior_variance: Float[Array, "..."]) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
        """Mean and variance (m,) of the population map; `prior_variance` k is a scalar or (m,).

        Nothing is checked: where the total precision 1 / k + `added` is not positive, the variance is negative or
        infinite.
        """
        variance = prior_variance / (1.0 + prior_variance * self.added)
        return variance * self.weighted, variance


def combine(
    means: Numbers, variances: Numbers, prior_variance: Numbers, *, mask: Numbers | None = None, throw: bool = True
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Population mean and variance (m,) from participants' posterior means and variances at the same m points.

    **Arguments:**

    - `means`, `variances`: (M, m).
    - `prior_variance`: k, a scalar or (m,), the same for all participants.
    - `mask`: (M,), False for absent participants, whose rows have no influence; without any participant the result is
      the prior, mean 0 and variance k.
    - `throw`: raise `InputError` (under `jit` a run-time error of equinox) for means that are not finite, for variances
      that are not positive, and if no positive precision is left; `False` returns NaN at those points.

    Raises `InputError` for other shapes and for a mask that is not boolean. If the explained variance is known
    directly, [`combine_explained`][] is more precise for weak experts.
    """
    means, variances, prior = _checked_arrays(means, "variances", variances, prior_variance)
    return combine_explained(means, prior[None, :] - variances, prior, mask=mask, throw=throw)


def combine_explained(
    means: Numbers, explained: Numbers, prior_variance: Numbers, *, mask: Numbers | None = None, throw: bool = True
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Population mean and variance (m,) as [`combine`][], from the explained variances e_j = k - sigma_j^2, (M, m).

    `prior_variance`: k, a scalar or (m,); `mask` (M,): False for absent participants. Raises `InputError` for other
    shapes, and with `throw` (under `jit` as a run-time error of equinox) for means that are not finite, for e_j of k or
    more, and if no positive precision is left; with `throw=False` the result is NaN at those points.
    """
    means, explained, prior = _checked_arrays(means, "explained", explained, prior_variance)
    merged, invalid = _merged(means, explained, prior, _present(mask, means))
    return _raise_if(invalid, merged) if throw else merged


def stream(
    expert: Callable[[PyTree], tuple[Float[Array, " m"], Float[Array, " m"]]],
    experts: PyTree,
    prior_variance: Float[Array, ""] | Float[Array, " m"],
) -> Evidence:
    """Sum the evidence of many experts one after the other, to limit memory use; nothing is checked.

    **Arguments:** `expert`: returns mean and explained variance (m,) of one expert; `experts`: its argument, a pytree
    stacked along a leading axis of length M; `prior_variance`: k, a scalar or (m,).

    **Returns:** the sums at the m points; their `merge` gives the population map.
    """

    def evidence_of(one):
        means, explained = (row[None] for row in expert(one))
        return _evidence(means, explained, jnp.broadcast_to(prior_variance, means.shape[1:]))

    shape = jax.eval_shape(evidence_of, jax.tree.map(lambda leaf: leaf[0], experts))
    total = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shape)
    return jax.lax.scan(lambda sums, one: (_add(sums, evidence_of(one)), None), total, experts)[0]


def average(
    means: Numbers, variances: Numbers, *, mask: Numbers | None = None
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Plain average of the latent functions, for comparison (paper, section II-C): all participants have equal weight.

    Returns the mean (m,) of the `means` (M, m), and its variance (m,) for independent functions: the sum of the
    `variances` (M, m) over the squared number of participants present in `mask` (M,). Raises `InputError` for other
    shapes or another type of mask, and if no participant is present; if the mask is traced, the average is then NaN.
    """
    means, variances, _ = _checked_arrays(means, "variances", variances, 1.0)
    present = _present(mask, means)
    if concrete(present) and not np.any(present):
        raise InputError("bcm: there are no participants; an average needs at least one.")
    return _averaged(means, variances, present)


@_one_program
def _averaged(means: Float[Array, "M m"], variances: Float[Array, "M m"], present: Bool[Array, " M"]) -> _Map:
    """Mean and variance (m,) of `average` from checked arrays; NaN if no participant is present."""
    means, variances = _present_rows(present, means), _present_rows(present, variances)
    count = jnp.sum(present)
    count = jnp.where(count > 0, count.astype(means.dtype), jnp.nan)
    return jnp.sum(means, axis=0) / count, jnp.sum(variances, axis=0) / count**2


@_one_program
def _merged(
    means: Float[Array, "M m"], explained: Float[Array, "M m"], prior: Float[Array, " m"], present: Bool[Array, " M"]
) -> tuple[_Map, Bool[Array, " m"]]:
    """Population map of the committee machine, NaN at invalid points; and the mask (m,) of invalid points. `explained`:
    prior minus posterior variance; `prior`: prior variance.

    Invalid: a present participant has a mean that is not finite or a variance that is not positive, or the total
    precision is not positive.
    """
    means, explained = _present_rows(present, means), _present_rows(present, explained)
    evidence = _evidence(means, explained, prior)
    invalid = _invalid(means, explained, prior) | ~(1.0 + prior * evidence.added > 0.0)
    mean, variance = evidence.merge(prior)
    return (jnp.where(invalid, jnp.nan, mean), jnp.where(invalid, jnp.nan, variance)), invalid


def _present_rows(present: Bool[Array, " M"], rows: Float[Array, "M m"]) -> Float[Array, "M m"]:
    """Rows of the participants who are present; 0, which adds nothing, for the others."""
    return jnp.where(present[:, None], rows, 0.0)


def _evidence(means: Float[Array, "M m"], explained: Float[Array, "M m"], prior: Float[Array, " m"]) -> Evidence:
    """Evidence of the M experts summed: explained / (k (k - explained)), and means / (k - explained), (m,) each."""
    remaining = prior[None, :] - explained
    added, weighted = explained / (prior[None, :] * remaining), means / remaining
    return Evidence(jnp.sum(added, axis=0), jnp.sum(weighted, axis=0))


def _add(left: Evidence, right: Evidence) -> Evidence:
    """Elementwise sum of two records of evidence."""
    return jax.tree.map(jnp.add, left, right)


def _checked_arrays(
    means: Numbers, name: str, others: Numbers, prior_variance: Numbers
) -> tuple[Float[Array, "M m"], Float[Array, "M m"], Float[Array, " m"]]:
    """Check `means`, `others` (called `name` in errors) and the prior variance; return them as arrays of one dtype.

    `means` and `others` keep their shape (M, m); the prior variance, a scalar or (m,), is broadcast to (m,). Raises
    `InputError` for other shapes and for values that are not numbers.
    """
    dtype = np.promote_types(float_dtype(means), float_dtype(others))
    means, others = numbers("bcm", "means", means, dtype), numbers("bcm", name, others, dtype)
    if means.ndim != 2 or means.shape != others.shape:
        raise InputError(
            f"bcm: means has shape {means.shape} and {name} {others.shape}; give both as (M, m): a row for each"
            " participant, a column for each point."
        )
    prior = numbers("bcm", "prior_variance", prior_variance, dtype)
    if prior.ndim > 1 or (prior.ndim == 1 and prior.shape != means.shape[1:]):
        raise InputError(
            f"bcm: the prior variance has shape {prior.shape}; the committee machine needs one prior for all experts,"
            f" a scalar or one value per point {means.shape[1:]}."
        )
    return means, others, jnp.broadcast_to(prior, means.shape[1:])


def _present(mask: Numbers | None, means: Float[Array, "M m"]) -> Bool[Array, " M"]:
    """Mask (M,) of the participants who are present, all of them if `mask` is None.

    Raises `InputError` for a mask of another shape, or one that is not boolean.
    """
    if mask is None:
        return to_device(np.ones(means.shape[0], bool))
    flags = numbers("bcm", "mask", mask)
    if flags.dtype != bool or flags.shape != means.shape[:1]:
        raise InputError(
            f"bcm: mask is {flags.dtype} of shape {flags.shape}; give True or False for each of {means.shape[0]}"
            " participants."
        )
    return flags


def _invalid(
    means: Float[Array, "M m"], explained: Float[Array, "M m"], prior: Float[Array, " m"]
) -> Bool[Array, " m"]:
    """Mask (m,) of points at which some mean is not finite, or some variance k - explained is not positive."""
    return jnp.any(~jnp.isfinite(means) | ~(prior[None, :] - explained > 0.0), axis=0)


def _raise_if(invalid: Bool[Array, " m"], merged: _Map) -> _Map:
    """Return the map `merged` unchanged; raise `InputError` (under `jit` an equinox error) if any point is `invalid`.

    The error names the first such point.
    """
    message = (
        "bcm: an expert's mean is no number, a variance is not positive, or the experts' variances exceed the prior's"
        " so far that no positive precision is left; check that prior_variance is the one all experts were fitted with"
    )
    if isinstance(invalid, jax.core.Tracer):
        return eqx.error_if(merged, invalid, message)
    if np.any(invalid):
        raise InputError(f"{message} (first at point {int(np.argmax(invalid))}).")
    return merged
