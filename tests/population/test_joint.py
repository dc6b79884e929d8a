"""The committee of full covariances: against the formula in 60 digits, and where it must be the pointwise one."""

from functools import cache

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from hilbo import RBF, OrdinalGP, OrdinalProbit, Trials, fit
from hilbo.kernels import gram
from hilbo.population.joint import joint_map, posterior_map, quick_optima
from hilbo.study.estimate.optimum import predict_people

GP = OrdinalGP(RBF(8.0, 1.7), OrdinalProbit((-0.5, 0.5), 0.5))


@cache
def everybody():
    """Seven people of six answers each, and one who said nothing: one fit for all tests."""
    rng = np.random.default_rng(0)
    each = [Trials.from_arrays(rng.uniform(size=(6, 2)), rng.integers(0, 3, 6), 8) for _ in range(7)]
    trials = jax.tree.map(lambda *leaves: np.stack(leaves), *each, Trials.empty(8, 2))
    return jax.vmap(lambda t: fit(GP, t, throw=False))(trials)


def cohort(people=slice(0, 4)):
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[people]), everybody())


@jax.jit
def joint_moments(posterior, x):
    cross = gram(posterior.gp.kernel, x, posterior.trials.x)
    known = posterior.latent.factor @ cross.T
    return cross @ posterior.latent.weights, gram(posterior.gp.kernel, x, x) - known.T @ known


def covariance_of(map_):
    return np.asarray(map_.root) @ np.asarray(map_.root).T


def test_equals_the_formula():
    posteriors = cohort()
    x = jnp.asarray(np.random.default_rng(1).uniform(size=(5, 2)))
    map_ = joint_map(posteriors, x)
    with mpmath.workdps(60):
        prior = mpmath.matrix(np.asarray(gram(GP.kernel, x, x)).tolist())
        precision, weighted = -3 * prior**-1, mpmath.zeros(5, 1)
        for j in range(4):
            mean, covariance = joint_moments(cohort(j), x)
            own = mpmath.matrix(np.asarray(covariance).tolist()) ** -1
            precision += own
            weighted += own * mpmath.matrix(np.asarray(mean).tolist())
        expected = precision**-1
        mean = np.array((expected * weighted).tolist(), float)[:, 0]
        expected = np.array(expected.tolist(), float)
    np.testing.assert_allclose(map_.mean, mean, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(covariance_of(map_), expected, rtol=1e-9, atol=1e-11)


def test_one_point_is_the_pointwise_committee():
    posteriors = cohort(slice(0, 7))
    for x in jnp.asarray(np.random.default_rng(2).uniform(size=(6, 1, 2))):
        map_, (mean, variance) = joint_map(posteriors, x), predict_people(posteriors, x)
        np.testing.assert_allclose(map_.mean, mean, rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(map_.variance, variance, rtol=1e-12)


def test_one_person_is_that_person():
    posteriors = cohort(slice(0, 1))
    x = jnp.asarray(np.random.default_rng(3).uniform(size=(200, 2)))
    mean, covariance = joint_moments(cohort(0), x)
    map_ = joint_map(posteriors, x)
    np.testing.assert_allclose(map_.mean, mean, atol=1e-9)
    np.testing.assert_allclose(covariance_of(map_), covariance, atol=1e-9)


def test_people_who_know_nothing_leave_the_prior():
    x = jnp.asarray(np.random.default_rng(4).uniform(size=(200, 2)))
    map_ = joint_map(cohort(slice(7, 8)), x)
    np.testing.assert_array_equal(map_.mean, 0.0)
    np.testing.assert_allclose(covariance_of(map_), gram(GP.kernel, x, x), atol=1e-12)


def test_the_many_draws_of_the_map_have_its_moments():
    posteriors = cohort()
    x = jnp.asarray(np.random.default_rng(5).uniform(size=(30, 2)))
    map_ = joint_map(posteriors, x)
    draws = np.asarray(map_.draw(jax.random.key(0), 40_000))
    sd = np.sqrt(np.asarray(map_.variance))
    assert np.abs((draws.mean(axis=0) - np.asarray(map_.mean)) / sd).max() < 4.5 / 200  # of 30 standard errors
    np.testing.assert_allclose(draws.std(axis=0), sd, rtol=4.5 / np.sqrt(2 * 40_000))
    shares = np.asarray(map_.optima(jax.random.key(1), 40_000))
    counted = np.bincount(draws.argmax(axis=1), minlength=30) / 40_000
    assert shares.sum() == pytest.approx(1.0)
    assert np.abs(shares - counted).max() < 4.5 * np.sqrt(0.5 / 40_000)


@pytest.mark.parametrize("copies", [False, True])
def test_quick_draws_are_as_often_largest(copies):
    """Of points that may occur twice, of which the first gets all draws; and of so many that K is singular."""
    posterior = cohort(0)
    x = jnp.asarray(np.random.default_rng(6).uniform(size=(30, 2)))
    x = jnp.concatenate([x, x[:5]]) if copies else x
    shares = np.asarray(posterior_map(posterior, x).optima(jax.random.key(1), 40_000))
    quick = np.asarray(quick_optima(posterior, x, jax.random.key(2), 40_000, lambda f: f))
    assert quick.sum() == pytest.approx(1.0) and quick[30:].sum() == 0.0
    first = shares[:30] + np.pad(shares[30:], (0, 30 - len(shares[30:])))
    assert np.abs(quick[:30] - first).max() < 4.5 * np.sqrt(0.5 / 40_000)
    near = 0.5 + 1e-9 * x  # whose covariance has no Cholesky factor
    assert np.isfinite(quick_optima(posterior, near, jax.random.key(3), 512, lambda f: f)).all()
