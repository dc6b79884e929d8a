"""The hierarchical model from counts: against the dense model of every answer on its own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from benchmarks.people_evidence import learn_people
from hilbo import RBF, OrdinalGP, OrdinalProbit, Trials
from hilbo.errors import InputError
from hilbo.population.shared.counts import Counts, counts_of, evidence, fit_counts, one_person
from hilbo.population.shared.hierarchical import fit_people, of_people, predict_shared, shared_posterior

GP = OrdinalGP(RBF(jnp.array([4.0, 2.0]), 1.5), OrdinalProbit((-0.5, 0.5), 0.5))


def cohort(people=4, answers=12, points=7, seed=0):
    """Everybody is asked at the same few points, some of them more often than others."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(size=(points, 2))
    each = [
        Trials.from_arrays(x[rng.integers(0, points, answers)], rng.integers(0, 3, answers), answers + 1)
        for _ in range(people)
    ]
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *each)


def test_counts_count_every_answer():
    trials = cohort()
    counts = counts_of(trials, 3)
    mask = np.asarray(trials.mask)
    assert float(counts.counts.sum()) == mask.sum() and counts.x.shape == (7, 2)
    for person, point, category in ((0, 2, 1), (3, 5, 0)):
        same = (np.asarray(trials.x[person]) == np.asarray(counts.x[point])).all(axis=1) & mask[person]
        answered = (np.asarray(trials.q[person])[same] == category).sum()
        assert float(counts.counts[person, point, category]) == answered


@pytest.mark.parametrize("share", [0.3, pytest.param(1.0, marks=pytest.mark.deep)])
def test_equals_the_model_of_every_answer(share):
    trials = cohort()
    dense = fit_people(GP, of_people(trials), share)
    posterior = fit_counts(GP, jnp.asarray(share), counts_of(trials, 3))
    x = jnp.asarray(np.random.default_rng(1).uniform(size=(9, 2)))
    assert bool(posterior.certificate.converged)
    np.testing.assert_allclose(posterior.log_evidence, dense.log_evidence, rtol=1e-12)
    for a, b, c in zip(posterior.predict(x), predict_shared(dense, x), shared_posterior(dense).predict(x), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-11)
        np.testing.assert_allclose(c, b, atol=1e-13)


# Of the dense evidence of `cohort()` at share 0.3, along theta, variance, thresholds, noise and the share.
SLOPES = (0.15599804573, 0.47745725392, -1.61897861412, 18.19843574806, -18.16866131958, 46.08096875238, 0.04971174244)


def slopes(log_evidence):
    return ravel_pytree(jax.jit(jax.grad(log_evidence, argnums=(0, 1)))(GP, jnp.asarray(0.3)))[0]


def test_the_evidence_has_the_derivatives_of_the_dense_one():
    counts = counts_of(cohort(), 3)
    np.testing.assert_allclose(slopes(lambda gp, share: evidence(gp, share, counts)[0]), SLOPES, rtol=1e-8)


@pytest.mark.deep  # what the default test compares with
def test_the_derivatives_of_the_dense_evidence_are_those_that_stand_here():
    together = of_people(cohort())
    dense = slopes(lambda gp, share: fit_people(gp, together, share, throw=False).log_evidence)
    np.testing.assert_allclose(dense, SLOPES, rtol=1e-9)


def test_points_and_people_without_answers_change_nothing():
    """So that one program fits the share of a few, everybody's map and the pooled one."""
    counts = counts_of(cohort(), 3)
    points, rows = np.concatenate([counts.x, [[0.5, 0.5], [0.1, 0.9]]]), np.zeros((9, 9, 3))
    rows[2:6, :7] = counts.counts
    x = jnp.asarray(np.random.default_rng(1).uniform(size=(9, 2)))
    more = Counts(jnp.asarray(points), jnp.asarray(rows))
    alone, among = (fit_counts(GP, jnp.asarray(0.6), c) for c in (counts, more))
    np.testing.assert_allclose(among.log_evidence, alone.log_evidence, rtol=1e-12)
    np.testing.assert_allclose(np.asarray(among.latent.weights)[:7], alone.latent.weights, atol=1e-11)
    np.testing.assert_allclose(among.predict(x), alone.predict(x), atol=1e-12)
    assert bool(among.certificate.converged)


@pytest.mark.deep
def test_people_who_do_not_differ_are_one_person():
    counts = counts_of(cohort(), 3)
    one, other = fit_counts(GP, jnp.ones(()), counts), fit_counts(GP, jnp.asarray(0.4), one_person(counts))
    np.testing.assert_allclose(fit_counts(GP, jnp.ones(()), one_person(counts)).log_evidence, one.log_evidence)
    np.testing.assert_allclose(other.log_evidence, one.log_evidence, rtol=1e-12)  # one person's share is no matter


@pytest.mark.deep
def test_learning_reaches_a_maximum():
    counts = counts_of(cohort(6, 30, 9, seed=2), 3)
    learnt = learn_people(GP, counts, 0.7, tolerance=1e-12, max_steps=200)
    assert bool(learnt.converged)
    slopes = jax.grad(lambda gp, p: evidence(gp, p, counts)[0], argnums=(0, 1))(learnt.gp, learnt.share)
    begin = evidence(GP, jnp.asarray(0.7), counts)[0]
    assert learnt.log_evidence > begin
    assert abs(float(slopes[1])) * float(learnt.share * (1 - learnt.share)) < 0.05


def test_nobody_answered():
    with pytest.raises(InputError, match="nobody gave an answer"):
        counts_of(jax.tree.map(lambda leaf: np.asarray(leaf)[None], Trials.empty(8, 2)), 3)
