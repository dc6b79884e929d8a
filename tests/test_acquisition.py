"""Scores against extended precision, and the maximisation against an exhaustive search."""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from helpers import check_grad

from hilbo import acquisition


@pytest.mark.parametrize("z", [-300.0, -38.0, -5.0, -1.0, -1e-8, 0.0, 1e-8, 0.7, 3.0, 40.0])
def test_log_expected_improvement(z):
    sd = 0.3
    value = acquisition.LogEI(1.0)(jnp.asarray(1.0 + sd * z), jnp.asarray(sd**2))
    with mp.workdps(40):
        # h falls like phi(z) / z^2: as many digits more as the cancellation takes.
        mp.mp.dps += 10
        u = (mp.mpf(1.0 + sd * z) - 1) / mp.sqrt(mp.mpf(sd**2))
        expected = mp.log(mp.sqrt(mp.mpf(sd**2))) + mp.log(mp.npdf(u) + u * mp.ncdf(u))
    np.testing.assert_allclose(float(value), float(expected), rtol=1e-12, atol=1e-14)


def test_what_is_certain_improves_by_the_mean_alone():
    score = acquisition.LogEI(1.0)
    gains = jnp.array([-0.5, 0.0, 0.25])
    values = jax.vmap(lambda gain: score(1.0 + gain, jnp.asarray(0.0)))(gains)
    np.testing.assert_allclose(values, [-np.inf, -np.inf, np.log(0.25)])
    np.testing.assert_allclose(values[2], score(jnp.asarray(1.25), jnp.asarray(1e-12)), rtol=1e-9)
    slopes = jax.vmap(jax.grad(lambda gain: score(1.0 + gain, jnp.asarray(0.0))))(gains)
    np.testing.assert_allclose(slopes, [0.0, 0.0, 4.0])


def test_scores_are_differentiable():
    scores = (acquisition.UCB(0.7), acquisition.LogEI(0.2), acquisition.TopCategory(0.5, 0.5))
    for score in scores:
        at = jax.jit(lambda mean, variance, score=score: score(mean, variance))
        for mean in (-3.0, 0.1, 2.0):
            check_grad(at, np.array(mean), np.array(0.4), atol=1e-9)


def hill(x):
    return -jnp.sum((x - jnp.array([0.31, 0.62])) ** 2)


def find(width=1.0, **settings):
    candidates = jnp.asarray(np.random.default_rng(0).random((64, 2)) * [width, 1.0])
    identity = lambda w: w  # noqa: E731
    arguments = {"from_box": identity, "to_box": identity, "feasible": lambda x: jnp.asarray(True)} | settings
    return acquisition.maximise(jax.vmap(hill)(candidates), candidates, hill, **arguments), candidates


def test_polishing_reaches_the_maximum():
    choice, _ = find()
    np.testing.assert_allclose(choice.x, [0.31, 0.62], atol=1e-5)
    assert choice.value >= choice.candidate_value


def test_polishing_reaches_the_wall():
    choice, _ = find(0.2, from_box=lambda w: w * jnp.array([0.2, 1.0]), to_box=lambda x: x / jnp.array([0.2, 1.0]))
    np.testing.assert_allclose(choice.x, [0.2, 0.62], atol=1e-5)


def test_without_polishing_it_is_the_best_candidate():
    choice, candidates = find(starts=0)
    np.testing.assert_array_equal(choice.x, candidates[jnp.argmax(jax.vmap(hill)(candidates))])


def test_what_is_not_feasible_is_not_chosen_by_polishing():
    choice, candidates = find(feasible=lambda x: jnp.asarray(False))
    assert jnp.any(jnp.all(choice.x[None, :] == candidates, axis=1))


def test_a_smallest_distance_is_kept():
    earlier = jnp.array([0.31, 0.62])
    choice, _ = find(allowed=lambda x: jnp.sum((x - earlier) ** 2) >= 0.2**2)
    assert jnp.sqrt(jnp.sum((choice.x - earlier) ** 2)) >= 0.2


def test_thompson_draws_from_the_posterior(getkey):
    covariance = jnp.array([[1.0, 1.0], [1.0, 1.0]])  # singular: the two points are one
    rows, draws = jax.vmap(lambda key: acquisition.thompson(key, jnp.array([0.0, 0.5]), covariance))(
        jax.random.split(getkey(), 4000)
    )
    assert jnp.all(rows == 1)
    np.testing.assert_allclose(jnp.mean(draws, axis=0), [0.0, 0.5], atol=0.06)
    np.testing.assert_allclose(jnp.cov(draws.T), covariance, atol=0.08)
