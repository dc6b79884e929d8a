"""Participants whose responses fit the other participants' map better when the scale is reversed.

A participant who took the lowest response for the highest answers q where C - 1 - q is meant. For each participant the
log probability of both readings is computed under the map of the others, in turn (`newcomer.in_turn`), with individual
differences and lapses. The difference is the log Bayes factor of a reversed scale.

A reversed participant also pulls the others' map. So the participant with the largest factor above the limit is left
out of the map, and all factors are computed again, until none is above it.
"""

from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hilbo.kernels import gram
from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import OrdinalGP, Trials, fit
from hilbo.population.newcomer import in_turn, with_variances
from hilbo.population.pointwise import merged_without

__all__ = ["log_factors", "reversed_people"]

_LIMIT, _LIMIT_PEOPLE = 2.0, 24  # nats: of 24 participants; chosen by benchmarks/reversed_people.py
_LAPSE = 0.05  # probability of an arbitrary response


def reversed_people(gp: OrdinalGP, trials: Trials, share: Float[Array, ""]) -> dict[int, float]:
    """Rows of participants whose scale looks reversed -> log Bayes factor (nats), the largest first.

    `trials`: stacked (M, n); `share`: of the prior variance that participants have in common. The limit is 2 nats
    for 24 participants, and grows by log(M / 24), as many more participants may exceed it by chance. Empty for fewer
    than three participants with responses.
    """
    answered = np.any(np.asarray(trials.mask), axis=1, keepdims=False)
    limit = _LIMIT + np.log(answered.sum() / _LIMIT_PEOPLE)
    named = _above(gp, trials, share, answered, limit) if answered.sum() > 2 else ()
    return dict(sorted(named, key=lambda each: -each[1]))


def _above(
    gp: OrdinalGP, trials: Trials, share: Float[Array, ""], answered: Bool[np.ndarray, " M"], limit: float
) -> Iterator[tuple[int, float]]:
    """Yield row and factor of the participant with the largest factor above the limit, each left out of the map for the
    next; at most half of the participants."""
    known = answered.copy()
    while 2 * (answered.sum() - known.sum() + 1) <= answered.sum():
        factors = log_factors(gp, trials, share, known)
        factors = np.where(known & np.isfinite(factors), factors, -np.inf)  # a fit that failed says nothing
        row = int(np.argmax(factors))
        if not factors[row] > limit:
            return
        yield row, float(factors[row])
        known[row] = False


def log_factors(
    gp: OrdinalGP, trials: Trials, share: Float[Array, ""], known: Bool[np.ndarray, " M"]
) -> Float[np.ndarray, " M"]:
    """Log Bayes factor of a reversed scale against the scale as given, of each participant, in nats. `known` (M,):
    participants on whose responses the map is based; each is left out of it for their own factor."""
    return np.asarray(_log_factors(gp, trials, share, jnp.asarray(known)))


@program
def _log_factors(
    gp: OrdinalGP, trials: Trials, share: Float[Array, ""], known: Bool[Array, " M"]
) -> Float[Array, " M"]:
    """`log_factors`, compiled."""
    others = eqx.tree_at(lambda t: t.mask, trials, trials.mask & known[:, None])
    posteriors = jax.vmap(lambda person: fit(gp, person, throw=False))(others)
    people, answers = trials.q.shape
    prior, rows = gp.kernel.variance, jnp.repeat(jnp.arange(people), answers)
    points = trials.x.reshape(-1, trials.x.shape[2])
    mean, variance = merged_without("hierarchical", posteriors, points, rows, prior, share)
    apart = (1.0 - share) * prior
    highest = gp.likelihood.categories - 1

    def factor(person):
        x, q, mask, mean, variance = person
        covariance = with_variances(gram(gp.kernel, x, x), variance + apart)
        given, turned = (
            in_turn(gp.likelihood, mean, covariance, each, mask, _LAPSE).log_given for each in (q, highest - q)
        )
        return jnp.sum(jnp.where(mask, turned - given, 0.0))

    shape = trials.q.shape
    return jax.lax.map(factor, (trials.x, trials.q, trials.mask, mean.reshape(shape), variance.reshape(shape)))
