"""The hierarchical model by features: against the dense model, its limits, and differences of its own evidence."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hilbo import RBF, OrdinalGP, OrdinalProbit, Trials, fit
from hilbo.population.hierarchical import fit_people, of_people, shared_posterior
from hilbo.population.low_rank import PeopleModel, rank_for, shared_evidence, shared_function

EXACT = 1e-15  # what features may leave where nothing is to be left
PEOPLE, ANSWERS = 3, 8


def stacked(seed=0, people=PEOPLE, answers=ANSWERS):
    rng = np.random.default_rng(seed)
    each = [
        Trials.from_arrays(rng.uniform(size=(answers - j, 2)), rng.integers(0, 3, answers - j), answers)
        for j in range(people)
    ]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)


def model(shared=0.6, own=0.4, log_widths=(0.0,) * PEOPLE):
    widths = jnp.asarray(log_widths, float)
    return PeopleModel(
        jnp.array([3.0, 5.0]), jnp.asarray(shared), jnp.asarray(own), jnp.array([-0.4, 0.5]), jnp.asarray(0.7), widths
    )


@eqx.filter_jit
def _evidence(people, trials, tolerance):
    return shared_evidence(people, trials, jnp.zeros(trials.q.shape), 24, tolerance)


def evidence(people, trials, tolerance=EXACT):
    """One compilation for all tests."""
    return _evidence(people, trials, jnp.asarray(tolerance))


def test_is_the_dense_model():
    trials, people = stacked(), model()
    dense = fit_people(people.gp, of_people(trials), people.share)
    posterior = shared_function(people, trials, jnp.zeros(trials.q.shape), 24, EXACT)
    x = jnp.asarray(np.random.default_rng(1).uniform(size=(20, 2)))
    np.testing.assert_allclose(evidence(people, trials).value, dense.log_evidence, rtol=1e-10)
    np.testing.assert_allclose(posterior.log_evidence, dense.log_evidence, rtol=1e-10)
    for by_features, by_all in zip(posterior.predict(x), shared_posterior(dense).predict(x), strict=True):
        np.testing.assert_allclose(by_features, by_all, atol=1e-7)  # the square root of what features leave
    assert bool(posterior.certificate.converged)


def test_one_person_is_an_ordinal_gp_whatever_the_features():
    trials = eqx.tree_at(lambda t: t.mask, stacked(), stacked().mask & jnp.array([[True], [False], [False]]))
    people = model()
    alone = fit(people.gp, jax.tree.map(lambda leaf: leaf[0], trials))
    np.testing.assert_allclose(evidence(people, trials, 1.0).value, alone.log_evidence, rtol=1e-12)


def test_without_own_parts_all_are_one_person():
    trials = stacked()
    mask = np.asarray(trials.mask)
    people = model(shared=1.0, own=0.0)
    pooled = fit(people.gp, Trials.from_arrays(np.asarray(trials.x)[mask], np.asarray(trials.q)[mask], 32))
    np.testing.assert_allclose(evidence(people, trials).value, pooled.log_evidence, rtol=1e-10)


def test_widths_are_thresholds_of_their_own():
    """Nothing shared: everybody's evidence is that of a fit with their own thresholds."""
    trials, people = stacked(), model(shared=0.0, own=0.9, log_widths=(0.4, -0.3, 0.0))
    total = 0.0
    for j, log_width in enumerate((0.4, -0.3, 0.0)):
        thresholds = 0.05 + np.exp(log_width) * np.array([-0.45, 0.45])
        gp = OrdinalGP(RBF((3.0, 5.0), 0.9), OrdinalProbit(thresholds, 0.7))
        total += fit(gp, jax.tree.map(lambda leaf, j=j: leaf[j], trials)).log_evidence
    np.testing.assert_allclose(evidence(people, trials).value, total, rtol=1e-12)


def test_gradients_are_differences_of_the_dense_evidence():
    """In theta, both variances and the thresholds; the widths by differences of the evidence itself."""
    trials, people, step = stacked(), model(log_widths=(0.2, -0.1, 0.3)), 1e-4
    gradient = eqx.filter_grad(lambda m: _evidence(m, trials, jnp.asarray(EXACT)).value)(people)
    flat, restore = jax.flatten_util.ravel_pytree(people)
    ways = jnp.eye(flat.size)
    points = jnp.stack([flat + k * step * way for way in ways for k in (-2, -1, 1, 2)])
    heights = jnp.stack([evidence(restore(z), trials).value for z in points])
    a, b, c, d = heights.reshape(-1, 4).T
    by_differences = (a - 8 * b + 8 * c - d) / (12 * step)
    np.testing.assert_allclose(jax.flatten_util.ravel_pytree(gradient)[0], by_differences, atol=1e-6)


@pytest.mark.deep  # shapes of its own, and the dense model of 114 answers
def test_what_features_leave_is_said_and_bounds_the_covariances():
    trials = stacked(people=4, answers=30)
    theta = jnp.array([3.0, 5.0])
    rank = rank_for(theta, trials)
    held = eqx.tree_at(lambda m: m.log_widths, model(), jnp.zeros(4))
    end = shared_evidence(held, trials, jnp.zeros(trials.q.shape), rank)
    dense = fit_people(held.gp, of_people(trials), held.share)
    assert float(end.left) <= 1e-6
    assert rank < int(trials.mask.sum())
    np.testing.assert_allclose(end.value, dense.log_evidence, atol=1e-4)


@pytest.mark.parametrize("noise", [0.7, 0.1, 0.02])
def test_the_mode_is_found_or_said_not_to_be(noise):
    """Contradictory answers at little noise; each certificate that holds is right."""
    trials = stacked()
    conflicting = eqx.tree_at(lambda t: t.x, trials, jnp.round(trials.x))
    people = eqx.tree_at(lambda m: m.noise, model(), jnp.asarray(noise))
    end = evidence(people, conflicting)
    assert bool(end.arrived) or noise < 0.1
    if bool(end.arrived):
        dense = fit_people(people.gp, of_people(conflicting), people.share)
        np.testing.assert_allclose(end.value, dense.log_evidence, rtol=1e-8)
