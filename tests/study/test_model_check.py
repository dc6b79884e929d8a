"""Predictions of people left out, beside their answers: what fits is not spoken of, what does not is."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm, t
from studies import answered, plain_study

from hilbo.errors import InputError
from hilbo.likelihoods import OrdinalProbit
from hilbo.population.judged.baselines import constant, quadratic
from hilbo.study.analysis.model_check import _compared, _differs, _limits, check_sentences, model_check
from hilbo.study.analysis.rule_comparison import compare
from hilbo.study.cohort import Cohort
from hilbo.study.estimate.aggregate import aggregate_cohort


@pytest.fixture(scope="module")
def checked():
    """Everybody's first rendering comes twice."""
    study = plain_study(2)
    cohort = answered(study, people=3)
    trials = eqx.tree_at(lambda t: t.x, cohort.trials, cohort.trials.x.at[:, 1].set(cohort.trials.x[:, 0]))
    cohort = Cohort(trials, cohort.physical, cohort.names)
    return study, cohort, model_check(study, aggregate_cohort(study, cohort, alternatives=False))


def test_shares_are_those_of_the_answers(checked):
    study, cohort, content = checked
    q, mask = np.asarray(cohort.trials.q), np.asarray(cohort.trials.mask)
    for c, label in enumerate(study.responses):
        assert content["shares"][label]["given"] == pytest.approx(np.mean(q[mask] == c))
        assert content["by_person"]["P2"]["given"][label] == pytest.approx(np.mean(q[2][mask[2]] == c))
    thirds = [third[study.responses[0]]["given"] for third in content["by_third"]]
    assert len(thirds) == 3
    assert sum(row["predicted"] for row in content["shares"].values()) == pytest.approx(1.0)
    assert content["hyperparameters"] == "as stated" and content["not_converged"] == 0


def test_repeats_are_pairs_of_one_person(checked):
    _, cohort, content = checked
    x, q = np.asarray(cohort.trials.x), np.asarray(cohort.trials.q)
    mask = np.asarray(cohort.trials.mask)
    agree = [
        q[p, i] == q[p, j]
        for p in range(3)
        for i in range(mask.shape[1])
        for j in range(i)
        if mask[p, i] and mask[p, j] and (x[p, i] == x[p, j]).all()
    ]
    assert content["repeats"]["pairs"] == len(agree) == 3
    assert content["repeats"]["given"] == pytest.approx(np.mean(agree))
    assert 0.5 < content["repeats"]["predicted"] < 1.0  # of two classes


def test_repeats_that_agree_too_often_are_spoken_of(checked):
    _, _, content = checked
    told = content | {"repeats": {"pairs": 40, "given": 0.95, "predicted": 0.6, "implied": 0.03, "clustered": 0.02}}
    (said,) = check_sentences(told)
    assert "test-retest agreement is 95 % of 40 pairs of repeated stimuli and was predicted as 60 %" in said


def test_what_fits_is_not_spoken_of(checked):
    """Differences within the limit of either error, or below 5 %."""
    _, _, content = checked
    near = {"given": 0.30, "predicted": 0.36, "implied": 0.04, "clustered": 0.001}
    small = {"given": 0.70, "predicted": 0.66, "implied": 0.001, "clustered": 0.001}
    density = {name: {"cost": 1.0, "difference": -0.01, "error": 0.006} for name in ("constant", "quadratic")}
    fitting = {"shares": {"bad": near, "good": small}, "repeats": None, "negative_log_density": density}
    assert check_sentences(content | fitting) == []


def test_a_model_that_does_not_fit_is_spoken_of(checked):
    """All say "bad", and by the study's noise and threshold every second answer should be "good"."""
    study, cohort, _ = checked
    trials = eqx.tree_at(lambda t: t.q, cohort.trials, jnp.zeros_like(cohort.trials.q))
    noisy = jnp.array([-2.0]), jnp.asarray(10.0, float)  # of the types of the study's own, whose programs serve
    gp = eqx.tree_at(lambda gp: (gp.likelihood.thresholds, gp.likelihood.noise), study.gp, noisy)
    shifted = dataclasses.replace(study, gp=gp)
    aggregate = aggregate_cohort(shifted, Cohort(trials, cohort.physical, cohort.names), alternatives=False)
    content = model_check(shifted, aggregate)
    assert content["shares"]["good"]["given"] == 0.0
    (said,) = check_sentences(content)
    assert said.startswith("With the study's hyperparameters the model does not fit")
    assert 'the proportion of "good" is 0 % and was predicted as' in said
    assert "the same shares everywhere would predict better" in said


def test_the_limits_are_of_all_comparisons_and_of_few_people():
    """Bonferroni; Student's t with one degree of freedom less than people, by SciPy's distributions."""
    limits = _limits(6, 3)
    assert limits.normal == pytest.approx(norm.isf(0.05 / 12)) and limits.student == pytest.approx(t.isf(0.05 / 12, 2))
    row = {"given": 0.5, "predicted": 0.3, "implied": 0.07, "clustered": 0.01}
    assert _differs(row, limits)
    assert not _differs(row | {"clustered": 0.02}, limits) and not _differs(row | {"implied": 0.08}, limits)
    assert _differs(row | {"clustered": 0.02}, _limits(6, 24))


