"""The family of aggregation rules: against 50-digit forms of the literature, and the limits in which they agree."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hilbo import bcm
from hilbo.errors import InputError
from hilbo.population.pointwise import aggregate
from hilbo.population.rules.registry import POINTWISE

PRIOR = 1.3


def people(count, points, seed=0, weakest=-9):
    rng = np.random.default_rng(seed)
    explained = PRIOR * 10 ** rng.uniform(weakest, -0.01, (count, points))
    return rng.normal(size=(count, points)), explained


def textbook(rule, means, explained, share):
    """As printed in the papers, with sums and differences of precisions, in 50 digits; one point."""
    with mpmath.workdps(50):
        k, M = mpmath.mpf(PRIOR), len(means)
        m, v = [mpmath.mpf(float(a)) for a in means], [k - mpmath.mpf(float(e)) for e in explained]
        if rule == "average":
            return sum(m) / M, sum(v) / M**2
        if rule == "hierarchical":
            p = mpmath.mpf(share)
            s = [1 / a - 1 / k for a in v]
            grown = [1 + a * (1 - p) * k for a in s]
            precision = 1 / (p * k) + sum(a / g for a, g in zip(s, grown, strict=True))
            return sum(b / a / g for b, a, g in zip(m, v, grown, strict=True)) / precision, 1 / precision
        precision = sum(1 / a for a in v) + mpmath.mpf(1 - M) / k
        return sum(c / a for c, a in zip(m, v, strict=True)) / precision, 1 / precision


@pytest.mark.parametrize("rule", POINTWISE)
@pytest.mark.parametrize("count", [1, 5, 60])
def test_every_rule_is_the_papers(rule, count):
    means, explained = people(count, 4, seed=count)
    share = 0.37 if rule == "hierarchical" else None
    mean, variance = aggregate(rule, jnp.asarray(means), jnp.asarray(explained), PRIOR, share=share)
    for i in range(4):
        expected = textbook(rule, means[:, i], explained[:, i], share)
        np.testing.assert_allclose([mean[i], variance[i]], [float(e) for e in expected], rtol=1e-12)


@given(st.integers(0, 1000), st.sampled_from([1, 2, 7, 40]))  # each count is a program of its own
@settings(max_examples=25, deadline=None)
def test_share_one_is_the_committee_machine(seed, count):
    means, explained = map(jnp.asarray, people(count, 3, seed))
    one = aggregate("hierarchical", means, explained, PRIOR, share=1.0)
    other = bcm.combine_explained(means, explained, PRIOR)
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-13)


def test_the_hierarchical_rule_is_exact_at_one_point():
    """Normal observations y_j = g + h_j + noise_j of people at one point: the joint posterior of g, by brute force."""
    rng = np.random.default_rng(4)
    share, noise = 0.6, rng.uniform(0.05, 3.0, 9)
    y = rng.normal(size=9)
    means, explained = PRIOR / (PRIOR + noise) * y, PRIOR**2 / (PRIOR + noise)
    mean, variance = aggregate(
        "hierarchical", jnp.asarray(means)[:, None], jnp.asarray(explained)[:, None], PRIOR, share=share
    )
    joint = PRIOR * (share + (1 - share) * np.eye(9)) + np.diag(noise)
    cross = np.full(9, share * PRIOR)
    np.testing.assert_allclose(mean[0], cross @ np.linalg.solve(joint, y), rtol=1e-13)
    np.testing.assert_allclose(variance[0], share * PRIOR - cross @ np.linalg.solve(joint, cross), rtol=1e-13)


@pytest.mark.parametrize("rule", ["bcm", "hierarchical"])
def test_people_without_answers_change_nothing(rule):
    means, explained = map(jnp.asarray, people(6, 5))
    share = 0.5 if rule == "hierarchical" else None
    more = aggregate(
        rule,
        jnp.concatenate([means, jnp.zeros((3, 5))]),
        jnp.concatenate([explained, jnp.zeros((3, 5))]),
        PRIOR,
        share=share,
    )
    for a, b in zip(aggregate(rule, means, explained, PRIOR, share=share), more, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-15)


@pytest.mark.parametrize("rule", POINTWISE)
def test_absent_people_may_hold_anything(rule):
    means, explained = map(jnp.asarray, people(6, 5))
    share = 0.5 if rule == "hierarchical" else None
    masked = aggregate(
        rule,
        means.at[2].set(jnp.nan) if rule != "average" else means.at[2].set(9.0),
        explained.at[2].set(7.0),
        PRIOR,
        share=share,
        mask=jnp.arange(6) != 2,
    )
    rest = np.array([0, 1, 3, 4, 5])
    for a, b in zip(masked, aggregate(rule, means[rest], explained[rest], PRIOR, share=share), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-14)


def test_nobody_knows_anything():
    nothing = jnp.zeros((5, 2))
    mean, variance = aggregate("bcm", nothing, nothing, PRIOR)
    np.testing.assert_array_equal(mean, 0.0)
    np.testing.assert_allclose(variance, PRIOR, rtol=1e-15)
    np.testing.assert_allclose(aggregate("hierarchical", nothing, nothing, PRIOR, share=0.3)[1], 0.3 * PRIOR)


def test_less_is_learnt_about_people_who_differ_more():
    means, explained = map(jnp.asarray, people(10, 6))
    shares = jnp.linspace(0.05, 1.0, 30)
    variances = jax.vmap(lambda p: aggregate("hierarchical", means, explained, PRIOR, share=p)[1] / p)(shares)
    assert np.all(np.diff(np.asarray(variances), axis=0) < 0)  # in units of g's prior variance


def test_wrong_rules_are_refused():
    means, explained = map(jnp.asarray, people(2, 1))
    with pytest.raises(InputError, match='the rule is "hierarchical"'):
        aggregate("hierarchical", means, explained, PRIOR)
    with pytest.raises(InputError, match="a share belongs"):
        aggregate("bcm", means, explained, PRIOR, share=0.5)
