"""Answers added up by points: what is counted, and fits of counts against those of every answer on its own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.people_evidence import evidence, learn_people
from hilbo import RBF, OrdinalGP, OrdinalProbit, Trials, fit
from hilbo.population.maps import rule_map, share_of
from hilbo.population.shared.hierarchical import fit_people, of_people, shared_posterior
from hilbo.population.shared.tallies import fit_counts, tallied

GP = OrdinalGP(RBF(jnp.array([4.0, 2.0]), 1.5), OrdinalProbit((-0.5, 0.5), 0.5))


def cohort(people=4, answers=12, points=5, seed=0):
    """Everybody is asked at the same few points, some of them more often than others."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(size=(points, 2))
    each = [
        Trials.from_arrays(x[rng.integers(0, points, answers)], rng.integers(0, 3, answers), answers + 1)
        for _ in range(people)
    ]
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *each)


def places():
    return jnp.asarray(np.random.default_rng(1).uniform(size=(9, 2)))


def test_every_answer_is_counted():
    trials = cohort()
    answers, mask = tallied(trials, 3), np.asarray(trials.mask)
    assert float(answers.counts.sum()) == mask.sum() and answers.x.shape == (4, 5, 2)
    for person, point, category in ((0, 2, 1), (3, 4, 0)):
        same = (np.asarray(trials.x[person]) == np.asarray(answers.x[person, point])).all(axis=1) & mask[person]
        answered = (np.asarray(trials.q[person])[same] == category).sum()
        assert float(answers.counts[person, point, category]) == answered


def test_a_fit_of_counts_is_that_of_every_answer():
    trials = cohort()
    one = jax.tree.map(lambda leaf: leaf[1], trials)
    answers = tallied(trials, 3)
    by_counts, by_answers = fit_counts(GP, answers.x[1], answers.counts[1]), fit(GP, one)
    assert bool(by_counts.certificate.converged)
    np.testing.assert_allclose(by_counts.log_evidence, by_answers.log_evidence, rtol=1e-12)
    for a, b in zip(by_counts.predict(places()), by_answers.predict(places()), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)


def test_maps_of_repeated_answers_are_those_of_every_answer():
    """The pooled one, the committee's, and the shared function, at points that people have in common."""
    trials = cohort()
    mask = np.asarray(trials.mask)
    everybody = fit(GP, Trials.from_arrays(np.asarray(trials.x)[mask], np.asarray(trials.q)[mask]))
    dense = shared_posterior(fit_people(GP, of_people(trials), 0.3))
    exact = rule_map(GP, trials, "hierarchical", share=jnp.asarray(0.3), largest=40)  # fewer than the answers
    assert exact.method == "exact" and bool(exact.shared.certificate.converged)
    np.testing.assert_allclose(exact.shared.log_evidence, dense.log_evidence, rtol=1e-12)
    for map_, same in ((rule_map(GP, trials, "pooled", largest=40), everybody), (exact, dense)):
        for a, b in zip(map_.predict(places()), same.predict(places()), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-12)
    by_counts = rule_map(GP, trials, "bcm")
    each = jax.vmap(lambda person: fit(GP, person, throw=False))(trials)
    assert by_counts.experts.trials.capacity == 5
    for a, b in zip(
        by_counts.predict(places()), rule_map(GP, trials, "bcm", posteriors=each).predict(places()), strict=True
    ):
        np.testing.assert_allclose(a, b, atol=1e-12)


def test_people_without_answers_change_nothing():
    trials = cohort()
    more = jax.tree.map(lambda leaf: jnp.concatenate([leaf[:2], jnp.zeros_like(leaf[:1]), leaf[2:]]), trials)
    shares = [share_of(GP, each) for each in (trials, more)]
    np.testing.assert_allclose(shares[0].log_evidence, shares[1].log_evidence, rtol=1e-12)
    alone, among = (rule_map(GP, each, "hierarchical", share=jnp.asarray(0.6)) for each in (trials, more))
    np.testing.assert_allclose(among.shared.log_evidence, alone.shared.log_evidence, rtol=1e-12)
    np.testing.assert_allclose(among.predict(places()), alone.predict(places()), atol=1e-12)


@pytest.mark.deep
def test_learning_reaches_a_maximum():
    answers = tallied(cohort(6, 30, 9, seed=2), 3)
    learnt = learn_people(GP, answers, 0.7, tolerance=1e-12, max_steps=200)
    assert bool(learnt.converged)
    slopes = jax.grad(lambda gp, p: evidence(gp, p, answers).value, argnums=(0, 1))(learnt.gp, learnt.share)
    assert learnt.log_evidence > evidence(GP, jnp.asarray(0.7), answers).value
    assert abs(float(slopes[1])) * float(learnt.share * (1 - learnt.share)) < 0.05
