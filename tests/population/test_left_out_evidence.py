"""Evidence of participants who are left out of a committee, and the hyperparameters that maximise it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from hilbo.errors import InputError
from hilbo.hyperparameters.coordinates import coordinates_of, log_prior, model_at
from hilbo.kernels import RBF, gram
from hilbo.likelihoods import OrdinalProbit
from hilbo.ordinal_gp import OrdinalGP, Trials, fit
from hilbo.population.judged.leave_one_out import leave_one_out
from hilbo.population.judged.left_out_evidence import _cost, left_out_evidence, maximise_left_out
from hilbo.population.newcomer import predicted_in_turn, with_variances
from hilbo.population.pointwise import aggregate

MODEL = OrdinalGP(RBF(8.0, 1.3), OrdinalProbit(jnp.array([-0.4, 0.6]), 0.5))
LEARN = ("theta", "noise", "thresholds")


def crowd(people=4, answers=6, seed=0):
    """Stacked answers of people who like one place of a square best, and differ a little."""
    rng = np.random.default_rng(seed)
    rows = []
    for _ in range(people):
        x = rng.uniform(size=(answers, 2))
        felt = np.linalg.norm(x - [0.4, 0.6] - 0.1 * rng.standard_normal(2), axis=1) + 0.1 * rng.standard_normal(
            answers
        )
        rows.append(Trials.from_arrays(x, (felt < 0.5).astype(int) + (felt < 0.25), answers + 1))
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *rows)


@pytest.mark.parametrize("rule", ["bcm", pytest.param("average", marks=pytest.mark.deep)])
def test_it_is_what_cross_validation_predicts(rule):
    trials = crowd()
    left, _ = leave_one_out(MODEL, trials, rule)
    assert left_out_evidence(MODEL, trials, rule) == pytest.approx(-left.cost.sum(), rel=1e-10)
    third = left_out_evidence(MODEL, trials, rule, rows=[2])
    assert third == pytest.approx(-left.cost[left.person == 2].sum(), rel=1e-10)


@pytest.mark.deep
def test_a_hierarchical_committee_adds_what_people_differ_by():
    trials, share = crowd(), 0.7
    posteriors = jax.vmap(lambda person: fit(MODEL, person))(trials)
    total = 0.0
    for j in range(4):
        x = trials.x[j]
        means, explained = jax.vmap(lambda person, x=x: person.predict_explained(x))(posteriors)
        others = jnp.arange(4) != j
        mean, variance = aggregate("hierarchical", means, explained, 1.3, share=share, mask=others)
        covariance = with_variances(gram(MODEL.kernel, x, x), variance + 0.3 * 1.3)
        given = predicted_in_turn(MODEL.likelihood, mean, covariance, trials.q[j], trials.mask[j])
        total += float(given.log_given[trials.mask[j]].sum())
    assert left_out_evidence(MODEL, trials, "hierarchical", share) == pytest.approx(total, rel=1e-10)


def test_its_gradient_is_that_of_differences():
    trials = crowd()
    flat = np.asarray(ravel_pytree(coordinates_of(MODEL, LEARN))[0]) + 0.1

    def cost(flat):
        return _cost(jnp.asarray(flat), MODEL, trials, jnp.arange(4), None, LEARN, "bcm", "laplace")

    step = 1e-5
    slopes = [float(cost(flat + way).value - cost(flat - way).value) / (2 * step) for way in step * np.eye(len(flat))]
    np.testing.assert_allclose(cost(flat).gradient, slopes, atol=1e-6)


def test_its_maximum_is_one():
    trials = crowd()
    found = maximise_left_out(MODEL, trials, "bcm", ("theta", "noise"))
    assert found.converged and not found.runaway
    assert found.log_evidence > found.log_evidence_before
    assert found.log_evidence_before == pytest.approx(left_out_evidence(MODEL, trials, "bcm"), rel=1e-12)
    assert found.log_evidence == pytest.approx(left_out_evidence(found.gp, trials, "bcm"), rel=1e-10)
    np.testing.assert_array_equal(found.gp.likelihood.thresholds, MODEL.likelihood.thresholds)

    def posterior(coordinates):
        gp = model_at(coordinates, MODEL)
        return left_out_evidence(gp, trials, "bcm") + float(log_prior(gp, MODEL, ("theta", "noise")))

    there = coordinates_of(found.gp, ("theta", "noise"))
    around = [posterior(there | {name: there[name] + step}) for name in there for step in (-0.2, 0.2)]
    assert max(around) < posterior(there)


@pytest.mark.deep
def test_people_who_answered_nothing_change_nothing():
    trials = crowd()
    more = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf[:1]]), trials)
    more = eqx.tree_at(lambda t: t.mask, more, more.mask.at[4].set(False))
    assert left_out_evidence(MODEL, more, "bcm") == pytest.approx(left_out_evidence(MODEL, trials, "bcm"), rel=1e-12)
    with pytest.raises(InputError, match="1 people gave answers; at least two are needed"):
        maximise_left_out(MODEL, jax.tree.map(lambda leaf: leaf[3:], more), "bcm", LEARN)
