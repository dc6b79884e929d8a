"""What a population map predicts of a new person, before any answer and from one answer to the next: that person's own
function is integrated out, and the width of their middle categories where people differ in it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import log_ndtr, logsumexp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from hilbo.likelihoods import OrdinalProbit
from hilbo.population.rules.recipes import WIDTHS

__all__ = ["InTurn", "class_probabilities", "in_turn", "log_highest", "predicted_in_turn"]

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


class InTurn(NamedTuple):
    """Predictions of n answers, each from those before it."""

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
    """A new person's answers one after the other, each predicted from those before it.

    A session chooses renderings by what its participant said before. The people who are asked at a rendering are then
    not a random choice, and only a prediction that knows their earlier answers can be right. The person's function at
    the n renderings is normal with `mean` and `covariance` before any answer. Each answer q that was given (`mask`)
    changes both to the moments of what follows from it (assumed density filtering), in O(n^3) for all answers.
    `widths` as above: they are weighted by how probable they made the answers so far.
    Reference: Dawid (1984), J. R. Statist. Soc. A 147:278, for such predictions; Opper (1998), On-line Learning in
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
    """The same with fixed thresholds, where the share `lapse` of the answers is any category at random. Both are then
    the moments of a mixture, of what the answer says and of what was known before; an unlikely answer changes little.

    The change of the covariance is a sum of outer products of rows, one for each answer, so that an answer costs a
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
    return WIDTHS.mean + WIDTHS.sd * jnp.asarray(_NODES, like.dtype)


def _widened(likelihood: OrdinalProbit, log_width: Float[Array, ""]) -> Float[Array, " edges"]:
    middle = jnp.mean(likelihood.thresholds)
    return middle + jnp.exp(log_width) * (likelihood.thresholds - middle)
