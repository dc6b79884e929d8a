"""The rules by which participants' posteriors become one population map, as one family.

At a point with prior variance k let person j's posterior have mean m_j and variance k - e_j, e_j >= 0 being what the
answers explain. Every rule here is one precision-weighted sum over people,

    1 / v = c / k' + sum_j b_j w_j,      mean = v sum_j b_j r_j,

    rule          w_j                  r_j               b_j                       c / k'
    bcm           e_j / k (k - e_j)    m_j / (k - e_j)   1                         1 / k
    hierarchical  e_j / k (k - p e_j)  m_j / (k - p e_j) 1                         1 / p k
    poe           as bcm               as bcm            1                         M / k
    gpoe          as bcm               as bcm            1 / M                     1 / k
    rbcm          as bcm               as bcm            log(k / (k - e_j)) / 2    1 / k

in which a person without answers has e_j = 0 and m_j = 0 and adds nothing. `hierarchical` is the model f_j = g + h_j,
cov(g) = p k, cov(h_j) = (1 - p) k, point by point: of e_j's precision only w_j is about g, since the person's own h_j
is noise to it. p = 1 is the Bayesian committee machine, which says that people do not differ; without a term c / k' of
one prior (poe) the map of people who know nothing is not the prior. `average` is the plain mean of the latents, in
which everybody counts the same.

`grbcm` differs: its experts share a set of answers, the communication set, whose own posterior takes the prior's place.
References: Hinton (2002) poe; Cao & Fleet (2014) gpoe, with the weights 1 / M of Deisenroth & Ng (2015), who give rbcm;
Tresp (2000) bcm; Liu, Cai, Ong & Wang (2018) grbcm.
"""

from typing import Literal, get_args

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from hilbo import bcm
from hilbo.errors import InputError

__all__ = ["RULES", "Rule", "aggregate", "grbcm", "heterogeneous_evidence"]

Rule = Literal["bcm", "hierarchical", "rbcm", "gpoe", "poe", "average"]
RULES: tuple[Rule, ...] = get_args(Rule)


def aggregate(
    rule: Rule,
    means: Float[Array, "M m"],
    explained: Float[Array, "M m"],
    prior_variance: ArrayLike,
    *,
    share: ArrayLike | None = None,
    mask: Bool[Array, " M"] | None = None,
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Mean and variance (m,) of the population map, by one of `RULES`.

    **Arguments:**

    - `means`, `explained`: posterior means and explained variances e_j = k - sigma_j^2, (M, m).
    - `prior_variance`: k, a scalar or (m,), of all participants.
    - `share`: p of the hierarchical rule, in (0, 1]: the part of the prior variance that people have in common.
    - `mask`: (M,), False for absent participants.

    With `poe` the map is over-confident wherever nobody answered: k / M in place of k. It is here for comparison.
    """
    if rule not in RULES:
        raise InputError(f'aggregate: the rule is "{rule}"; it must be one of {", ".join(RULES)}.')
    if (share is None) == (rule == "hierarchical"):
        raise InputError(
            f'aggregate: a share belongs to the rule "hierarchical" and to no other; the rule is "{rule}".'
        )
    prior = jnp.broadcast_to(jnp.asarray(prior_variance, means.dtype), means.shape[1:])
    if rule == "average":
        return bcm.average(means, prior[None, :] - explained, mask=mask)
    present = jnp.ones(means.shape[0], bool) if mask is None else mask
    if rule == "hierarchical":
        part = jnp.asarray(share, means.dtype)
        return heterogeneous_evidence(means, explained, prior, part, present).merge(part * prior)
    count = jnp.sum(present, dtype=means.dtype)
    weight = _weights(rule, explained, prior, count) * present[:, None].astype(means.dtype)
    evidence = _sums(means, explained, prior, jnp.ones((), means.dtype), present, weight)
    return evidence.merge(prior / count if rule == "poe" else prior)


def heterogeneous_evidence(
    means: Float[Array, "M m"],
    explained: Float[Array, "M m"],
    prior: Float[Array, " m"],
    share: Float[Array, ""],
    present: Bool[Array, " M"],
) -> bcm.Evidence:
    """What M people say of the function g that they share, of variance `share` times the prior's, (m,)."""
    return _sums(means, explained, prior, share, present, jnp.ones_like(means))


def grbcm(
    shared: tuple[Float[Array, " m"], Float[Array, " m"]],
    means: Float[Array, "M m"],
    variances: Float[Array, "M m"],
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Generalised robust committee: mean and variance (m,).

    **Arguments:** `shared`: mean and variance (m,) from the communication set alone; `means`, `variances`: of experts
    who each know that set and their own answers, (M, m). The first expert has weight 1, so that for M = 1 the result
    is that expert's; the others' is half the log of the variance that their own answers take away.
    """
    base_mean, base_variance = shared
    weight = 0.5 * (jnp.log(base_variance)[None, :] - jnp.log(variances))
    weight = weight.at[0].set(1.0)
    left = 1.0 - jnp.sum(weight, axis=0)
    precision = jnp.sum(weight / variances, axis=0) + left / base_variance
    return (jnp.sum(weight * means / variances, axis=0) + left * base_mean / base_variance) / precision, 1.0 / precision


def _weights(rule, explained, prior, count):
    if rule == "gpoe":
        return jnp.ones_like(explained) / count
    if rule == "rbcm":
        return -0.5 * jnp.log1p(-explained / prior[None, :])
    return jnp.ones_like(explained)


def _sums(means, explained, prior, share, present, weight) -> bcm.Evidence:
    """Sums over people; absent ones may hold anything, NaN too."""
    remaining = prior[None, :] - share * explained
    added = jnp.where(present[:, None], weight * explained / (prior[None, :] * remaining), 0.0)
    weighted = jnp.where(present[:, None], weight * means / remaining, 0.0)
    return bcm.Evidence(jnp.sum(added, axis=0), jnp.sum(weighted, axis=0))
