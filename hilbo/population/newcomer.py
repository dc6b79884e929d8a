"""Predicted responses of a new participant from a population map, before any response and in sequence.

The new participant's own function is integrated out, and so is the width of the middle categories where it differs
between participants.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import log_ndtr, logsumexp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from hilbo.likelihoods import OrdinalProbit
from hilbo.population.rules.recipes import WIDTHS

__all__ = ["InTurn", "class_probabilities", "in_turn", "log_highest", "predicted_in_turn", "with_variances"]

_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(7)
_WEIGHTS = _WEIGHTS / _WEIGHTS.sum()


def class_probabilities(
    likelihood: OrdinalProbit, mean: Float[Array, " m"], variance: Float[Array, " m"], widths: bool = False
) -> Float[Array, "m C"]:
    """Probabilities (m, C) of a new participant's responses, from mean and variance (m,) of that participant's
    function.

    **Arguments:** `widths`: whether the distances between thresholds differ between participants, by the prior of the
    recipes (log-normal); they are then integrated out by Gauss-Hermite quadrature with 7 nodes.
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
    """Log probability (m,) of the highest category for a new participant, accurate also where it is small.

    `mean`, `variance` (m,): of that participant's function; `widths`: whether the distances between thresholds differ
    between participants, by the prior of the recipes; they are then integrated out by quadrature with 7 nodes.
    """
    spread = jnp.sqrt(likelihood.noise**2 + variance)
    if not widths:
        return log_ndtr((mean - likelihood.thresholds[-1]) / spread)
    highest = jax.vmap(lambda w: _widened(likelihood, w)[-1])(_log_widths(mean))
    each = log_ndtr((mean[:, None] - highest[None, :]) / spread[:, None])
    return logsumexp(each, axis=1, b=jnp.asarray(_WEIGHTS, mean.dtype)[None, :])


def with_variances(covariance: Float[Array, "m m"], variance: Float[Array, " m"]) -> Float[Array, "m m"]:
    """Covariance matrix (m, m) with the correlations of `covariance` (m, m) and the variances `variance` (m,)."""
    scale = jnp.sqrt(variance / jnp.diagonal(covariance))
    return covariance * jnp.outer(scale, scale)


class InTurn(NamedTuple):
    """Predictions of n responses, each from those before it.

    `probabilities` (n, C); `log_given` (n,): log probability of the response that was given, finite also where the
    probability underflows.
    """

    probabilities: Float[Array, "n C"]
    log_given: Float[Array, " n"]
    """Log probability of the answer that was given, finite where the probability is 0 in this precision."""


def predicted_in_turn(
    likelihood: OrdinalProbit,
    mean: Float[Array, " n"],
    covariance: Float[Array, "n n"],
    q: Int[Array, " n"],
    mask: Bool[Array, " n"],
    widths: bool = False,
) -> InTurn:
    """Predict a new participant's n responses one after the other, each from those before it.

    The participant's function at the n points is normal with `mean` (n,) and `covariance` (n, n) before any response.
    Each response `q` (n,) that was given (`mask`, (n,)) updates both (assumed density filtering), in O(n^3) for all
    responses; one that was not given changes nothing. `widths` as for `class_probabilities`: their nodes are weighted
    by the probability of the responses so far.

    A session chooses stimuli by what its participant responded before. The participants tested at a stimulus are then
    not a random sample, and only a prediction that uses their earlier responses can be calibrated.

    References: Dawid (1984), J. R. Statist. Soc. A 147:278, for such predictions; Opper (1998), On-line Learning in
    Neural Networks, ch. 16, for the filter.
    """

    def given(log_width: Float[Array, ""]) -> InTurn:
        return in_turn(OrdinalProbit(_widened(likelihood, log_width), likelihood.noise), mean, covariance, q, mask)

    if not widths:
        return in_turn(likelihood, mean, covariance, q, mask)
    each, weights = jax.vmap(given)(_log_widths(mean)), jnp.log(jnp.asarray(_WEIGHTS, mean.dtype))
    logs = jnp.cumsum(jnp.where(mask, each.log_given, 0.0), axis=1)
    before = weights[:, None] + jnp.pad(logs[:, :-1], ((0, 0), (1, 0)))
    share = jax.nn.log_softmax(before, axis=0)
    probabilities = jnp.einsum("kn,knc->nc", jnp.exp(share), each.probabilities)
    return InTurn(probabilities, logsumexp(share + each.log_given, axis=0))


def in_turn(
    likelihood: OrdinalProbit,
    mean: Float[Array, " n"],
    covariance: Float[Array, "n n"],
    q: Int[Array, " n"],
    mask: Bool[Array, " n"],
    lapse: ArrayLike = 0.0,
) -> InTurn:
    """Predict n responses one after the other as `predicted_in_turn`, with fixed thresholds, where the share `lapse` of
    the responses is any category at random.

    `mean` (n,), `covariance` (n, n): of the function before any response; `q` (n,): categories, of which those not in
    `mask` (n,) change nothing. Each update has the moments of a mixture of the updated and the unchanged distribution,
    so that an unlikely response changes little.

    The change of the covariance is a sum of outer products of rows, one for each response, so that a response costs a
    matrix times a vector.
    """
    lapse, categories = jnp.asarray(lapse, mean.dtype), likelihood.categories
    log_attentive, log_guess = jnp.log1p(-lapse), jnp.log(lapse / categories)

    def answer(state, i):
        mean, rows, curvatures = state
        column = covariance[i] - (curvatures * rows[:, i]) @ rows
        variance = column[i]
        chances = (1.0 - lapse) * likelihood.class_probabilities(mean[i], variance) + lapse / categories
        log_judged, slope, precision = likelihood.smoothed(mean[i], variance, q[i])
        log_given = jnp.logaddexp(log_attentive + log_judged, log_guess)
        attentive = jnp.exp(log_attentive + log_judged - log_given)  # probability that this answer is no guess
        curvature = attentive * (precision / (1.0 + variance * precision) - (1.0 - attentive) * slope**2)
        slope, curvature = (jnp.where(mask[i], v, 0.0) for v in (attentive * slope, curvature))
        after = mean + slope * column, rows.at[i].set(column), curvatures.at[i].set(curvature)
        return after, InTurn(chances, log_given)

    start = mean, jnp.zeros_like(covariance), jnp.zeros_like(mean)
    return jax.lax.scan(answer, start, jnp.arange(q.size))[1]


def _log_widths(like: Array) -> Float[Array, " nodes"]:
    """Nodes (7,) of Gauss-Hermite quadrature for the log width of the middle categories, in the dtype of `like`."""
    return WIDTHS.mean + WIDTHS.sd * jnp.asarray(_NODES, like.dtype)


def _widened(likelihood: OrdinalProbit, log_width: Float[Array, ""]) -> Float[Array, " edges"]:
    """Thresholds (C - 1,) with their distances from their mean multiplied by exp(log_width)."""
    middle = jnp.mean(likelihood.thresholds)
    return middle + jnp.exp(log_width) * (likelihood.thresholds - middle)
