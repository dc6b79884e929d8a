"""What a population map predicts of a person who gave no answers: that person's own function is integrated out, and the
width of their middle categories where people differ in it."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import log_ndtr, logsumexp
from jaxtyping import Array, Bool, Float, Int

from hilbo.likelihoods import OrdinalProbit
from hilbo.population.recipes import WIDTHS

__all__ = ["class_probabilities", "log_highest", "probabilities_in_turn"]

_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(7)
_WEIGHTS = _WEIGHTS / _WEIGHTS.sum()


def class_probabilities(
    likelihood: OrdinalProbit, mean: Float[Array, " m"], variance: Float[Array, " m"], widths: bool = False
) -> Float[Array, "m C"]:
    """Probabilities (m, C) of a new person's answers, from the mean and variance (m,) of that person's function.

    **Arguments:** `widths`: whether people's distances between thresholds differ, as the recipes' prior says; they are
    then integrated out by Gauss and Hermite, with 7 nodes.
    """
    if not widths:
        return jax.vmap(likelihood.class_probabilities)(mean, variance)

    def given(log_width: Float[Array, ""]) -> Float[Array, "m C"]:
        person = OrdinalProbit(_widened(likelihood, log_width), likelihood.noise)
        return jax.vmap(person.class_probabilities)(mean, variance)

    return jnp.tensordot(jnp.asarray(_WEIGHTS, mean.dtype), jax.vmap(given)(_log_widths(mean)), 1)


def log_highest(
    likelihood: OrdinalProbit, mean: Float[Array, " m"], variance: Float[Array, " m"], widths: bool = False
) -> Float[Array, " m"]:
    """The log probability (m,) of the highest category, as accurate where it is small; arguments as above."""
    spread = jnp.sqrt(likelihood.noise**2 + variance)
    if not widths:
        return log_ndtr((mean - likelihood.thresholds[-1]) / spread)
    highest = jax.vmap(lambda w: _widened(likelihood, w)[-1])(_log_widths(mean))
    each = log_ndtr((mean[:, None] - highest[None, :]) / spread[:, None])
    return logsumexp(each, axis=1, b=jnp.asarray(_WEIGHTS, mean.dtype)[None, :])


def probabilities_in_turn(
    likelihood: OrdinalProbit,
    mean: Float[Array, " n"],
    covariance: Float[Array, "n n"],
    q: Int[Array, " n"],
    mask: Bool[Array, " n"],
    widths: bool = False,
) -> Float[Array, "n C"]:
    """Probabilities (n, C) of a new person's answers one after the other, each from those before it too.

    Where a rendering is chosen by what its participant said before, as a session does, an answer is not a random one
    of the people who could have been asked there: only a prediction that knows the earlier answers can be right. The
    person's function at the n renderings is normal with `mean` and `covariance` before any answer; each answer q
    that was given (`mask`) changes both by the moments of its normal (assumed density filtering), O(n^3) in all.
    `widths` as above: each width is as probable as it made the answers so far.
    Reference: Dawid (1984), J. R. Statist. Soc. A 147:278, for predictions in turn; Opper (1998), On-line Learning in
    Neural Networks, ch. 16, for the filter.
    """

    def given(log_width: Float[Array, ""]) -> Float[Array, "n C"]:
        return _filtered(OrdinalProbit(_widened(likelihood, log_width), likelihood.noise), mean, covariance, q, mask)

    if not widths:
        return _filtered(likelihood, mean, covariance, q, mask)
    each = jax.vmap(given)(_log_widths(mean))
    logs = jnp.where(mask, jnp.log(jnp.take_along_axis(each, q[None, :, None], axis=2)[..., 0]), 0.0)
    before = jnp.cumsum(logs, axis=1) - logs + jnp.log(jnp.asarray(_WEIGHTS, mean.dtype))[:, None]
    return jnp.einsum("kn,knc->nc", jax.nn.softmax(before, axis=0), each)


def _filtered(
    likelihood: OrdinalProbit,
    mean: Float[Array, " n"],
    covariance: Float[Array, "n n"],
    q: Int[Array, " n"],
    mask: Bool[Array, " n"],
) -> Float[Array, "n C"]:
    """`probabilities_in_turn` by one person's thresholds. What the answers took from the covariance is the sum of the
    outer products of rows, one for each answer: a matrix times a vector is all that an answer costs."""

    def answer(state, i):
        mean, rows = state
        column = covariance[i] - rows[:, i] @ rows
        variance = column[i]
        chances = likelihood.class_probabilities(mean[i], variance)
        _, slope, precision = likelihood.smoothed(mean[i], variance, q[i])
        slope, shrinks = (jnp.where(mask[i], v, 0.0) for v in (slope, precision / (1.0 + variance * precision)))
        return (mean + slope * column, rows.at[i].set(jnp.sqrt(shrinks) * column)), chances

    return jax.lax.scan(answer, (mean, jnp.zeros_like(covariance)), jnp.arange(q.size))[1]


def _log_widths(like: Array) -> Float[Array, " nodes"]:
    return WIDTHS.mean + WIDTHS.sd * jnp.asarray(_NODES, like.dtype)


def _widened(likelihood: OrdinalProbit, log_width: Float[Array, ""]) -> Float[Array, " edges"]:
    middle = jnp.mean(likelihood.thresholds)
    return middle + jnp.exp(log_width) * (likelihood.thresholds - middle)
