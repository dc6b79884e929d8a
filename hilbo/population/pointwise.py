"""Aggregation methods that combine participants' posteriors point by point, as one family of sums over participants.

At a point with prior variance k let participant j's posterior have mean m_j and variance k - e_j, e_j >= 0 being the
variance that the responses explain. Every method but the average is one precision-weighted sum over participants,

    1 / v = 1 / p k + sum_j e_j / (k (k - p e_j)),      mean = v sum_j m_j / (k - p e_j),

    method        p
    bcm           1
    hierarchical  share

in which a participant without responses has e_j = 0 and m_j = 0 and adds nothing. `hierarchical` is the model f_j = g +
h_j, cov(g) = p k, cov(h_j) = (1 - p) k, point by point: only a part of e_j's precision is about g, since the
participant's own h_j is noise to it. p = 1 is the Bayesian committee machine, which assumes that participants do not
differ. `average` is the plain mean of the latent functions, in which all participants have equal weight.

The sums are made of predictions (`aggregate`), or of posteriors, one participant at a time and on any number of devices
(`merged`). Reference: Tresp (2000). Products of experts, rbcm and grbcm were better on no population
(docs/methods/aggregation.md).
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from hilbo import bcm
from hilbo.errors import InputError
from hilbo.numerics.sharding import sum_over_people
from hilbo.numerics.tracing import traced_once
from hilbo.ordinal_gp import Posterior
from hilbo.population.rules.registry import POINTWISE, RULES

__all__ = ["aggregate", "merged", "merged_without"]


class _Sums(NamedTuple):
    """Sums over participants at m points, (m,) each: precision added to the prior, precision-weighted means, means, and
    explained variances.
    """

    added: Float[Array, " m"]
    """Precision that people add to the prior."""
    weighted: Float[Array, " m"]
    """Precision-weighted means."""
    means: Float[Array, " m"]
    explained: Float[Array, " m"]

    def merge(
        self, prior: Float[Array, " m"], people: ArrayLike, rule: str, share: ArrayLike
    ) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
        """Mean and variance (m,) of the population map by the method `rule`.

        `prior` (m,): prior variance; `people`: number of participants, used by "average" alone; `share`: p, the one
        with which the sums were made, used by the others.
        """
        if not RULES[rule].weighted:
            return self.means / people, (prior - self.explained / people) / people
        common = prior * share
        variance = common / (1.0 + common * self.added)
        return variance * self.weighted, variance


def _terms(
    means: Float[Array, "*s"], explained: Float[Array, "*s"], prior: Float[Array, "..."], share: ArrayLike
) -> _Sums:
    """What participants add to the sums, elementwise: `means` and `explained` of any shape, and the result's fields of
    the same.

    `prior`: k, broadcast; `share`: p, a scalar, 1 for every method but the hierarchical one.
    """
    remaining = prior - share * explained
    return _Sums(explained / (prior * remaining), means / remaining, means, explained)


def merged(
    rule: str, experts: Posterior, x: Float[Array, "m d"], prior_variance: ArrayLike, share: ArrayLike | None = None
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Mean and variance (m,) of the population map at points (m, d) of the unit cube, as `aggregate`, from posteriors.

    `experts`: posteriors of all participants, stacked; `prior_variance`: k, a scalar or (m,); `share`: of the
    hierarchical method, None for others. Nothing is checked. The predictions of the participants are made one after the
    other and are never all in memory, on each of the devices that participants are sharded over.
    """
    prior, common_share = _prior_and_share(x, prior_variance, share)
    sums = sum_over_people(_terms_of_person, experts, x, prior, common_share)
    return sums.merge(prior, jnp.asarray(experts.trials.mask.shape[0], x.dtype), rule, common_share)


