"""Predicted responses of a new participant from a population map, before any response and in sequence.

The new participant's own function is integrated out, and so is that participant's use of the scale where it differs
between participants (`shared.scale_use`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.special import log_ndtr, logsumexp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from hilbo.likelihoods import Goal, OrdinalProbit
from hilbo.population.shared.scale_use import ScaleUse

__all__ = ["InTurn", "class_probabilities", "in_turn", "log_goal", "predicted_in_turn", "with_variances"]

_AT_A_TIME = 21  # nodes: each takes n^2 numbers for n responses


def class_probabilities(
    likelihood: OrdinalProbit, mean: Float[Array, " m"], variance: Float[Array, " m"], scale: ScaleUse | None = None
) -> Float[Array, "m C"]:
    """Probabilities (m, C) of a new participant's responses, from mean and variance (m,) of that participant's
    function.

    **Arguments:** `scale`: how participants differ in the use of the scale, which is integrated out by its
    quadrature; None if they do not.
    """
    if scale is None:
        return jax.vmap(likelihood.class_probabilities)(mean, variance)

    def given(person: OrdinalProbit) -> Float[Array, "m C"]:
        return jax.vmap(person.class_probabilities)(mean, variance)

    people, weights = scale.people(likelihood)
    return jnp.tensordot(weights, jax.vmap(given)(people), 1)


def log_goal(
    likelihood: OrdinalProbit,
    goal: Goal,
    mean: Float[Array, " m"],
    variance: Float[Array, " m"],
    scale: ScaleUse | None = None,
) -> Float[Array, " m"]:
    """Log probability (m,) of the goal as a new participant's response, accurate also where it is small.

    `mean`, `variance` (m,): of that participant's function; `scale` as for `class_probabilities`.
    """

    def given(person: OrdinalProbit) -> Float[Array, " m"]:
        if goal.is_highest:
            return log_ndtr((mean - person.thresholds[-1]) / jnp.sqrt(person.noise**2 + variance))
        return jax.vmap(lambda m, v: person.smoothed(m, v, goal.category)[0])(mean, variance)

    if scale is None:
        return given(likelihood)
    people, weights = scale.people(likelihood)
    return logsumexp(jax.vmap(given)(people), axis=0, b=weights[:, None])


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
    scale: ScaleUse | None = None,
) -> InTurn:
    """Predict a new participant's n responses one after the other, each from those before it.

    The participant's function at the n points is normal with `mean` (n,) and `covariance` (n, n) before any response.
    Each response `q` (n,) that was given (`mask`, (n,)) updates both (assumed density filtering), in O(n^3) for all
    responses; one that was not given changes nothing. `scale` as for `class_probabilities`: its nodes are weighted by
    the probability of the responses so far.

    A session chooses stimuli by what its participant responded before. The participants tested at a stimulus are then
    not a random sample, and only a prediction that uses their earlier responses can be calibrated.

    References: Dawid (1984), J. R. Statist. Soc. A 147:278, for such predictions; Opper (1998), On-line Learning in
    Neural Networks, ch. 16, for the filter.
    """

    if scale is None:
        return in_turn(likelihood, mean, covariance, q, mask)
    people, weights = scale.people(likelihood)
    each = jax.lax.map(lambda person: in_turn(person, mean, covariance, q, mask), people, batch_size=_AT_A_TIME)
    logs = jnp.cumsum(jnp.where(mask, each.log_given, 0.0), axis=1)
    before = jnp.log(weights)[:, None] + jnp.pad(logs[:, :-1], ((0, 0), (1, 0)))
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
