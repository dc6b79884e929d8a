"""A new person's answers one after the other: each is predicted from those before it, whatever chose the renderings."""

import itertools
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from hilbo import RBF, OrdinalProbit
from hilbo.kernels import gram
from hilbo.population import newcomer
from hilbo.population.shared.scale_use import ScaleUse

LIKELIHOOD = OrdinalProbit(jnp.array([-0.5, 0.8]), jnp.asarray(0.7))
WIDTHS, SENSITIVITY = ScaleUse(jnp.asarray(0.4)), ScaleUse(None, jnp.asarray(0.5))
N, Q = 4, np.array([0, 2, 1, 2])
ALL = jnp.ones(N, bool)
class_probabilities, predicted_in_turn = map(eqx.filter_jit, (newcomer.class_probabilities, newcomer.predicted_in_turn))


@jax.jit
@partial(jax.vmap, in_axes=(None, None, 0, None))
def with_guesses(mean, covariance, q, lapse):
    return newcomer.in_turn(LIKELIHOOD, mean, covariance, q, ALL, lapse)


def boxes(person, mean, covariance):
    """Probability of the first i answers Q, and of each answer after them, (n, C): boxes of a multivariate normal."""
    ends = np.array([-np.inf, *np.asarray(person.thresholds), np.inf])

    def box(answers):
        k = len(answers)
        noisy = covariance[:k, :k] + float(person.noise) ** 2 * np.eye(k)
        return multivariate_normal(mean[:k], noisy, seed=0).cdf(ends[answers + 1], lower_limit=ends[answers])

    return np.array([[box(np.array([*Q[:i], c])) for c in range(3)] for i in range(N)])


@pytest.mark.parametrize("scale", [None, WIDTHS, SENSITIVITY])
def test_answers_are_predicted_from_those_before(scale):
    rng = np.random.default_rng(0)
    x, mean = jnp.asarray(rng.uniform(size=(N, 2))), rng.normal(size=N)
    covariance = np.asarray(gram(RBF(3.0, 4.0), x, x))
    predicted, log_given = map(
        np.asarray,
        predicted_in_turn(LIKELIHOOD, jnp.asarray(mean), jnp.asarray(covariance), jnp.asarray(Q), ALL, scale),
    )
    one = jax.tree.map(lambda leaf: leaf[None], LIKELIHOOD), jnp.ones(1)
    stacked, weights = one if scale is None else scale.people(LIKELIHOOD)
    people = [jax.tree.map(lambda leaf, k=k: leaf[k], stacked) for k in range(len(weights))]
    joint = sum(w * boxes(person, mean, covariance) for w, person in zip(weights, people, strict=True))
    np.testing.assert_allclose(predicted, joint / joint.sum(axis=1, keepdims=True), atol=0.02)
    alone = np.asarray(class_probabilities(LIKELIHOOD, jnp.asarray(mean), jnp.asarray(np.diagonal(covariance)), scale))
    np.testing.assert_allclose(predicted[0], alone[0], rtol=1e-12)
    assert np.abs(predicted[1:] - alone[1:]).max() > 0.1
    np.testing.assert_allclose(np.exp(log_given), predicted[np.arange(N), Q], rtol=1e-12)


def test_what_was_not_asked_says_nothing():
    rng = np.random.default_rng(1)
    root = rng.normal(size=(N, N))
    mean, covariance, q = jnp.asarray(rng.normal(size=N)), jnp.asarray(root @ root.T), jnp.asarray(Q)
    last = predicted_in_turn(LIKELIHOOD, mean, covariance, q, jnp.array([False, False, False, True]))[0]
    np.testing.assert_allclose(last, class_probabilities(LIKELIHOOD, mean, jnp.diagonal(covariance)), rtol=1e-10)


@pytest.mark.parametrize("scale", [None, WIDTHS])
def test_an_answer_that_was_all_but_excluded_is_a_number(scale):
    """Of probability exp(-1000) and less, with most widths or with all."""
    mean, covariance = jnp.array([0.0, 45.0, 0.0, 3.0]), 0.3 * jnp.eye(4)
    given = jnp.array([1, 0, 1, 2]), ALL
    predicted, log_given = map(np.asarray, predicted_in_turn(LIKELIHOOD, mean, covariance, *given, scale))
    np.testing.assert_allclose(predicted.sum(axis=1), 1.0, rtol=1e-6)
    assert np.isfinite(log_given).all() and -3000 < log_given[1] < -300 and (log_given[2:] > -3).all()


@pytest.mark.parametrize("lapse", [0.0, 0.3, 1.0])
def test_guesses_leave_the_moments_of_a_mixture(lapse):
    """The first answer by quadrature over the function where it was given; and all answers there are add up to 1."""
    rng = np.random.default_rng(3)
    root = rng.normal(size=(N, N))
    mean, covariance = rng.normal(size=N), root @ root.T
    every = np.array(list(itertools.product(range(3), repeat=N)))
    told = jax.tree.map(np.asarray, with_guesses(*map(jnp.asarray, (mean, covariance, every, lapse))))
    assert np.exp(told.log_given.sum(axis=1)).sum() == pytest.approx(1.0, rel=1e-12)
    sd = np.sqrt(covariance[0, 0])
    f = mean[0] + sd * np.linspace(-12, 12, 40_001)
    edges = np.array([-np.inf, -0.5, 0.8, np.inf])
    for q in range(3):
        chance = (1 - lapse) * (norm.cdf((edges[q + 1] - f) / 0.7) - norm.cdf((edges[q] - f) / 0.7)) + lapse / 3
        tilted = norm.pdf(f, mean[0], sd) * chance
        first = np.trapezoid(tilted, f)
        moved = np.trapezoid(tilted * (f - mean[0]), f) / first
        variance = np.trapezoid(tilted * (f - mean[0]) ** 2, f) / first - moved**2
        slope = covariance[1, 0] / covariance[0, 0]
        after = mean[1] + slope * moved, covariance[1, 1] + slope**2 * (variance - covariance[0, 0])
        second = (1 - lapse) * np.asarray(LIKELIHOOD.class_probabilities(*after)) + lapse / 3
        place = int(np.argmax(every[:, 0] == q))
        assert np.exp(told.log_given[place, 0]) == pytest.approx(first, rel=1e-9)
        np.testing.assert_allclose(told.probabilities[place, 1], second, rtol=1e-8)


def test_a_choice_by_earlier_answers_looks_like_no_misfit():
    """2,000 people of the model itself are asked at one place as long as they give the highest answer there."""
    rng = np.random.default_rng(2)
    people, n = 2000, 8
    f, place, q = 1.5 * rng.normal(size=(people, n)), np.zeros((people, n), int), np.zeros((people, n), int)
    for i in range(n):
        if i:
            place[:, i] = place[:, i - 1] + (q[:, i - 1] < 2)
        felt = f[np.arange(people), place[:, i]] + 0.7 * rng.normal(size=people)
        q[:, i] = np.searchsorted([-0.5, 0.8], felt)
    covariance = 1.5**2 * (place[:, :, None] == place[:, None, :])
    of_person = jax.vmap(lambda c, q: predicted_in_turn(LIKELIHOOD, jnp.zeros(n), c, q, jnp.ones(n, bool))[0])
    predicted = np.asarray(jax.jit(of_person)(jnp.asarray(covariance), jnp.asarray(q)))[..., 2].mean()
    alone = float(LIKELIHOOD.class_probabilities(0.0, 1.5**2)[2])
    assert (q == 2).mean() - alone > 0.1
    assert (q == 2).mean() == pytest.approx(predicted, abs=0.01)