def merged_without(
    rule: str,
    experts: Posterior,
    x: Float[Array, "m d"],
    left_out: Int[Array, " m"],
    prior_variance: ArrayLike,
    share: ArrayLike | None = None,
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Mean and variance (m,) at points (m, d), at each of all participants but the one in row `left_out` (m,).

    Other arguments as for `merged`; at least two participants. A derivative takes the memory of one
    participant's terms.
    """
    prior, common_share = _prior_and_share(x, prior_variance, share)
    people = experts.trials.mask.shape[0]
    numbered = experts, jnp.arange(people)
    sums = sum_over_people(jax.checkpoint(_terms_of_other), numbered, x, left_out, prior, common_share)
    return sums.merge(prior, jnp.asarray(people - 1, x.dtype), rule, common_share)


def _prior_and_share(
    x: Float[Array, "m d"], prior_variance: ArrayLike, share: ArrayLike | None
) -> tuple[Float[Array, " m"], Float[Array, ""]]:
    """Prior variance at each point, (m,), and the share p, 1 if it is None; in the dtype of the points."""
    prior = jnp.broadcast_to(jnp.asarray(prior_variance, x.dtype), x.shape[:1])
    return prior, jnp.ones((), x.dtype) if share is None else jnp.asarray(share, x.dtype)


def _terms_of_person(
    person: Posterior, x: Float[Array, "m d"], prior: Float[Array, " m"], share: Float[Array, ""]
) -> _Sums:
    """What one participant's posterior adds to the sums at points (m, d); `prior` (m,), `share` a scalar."""
    return _terms(*person.predict_explained(x), prior, share)


def _terms_of_other(
    person: tuple[Posterior, Int[Array, ""]],
    x: Float[Array, "m d"],
    left_out: Int[Array, " m"],
    prior: Float[Array, " m"],
    share: Float[Array, ""],
) -> _Sums:
    """`_terms_of_person` of a posterior with its row, 0 at the points where that row is `left_out` (m,)."""
    posterior, row = person
    terms = _terms_of_person(posterior, x, prior, share)
    return jax.tree.map(lambda term: jnp.where(left_out == row, 0.0, term), terms)


def aggregate(
    rule: str,
    means: Float[Array, "M m"],
    explained: Float[Array, "M m"],
    prior_variance: ArrayLike,
    *,
    share: ArrayLike | None = None,
    mask: Bool[Array, " M"] | None = None,
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Mean and variance (m,) of the population map, by one of the methods `POINTWISE`.

    **Arguments:**

    - `means`, `explained`: posterior means and explained variances e_j = k - sigma_j^2, (M, m).
    - `prior_variance`: k, a scalar or (m,), of all participants.
    - `share`: p of the hierarchical method, in (0, 1]: the part of the prior variance that participants have in common;
      None for others.
    - `mask`: (M,), False for absent participants, whose numbers may be anything, NaN too; None: all are present.

    Raises `InputError` for an unknown method, for a missing share of the hierarchical one, and for a share of another.
    """
    if rule not in POINTWISE:
        raise InputError(f'aggregate: the rule is "{rule}"; it must be one of {", ".join(POINTWISE)}.')
    if (share is None) == RULES[rule].learns_share:
        raise InputError(
            f'aggregate: a share belongs to the rule "hierarchical" and to no other; the rule is "{rule}".'
        )
    if share is not None:
        share = jnp.asarray(share, means.dtype)
    return _aggregated(rule, means, explained, jnp.asarray(prior_variance, means.dtype), share, mask)


@functools.partial(traced_once, static_argnames="rule")  # one program, not one for each operation
def _aggregated(
    rule: str,
    means: Float[Array, "M m"],
    explained: Float[Array, "M m"],
    prior_variance: Float[Array, "..."],
    share: Float[Array, ""] | None,
    mask: Bool[Array, " M"] | None,
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Compiled part of `aggregate`, with checked arguments: mean and variance (m,)."""
    prior = jnp.broadcast_to(prior_variance, means.shape[1:])
    if not RULES[rule].weighted:
        return bcm.average(means, prior[None, :] - explained, mask=mask)
    common_share = jnp.ones((), means.dtype) if share is None else share
    each = _terms(means, explained, prior[None, :], common_share)
    present = jnp.ones(means.shape[0], bool) if mask is None else mask
    sums = _Sums(*(jnp.sum(jnp.where(present[:, None], leaf, 0.0), axis=0) for leaf in each))
    return sums.merge(prior, jnp.sum(present, dtype=means.dtype), rule, common_share)
