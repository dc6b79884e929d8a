"""The committee machine against the paper's formulas in extended precision, and its limits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference_laplace import bcm_mp

from hilbo import bcm
from hilbo.errors import InputError


def experts(count, points, prior=1.3, weakest=1e-12, seed=0):
    """Means and variances of experts that explain between `weakest` and almost all of the prior variance."""
    rng = np.random.default_rng(seed)
    explained = prior * 10 ** rng.uniform(np.log10(weakest), -0.01, (count, points))
    return rng.normal(size=(count, points)), prior - explained


@pytest.mark.parametrize("count", [1, 2, 24, 300])
def test_equals_the_papers_formulas(count):
    means, variances = experts(count, 5)
    mean, variance = bcm.combine(jnp.asarray(means), jnp.asarray(variances), 1.3)
    mean_mp, variance_mp = bcm_mp(means, variances, 1.3)
    np.testing.assert_allclose(mean, mean_mp.astype(float), rtol=1e-12)
    np.testing.assert_allclose(variance, variance_mp.astype(float), rtol=1e-12)


def test_a_hundred_thousand_weak_experts_keep_their_digits():
    rng = np.random.default_rng(1)
    explained = 10 ** rng.uniform(-9, -5, (100_000, 1))
    means = rng.normal(size=explained.shape) * 1e-3
    variances = 1.3 - explained
    mean, variance = bcm.combine(jnp.asarray(means), jnp.asarray(variances), 1.3)
    mean_mp, variance_mp = bcm_mp(means, variances, 1.3)
    np.testing.assert_allclose(mean, mean_mp.astype(float), rtol=1e-12)
    np.testing.assert_allclose(variance, variance_mp.astype(float), rtol=1e-12)


def test_explained_variances_below_the_rounding_of_the_prior_still_count():
    explained = np.full((1000, 1), 1e-20)
    _, variance = bcm.combine_explained(jnp.zeros((1000, 1)), jnp.asarray(explained), 1.0)
    evidence = bcm.stream(lambda e: (jnp.zeros(1), e), jnp.asarray(explained), jnp.ones(1))
    assert variance[0] == 1.0  # 1 / (1 + 1e-17)
    np.testing.assert_allclose(evidence.added, 1e-17, rtol=1e-13)


def test_one_expert_is_itself():
    means, variances = experts(1, 50)
    mean, variance = bcm.combine(jnp.asarray(means), jnp.asarray(variances), 1.3)
    np.testing.assert_allclose(mean, means[0], rtol=4e-15)
    np.testing.assert_allclose(variance, variances[0], rtol=4e-15)


def test_experts_without_data_change_nothing():
    means, variances = map(jnp.asarray, experts(6, 9))
    bare = bcm.combine(means, variances, 1.3)
    more = bcm.combine(
        jnp.concatenate([means, jnp.zeros((4, 9))]), jnp.concatenate([variances, jnp.full((4, 9), 1.3)]), 1.3
    )
    masked = bcm.combine(
        jnp.concatenate([means, jnp.full((1, 9), jnp.nan)]),
        jnp.concatenate([variances, jnp.full((1, 9), -1.0)]),
        1.3,
        mask=jnp.arange(7) < 6,
    )
    for other in (more, masked):
        np.testing.assert_array_equal(bare[0], other[0])
        np.testing.assert_array_equal(bare[1], other[1])


@given(st.integers(0, 10_000))
@settings(max_examples=20)
def test_order_does_not_matter(seed):
    means, variances = experts(24, 3, seed=seed)
    order = np.random.default_rng(seed).permutation(24)
    one = bcm.combine(jnp.asarray(means), jnp.asarray(variances), 1.3)
    other = bcm.combine(jnp.asarray(means[order]), jnp.asarray(variances[order]), 1.3)
    np.testing.assert_allclose(one[1], other[1], rtol=1e-13)
    np.testing.assert_allclose(one[0], other[0], rtol=1e-12, atol=1e-13)


@given(st.integers(0, 10_000))
@settings(max_examples=20)
def test_more_experts_mean_less_variance(seed):
    means, variances = map(jnp.asarray, experts(8, 4, seed=seed))
    fewer, more = bcm.combine(means[:7], variances[:7], 1.3)[1], bcm.combine(means, variances, 1.3)[1]
    assert jnp.all(more <= fewer)
    assert jnp.all(more > 0)


@pytest.mark.parametrize("count", [1, 65])
def test_streamed_equals_at_once(count):
    means, variances = map(jnp.asarray, experts(count, 7))
    whole = bcm.combine(means, variances, 1.3)
    prior = jnp.full(7, 1.3)
    evidence = jax.jit(lambda e: bcm.stream(lambda pair: (pair[0], prior - pair[1]), e, prior))((means, variances))
    np.testing.assert_allclose(evidence.merge(prior)[0], whole[0], rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(evidence.merge(prior)[1], whole[1], rtol=1e-13)


def test_float32_against_float64():
    means, variances = experts(24, 100, weakest=1e-4)
    exact = bcm.combine(jnp.asarray(means), jnp.asarray(variances), 1.3)
    short = bcm.combine(jnp.asarray(means, jnp.float32), jnp.asarray(variances, jnp.float32), 1.3)
    assert short[0].dtype == jnp.float32
    # A variance rounded to float32 has lost eps * k of what it explains: relative to sigma^2 that is what may differ.
    np.testing.assert_allclose(short[1], exact[1], rtol=2e-4)
    np.testing.assert_allclose(short[0], exact[0], atol=2e-3)


def test_average_counts_everybody_the_same():
    means, variances = map(jnp.asarray, experts(4, 6))
    mean, variance = bcm.average(means, variances, mask=jnp.array([True, True, True, False]))
    np.testing.assert_allclose(mean, means[:3].mean(axis=0), rtol=1e-14)
    np.testing.assert_allclose(variance, variances[:3].sum(axis=0) / 9, rtol=1e-14)


@pytest.mark.parametrize(
    ("variances", "prior", "words"),
    [
        ([[0.5], [-0.1]], 1.0, "not positive"),
        ([[0.5], [np.nan]], 1.0, "not positive"),
        ([[9.0], [9.0], [9.0]], 1.0, "no positive precision"),
        ([[0.5], [0.5]], [1.0, 2.0], "one prior for all"),
    ],
)
def test_bad_experts_are_an_error_with_a_sentence(variances, prior, words):
    variances = jnp.asarray(variances)
    with pytest.raises(ValueError, match=words):
        bcm.combine(jnp.zeros_like(variances), variances, jnp.asarray(prior))


def test_without_throw_only_the_bad_point_is_nan():
    mean, variance = bcm.combine(jnp.zeros((2, 2)), jnp.array([[0.5, 0.5], [0.5, -1.0]]), 1.0, throw=False)
    assert jnp.isnan(variance).tolist() == [False, True]
    assert jnp.isnan(mean).tolist() == [False, True]


def test_whole_numbers_are_numbers():
    whole, halves = np.array([[0, 1], [1, 0]]), np.full((2, 2), 0.5)
    for means in (whole, whole.tolist(), whole.astype(np.float32)):
        np.testing.assert_array_equal(bcm.combine(means, halves, 1.5), bcm.combine(whole * 1.0, halves, 1.5))
    np.testing.assert_array_equal(bcm.combine(whole, halves, 0.9), bcm.combine(whole * 1.0, halves, 0.9))


def test_rows_of_somebody_absent_have_no_influence():
    means, variances = jnp.array([[1.0, 2.0], [jnp.nan, jnp.inf]]), jnp.array([[0.5, 0.5], [jnp.nan, -1.0]])
    mask = [True, False]
    for rule in (lambda k, m, v, p: bcm.combine(m, v, k, mask=p), lambda k, m, v, p: bcm.average(m, v, mask=p)):
        alone = rule(1.0, means[:1], variances[:1], None)
        np.testing.assert_allclose(rule(1.0, means, variances, mask), alone, rtol=1e-15)
    slope = jax.grad(lambda k: bcm.combine(means, variances, k, mask=jnp.array(mask), throw=False)[0].sum())(1.0)
    assert np.isfinite(slope)


def test_nobody_has_no_average():
    halves = jnp.full((2, 2), 0.5)
    with pytest.raises(InputError, match="there are no participants; an average needs at least one"):
        bcm.average(halves, halves, mask=np.zeros(2, bool))
    assert np.isnan(jax.jit(lambda mask: bcm.average(halves, halves, mask=mask))(np.zeros(2, bool))).all()


@pytest.mark.parametrize("mask", [[True], [[True, False]], [1, 0]])
def test_a_mask_is_a_flag_for_each_participant(mask):
    halves = jnp.full((2, 2), 0.5)
    with pytest.raises(InputError, match="give True or False for each of 2 participants"):
        bcm.combine(halves, halves, 1.0, mask=mask)


def test_a_mean_that_is_no_number_is_refused():
    with pytest.raises(InputError, match=r"mean is no number.*first at point 1"):
        bcm.combine([[1.0, np.nan], [1.0, 1.0]], np.full((2, 2), 0.5), 1.0)
