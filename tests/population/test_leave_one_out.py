"""Predictions of people left out: calibration measures on answers of known probabilities, and who is left out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ndtr

from hilbo import RBF, OrdinalGP, OrdinalProbit, Trials
from hilbo.errors import InputError
from hilbo.population.judged.leave_one_out import (
    LeftOut,
    calibration,
    clustered,
    influence,
    integral_transform,
    leave_one_out,
    normal_scores,
    reliability,
)
from hilbo.population.maps import rule_map

GP = OrdinalGP(RBF(4.0, 1.0), OrdinalProbit((-0.5, 0.5), 0.5))


def calibrated(n=20_000, seed=0):
    rng = np.random.default_rng(seed)
    probabilities = rng.dirichlet([1.0, 2.0, 3.0], n)
    q = (rng.uniform(size=n)[:, None] > np.cumsum(probabilities, axis=1)).sum(axis=1)
    return LeftOut(np.repeat(np.arange(20), n // 20), q, probabilities)


def test_the_transform_of_a_calibrated_prediction_is_uniform():
    left_out = calibrated()
    u = integral_transform(left_out.probabilities, left_out.q, 1)
    assert np.abs(np.sort(u) - (np.arange(len(u)) + 0.5) / len(u)).max() < 1.63 / np.sqrt(len(u))  # Kolmogorov, 1 %
    content = calibration(left_out)
    assert content["central_95"] == pytest.approx(0.95, abs=4 * content["central_95_error"])
    assert content["z2"] == pytest.approx(1.0, abs=4 * content["z2_error"])
    assert max(abs(b["predicted"] - b["observed"]) for b in reliability(left_out)) < 0.03


def test_a_prediction_that_is_too_sure_is_seen():
    left_out = calibrated()
    sharp = left_out.probabilities**3
    sharp = LeftOut(left_out.person, left_out.q, sharp / sharp.sum(axis=1, keepdims=True))
    assert calibration(sharp)["z2"] > 1.3 and calibration(sharp)["central_95"] < 0.93


def test_errors_are_those_of_the_mean_of_clusters():
    rng = np.random.default_rng(3)
    values, person = rng.normal(size=60), np.repeat(np.arange(6), 10)
    means = values.reshape(6, 10).mean(axis=1)
    np.testing.assert_allclose(clustered(values, person), (means.mean(), means.std(ddof=1) / np.sqrt(6)), rtol=1e-12)


def cohort(people=4):
    rng = np.random.default_rng(0)
    each = [Trials.from_arrays(rng.uniform(size=(5, 2)), rng.integers(0, 3, 5), 6) for _ in range(people)]
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *each)


def test_nobody_predicts_themselves():
    trials = cohort()
    left_out, maps = leave_one_out(GP, trials, "bcm")
    assert left_out.probabilities.shape == (20, 3) and left_out.person.tolist() == np.repeat(np.arange(4), 5).tolist()
    turned = jax.vmap(Trials)(trials.x, trials.q.at[2].set(2 - trials.q[2]), trials.mask)
    other, _ = leave_one_out(GP, turned, "bcm")
    mine, first = left_out.person == 2, np.arange(20) % 5 == 0
    np.testing.assert_allclose(other.probabilities[mine & first], left_out.probabilities[mine & first], rtol=1e-12)
    assert np.abs(other.probabilities[~mine & first] - left_out.probabilities[~mine & first]).max() > 0.01
    moved = influence(rule_map(GP, trials, "bcm"), maps, trials.x[0])
    assert moved.shape == (4,) and (moved > 0).all()


def test_a_person_knows_their_earlier_answers_alone():
    """Who says the opposite at one place is predicted as before up to there, and otherwise from then on."""
    trials, half = cohort(), jnp.asarray(0.5)
    turned = jax.vmap(Trials)(trials.x, trials.q.at[2, 2].set(jnp.where(trials.q[2, 2] < 2, 2, 0)), trials.mask)
    before, after = (
        left_out.probabilities[left_out.person == 2]
        for left_out, _ in (leave_one_out(GP, each, "hierarchical", share=half) for each in (trials, turned))
    )
    np.testing.assert_allclose(after[:3], before[:3], rtol=1e-9)
    assert np.abs(after[3:] - before[3:]).max() > 0.01


def test_two_people_are_too_few():
    with pytest.raises(InputError, match="needs at least three"):
        leave_one_out(GP, cohort(2), "bcm")


def test_an_answer_that_was_all_but_excluded_has_a_finite_score_in_both_tails():
    """1e-20 below, or above: the transform rounds to 1 there, and its score is the other tail's with another sign."""
    probabilities = np.array([[1e-20, 1.0 - 1e-20], [1.0 - 1e-20, 1e-20]])
    low, high = normal_scores(probabilities, np.array([0, 1]))
    assert -11 < low < -9 < 9 < high < 11
    left_out = LeftOut(np.array([0, 1]), np.array([0, 1]), probabilities)
    assert np.isfinite(calibration(left_out)["z2"])
    usual = calibrated(2000)
    u = integral_transform(usual.probabilities, usual.q, 1)
    np.testing.assert_allclose(ndtr(normal_scores(usual.probabilities, usual.q, 1)), u, atol=1e-12)
