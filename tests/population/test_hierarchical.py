"""The hierarchical model: against its own algebra by brute force, its limits, and people simulated from it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hilbo import RBF, OrdinalGP, OrdinalProbit, Trials, fit
from hilbo.errors import InputError
from hilbo.population.shared.hierarchical import fit_people, learn_share, of_people, shared_posterior

GP = OrdinalGP(RBF(4.0, 1.0), OrdinalProbit((-0.5, 0.5), 0.5))


def simulated(people, answers, share, seed=0):
    """Answers of people whose functions are drawn from the model; stacked trials."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(size=(people * answers, 2))
    person = np.repeat(np.arange(people), answers)
    prior = np.exp(-4.0 * ((x[:, None] - x[None]) ** 2).sum(-1)) * np.where(person[:, None] == person, 1.0, share)
    eigenvalues, vectors = np.linalg.eigh(prior)
    f = vectors @ (np.sqrt(np.maximum(eigenvalues, 0)) * rng.normal(size=len(x)))
    z = f + 0.5 * rng.normal(size=len(x))
    q = (z > -0.5).astype(int) + (z > 0.5)
    each = [Trials.from_arrays(x[person == j], q[person == j]) for j in range(people)]
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *each)


def test_share_one_is_the_pooled_model():
    trials = simulated(3, 8, 0.5)
    mask = np.asarray(trials.mask)
    pooled = fit(GP, Trials.from_arrays(np.asarray(trials.x)[mask], np.asarray(trials.q)[mask]))
    together = fit_people(GP, of_people(trials), 1.0)
    x = jnp.asarray(np.random.default_rng(1).uniform(size=(20, 2)))
    np.testing.assert_allclose(together.log_evidence, pooled.log_evidence, rtol=1e-12)
    for a, b in zip(shared_posterior(together).predict(x), pooled.predict(x), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-11)


def test_share_zero_is_everybody_alone():
    trials = simulated(3, 8, 0.5)
    alone = [fit(GP, jax.tree.map(lambda leaf, j=j: jnp.asarray(np.asarray(leaf)[j]), trials)) for j in range(3)]
    together = fit_people(GP, of_people(trials), 0.0)
    x = jnp.asarray(np.random.default_rng(1).uniform(size=(20, 2)))
    total = sum(float(posterior.log_evidence) for posterior in alone)
    np.testing.assert_allclose(together.log_evidence, total, rtol=1e-12)
    for j, posterior in enumerate(alone):
        as_one = together.predict(jnp.asarray(np.insert(x, 2, j, axis=1)))
        for a, b in zip(as_one, posterior.predict(x), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-11)


def test_a_newcomer_differs_from_the_population_by_their_own_function():
    trials = of_people(simulated(4, 6, 0.5))
    posterior = fit_people(GP, trials, 0.3)
    x = jnp.asarray(np.random.default_rng(2).uniform(size=(9, 2)))
    mean, variance = shared_posterior(posterior).predict(x)
    new_mean, new_variance = posterior.predict(jnp.concatenate([x, jnp.full((9, 1), -1.0)], axis=1))
    np.testing.assert_allclose(new_mean, mean, rtol=1e-14)
    np.testing.assert_allclose(new_variance, variance + 0.7, rtol=1e-13)


def test_the_shared_function_by_brute_force():
    """g at new points given the sites of the fit as normal observations, with the covariances written out."""
    trials = of_people(simulated(3, 5, 0.5))
    posterior = fit_people(GP, trials, 0.4)
    mask = np.asarray(trials.mask)
    x, person = np.asarray(trials.x)[mask][:, :2], np.asarray(trials.x)[mask][:, 2]
    new = np.random.default_rng(3).uniform(size=(7, 2))

    def k(a, b):
        return np.exp(-4.0 * ((a[:, None] - b[None]) ** 2).sum(-1))

    prior = k(x, x) * np.where(person[:, None] == person, 1.0, 0.4)
    mode, q = np.asarray(posterior.latent.mode)[mask], np.asarray(trials.q)[mask]
    _, slope, weight = map(np.asarray, jax.jit(jax.vmap(GP.likelihood.expand))(mode, q))
    target = mode + slope / weight
    solve = np.linalg.solve(prior + np.diag(1 / weight), np.c_[target, 0.4 * k(x, new)])
    mean, variance = shared_posterior(posterior).predict(new)
    np.testing.assert_allclose(mean, 0.4 * k(new, x) @ solve[:, 0], rtol=1e-9)
    np.testing.assert_allclose(variance, 0.4 - np.sum(0.4 * k(new, x) * solve[:, 1:].T, axis=1), rtol=1e-9)


@pytest.mark.parametrize("share", [0.2, pytest.param(0.9, marks=pytest.mark.deep)])
def test_the_learnt_share_holds_the_true_one(share):
    learnt = learn_share(GP, simulated(12, 25, share, seed=3))
    low, high = learnt.interval
    assert bool(learnt.converged)
    assert 0 <= low < share < high <= 1
    if share < 0.5:  # a tenth of the variance is too little to be seen in 300 answers
        assert float(learnt.against_one) > 10
    assert float(learnt.interpolation_error) < 0.02


def test_people_who_do_not_differ():
    learnt = learn_share(GP, simulated(12, 25, 1.0, seed=4))
    assert float(learnt.interval[1]) > 0.99 and float(learnt.against_one) < 0


def test_one_person_says_nothing_of_the_share():
    learnt = learn_share(GP, simulated(1, 10, 0.5))
    np.testing.assert_allclose(learnt.log_evidence, learnt.log_evidence[0], rtol=1e-12)
    np.testing.assert_allclose(learnt.interval, [0.025, 0.975], atol=1e-3)


@pytest.mark.deep
def test_the_curve_is_the_evidence_between_its_nodes():
    trials = simulated(6, 10, 0.6)
    learnt = learn_share(GP, trials)
    for share in (0.013, 0.31, 0.77, 0.999):
        at = np.interp(share, learnt.shares, learnt.log_evidence)
        np.testing.assert_allclose(at, fit_people(GP, of_people(trials), share).log_evidence, atol=1e-4)


def test_nobody_answered():
    with pytest.raises(InputError, match="there are no responses"):
        of_people(jax.tree.map(lambda leaf: np.asarray(leaf)[None], Trials.empty(8, 2)))