def test_few_answers_all_alike_are_no_misfit():
    """Five pairs that differ, each with probability 0.7, say little; by person their error would be 0.03."""
    row = _compared(np.zeros(5), np.array([0.2, 0.3, 0.3, 0.3, 0.4]), np.arange(5))
    assert row["error"] == pytest.approx(np.sqrt(0.16 + 3 * 0.21 + 0.24) / 5)
    assert not _differs(row, _limits(5, 5))
    rng = np.random.default_rng(0)
    given = (rng.uniform(size=20) < 0.5).repeat(10).astype(float)  # of one person all the same
    assert _compared(given, np.full(200, 0.5), np.arange(200) // 10)["error"] > 0.1


def test_two_people_can_be_neither_checked_nor_compared(checked):
    """Of three, one said nothing."""
    study, cohort, _ = checked
    trials = eqx.tree_at(lambda t: t.mask, cohort.trials, cohort.trials.mask.at[2:].set(False))
    aggregate = aggregate_cohort(study, Cohort(trials, cohort.physical, cohort.names), alternatives=False)
    assert model_check(study, aggregate) is None
    assert check_sentences(None) == []
    with pytest.raises(InputError, match="2 people gave answers; at least three are needed"):
        compare(study, aggregate)


def test_the_constant_is_the_others_shares():
    q, known = np.array([0, 0, 1, 2, 2]), np.array([True, True, True, False, False])
    np.testing.assert_allclose(constant(q, 3, known)[3], np.array([2.5, 1.5, 0.5]) / 4.5)


def test_the_quadratic_finds_a_hill():
    """Of 3,000 answers with a known quadratic."""
    rng = np.random.default_rng(0)
    x = rng.uniform(size=(3000, 2))
    eta = 1.5 - 8.0 * (x[:, 0] - 0.4) ** 2 - 4.0 * (x[:, 1] - 0.7) ** 2
    q = (eta + rng.normal(size=3000) > 0.2).astype(int) + (eta + rng.normal(size=3000) > 9.0)
    probabilities = quadratic(x, q, 3, np.ones(3000, bool))
    np.testing.assert_allclose(probabilities[:, 0], norm.cdf(0.2 - eta), atol=0.05)


def test_baselines_know_a_participants_earlier_responses():
    """Against the exact predictions of a probit with a random intercept, on a fine grid of it."""
    rng = np.random.default_rng(1)
    people, each, sd, edge = 60, 12, 1.0, 0.3
    person = np.repeat(np.arange(people), each)
    shift = rng.normal(size=people) * sd
    q = (shift[person] + rng.normal(size=people * each) > edge).astype(int)
    known = person < people - 1
    got = constant(q, 2, known, person)[~known]
    grid = np.linspace(-6, 6, 2001)
    weight, exact = norm.pdf(grid, scale=sd), []
    for answer in q[~known]:
        chance = norm.cdf(edge - grid)
        exact.append(np.sum(weight * chance) / np.sum(weight))
        weight = weight * (chance if answer == 0 else 1 - chance)
    np.testing.assert_allclose(got[:, 0], exact, atol=0.08)
    assert np.ptp(got[:, 0]) > 0.2
    np.testing.assert_allclose(got[0], constant(q, 2, known)[0], rtol=1e-6)  # before the first response
    np.testing.assert_allclose(got.sum(axis=1), 1.0, rtol=1e-12)


def test_participants_alike_have_no_intercepts():
    rng = np.random.default_rng(2)
    person, x = np.repeat(np.arange(40), 10), rng.uniform(size=(400, 1))
    q = (4 * x[:, 0] - 2 + rng.normal(size=400) > 0).astype(int)
    known = person > 0
    with_person, without = quadratic(x, q, 2, known, person), quadratic(x, q, 2, known)
    assert np.abs(with_person - without).mean() < 0.03


def test_the_quadratic_of_separated_answers_and_of_a_parameter_that_nobody_varied():
    x = np.stack([np.linspace(0, 1, 12), np.full(12, 0.5)], axis=1)
    q = (x[:, 0] > 0.5).astype(int)
    probabilities = quadratic(x, q, 3, np.ones(12, bool))
    assert np.isfinite(probabilities).all() and (probabilities > 0).all()
    assert probabilities[0, 0] > 0.9 and probabilities[-1, 1] > 0.9


def test_the_quadratics_masses_and_slopes():
    """Against differences, and far out in both tails."""
    from hilbo.population.judged.baselines import _log_masses

    edges = np.array([-np.inf, -0.5, 0.9, np.inf])
    level, q = np.array([0.3, -2.0, 30.0, -30.0, 1.0]), np.array([1, 0, 1, 1, 2])
    logs, by_low, by_high = _log_masses(level, edges, q)
    likelihood = OrdinalProbit(jnp.array([-0.5, 0.9]), jnp.asarray(1.0))
    np.testing.assert_allclose(
        logs, [float(likelihood.log_prob(f, c)) for f, c in zip(level, q, strict=True)], rtol=1e-10
    )
    moved = [_log_masses(level, edges + np.array([0, s, s, 0]), q)[0] for s in (1e-5, -1e-5)]
    np.testing.assert_allclose(by_low + by_high, (moved[0] - moved[1]) / 2e-5, rtol=1e-6)
