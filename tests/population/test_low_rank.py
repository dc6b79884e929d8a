"""The hierarchical model by features: against the dense model, its limits, and differences of its own evidence."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hilbo import RBF, OrdinalGP, OrdinalProbit, Trials, fit
from hilbo.population.counts import counts_of, fit_counts
from hilbo.population.hierarchical import fit_people, of_people, shared_posterior
from hilbo.population.low_rank import shared_evidence
from hilbo.population.people_model import PeopleModel
from hilbo.population.shared_features import rank_for
from hilbo.population.shared_posterior import shared_function
from hilbo.population.tallies import Tallies, tallied

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


def apart(trials):
    """Every answer as a point of its own, so that all tests have the same shapes."""
    counts = jax.nn.one_hot(trials.q, 3, dtype=trials.x.dtype)
    return Tallies(trials.x, jnp.where(trials.mask[..., None], counts, 0.0))


@eqx.filter_jit
def _evidence(people, trials, tolerance):
    answers = apart(trials)
    return shared_evidence(people, answers, answers.blank, 24, tolerance)


def evidence(people, trials, tolerance=EXACT):
    """One compilation for all tests."""
    return _evidence(people, trials, jnp.asarray(tolerance))


def test_is_the_dense_model():
    trials, people = stacked(), model()
    dense = fit_people(people.gp, of_people(trials), people.share)
    answers = apart(trials)
    posterior = shared_function(people, answers, answers.blank, 24, EXACT).function
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
    theta, answers = jnp.array([3.0, 5.0]), apart(trials)
    rank = rank_for(RBF(theta), answers)
    held = eqx.tree_at(lambda m: m.log_widths, model(), jnp.zeros(4))
    end = shared_evidence(held, answers, answers.blank, rank)
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


def test_repeated_answers_add_up_to_the_same_evidence():
    """Trials at five points, each asked in some order by everybody, against every answer as a point of its own."""
    rng = np.random.default_rng(3)
    places = rng.uniform(size=(5, 2))
    trials = stacked()
    repeated = eqx.tree_at(lambda t: t.x, trials, jnp.asarray(places[rng.integers(0, 5, (PEOPLE, ANSWERS))]))
    people = model(log_widths=(0.2, -0.1, 0.3))
    answers = tallied(repeated, 3)
    assert answers.x.shape[1] <= 5
    assert float(answers.counts.sum()) == float(repeated.mask.sum())
    together = shared_evidence(people, answers, answers.blank, 24, EXACT)
    np.testing.assert_allclose(together.value, evidence(people, repeated).value, rtol=1e-12)


def test_points_of_a_tally_stand_in_the_order_in_which_they_were_asked():
    x = np.array([[0.9, 0.1], [0.2, 0.3], [0.9, 0.1], [0.5, 0.5]])
    one = Trials.from_arrays(x, np.array([2, 0, 1, 1]), 6)
    answers = tallied(jax.tree.map(lambda leaf: leaf[None], one), 3)
    np.testing.assert_array_equal(answers.x[0], x[[0, 1, 3]])
    np.testing.assert_array_equal(answers.counts[0], [[0, 1, 1], [1, 0, 0], [0, 1, 0]])


def test_hundreds_of_contradictory_answers_are_no_obstacle():
    """Slopes of answers that contradict each other cancel, their rounding errors do not; against the exact counts."""
    rng = np.random.default_rng(4)
    x = np.repeat(rng.uniform(size=(5, 2)), 300, axis=0)
    each = [Trials.from_arrays(x, rng.integers(0, 3, len(x))) for _ in range(PEOPLE)]
    trials, people = jax.tree.map(lambda *leaves: jnp.stack(leaves), *each), model()
    answers = tallied(trials, 3)
    end = shared_evidence(people, answers, answers.blank, 24, EXACT)
    exact = fit_counts(people.gp, people.share, counts_of(trials, 3))
    assert bool(end.arrived)
    np.testing.assert_allclose(end.value, exact.log_evidence, rtol=1e-10)
