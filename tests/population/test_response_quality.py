"""Consistency, lapses and drift of people whose answers are known, and the rule that leaves people out."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from datasets import SMALL
from helpers import model
from scipy.stats import binomtest, chi2

from hilbo import RBF, OrdinalGP, OrdinalProbit, Trials
from hilbo.errors import InputError
from hilbo.population.judged import response_quality
from hilbo.population.judged.response_quality import excluded, measure_people, repeats

CASE = SMALL[0]()


def test_repeats_are_disjoint_and_nearest_first():
    x = np.array([[0.1], [0.5], [0.115], [0.102], [0.9], [0.5]])
    np.testing.assert_array_equal(repeats(x, 0.02), [[1, 5], [0, 3]])
    assert repeats(x[:1]).shape == (0, 2)


def test_consistency_counts_pairs(getkey):
    data = CASE
    x, q = np.array([[0.2] * 3, [0.2] * 3, [0.8] * 3, [0.8] * 3]), np.array([2, 2, 0, 1])
    trials = jax.tree.map(lambda leaf: leaf[None], Trials.from_arrays(x, q))
    (row,) = measure_people(model(data), trials, ("A",)).to_dict("records")
    assert (row["trials"], row["categories"], row["pairs"], row["consistency"]) == (4, 3, 2, 0.5)
    assert row["chance"] == pytest.approx((4 + 1 + 1) / 16)
    ends = binomtest(1, 2).proportion_ci()
    assert (row["consistency_low"], row["consistency_high"]) == (ends.low, ends.high)


def test_measures_do_not_depend_on_the_unit_of_the_score():
    """The same answers under a model in which the latent score is three times as large."""
    one, trials = person(120, 0.4, -2.0)
    square, wide = jnp.asarray(9.0), jnp.asarray(3.0)
    other = OrdinalGP(
        RBF(one.kernel.theta, square * one.kernel.variance),
        OrdinalProbit(wide * one.likelihood.thresholds, wide * one.likelihood.noise),
    )
    rows = [
        measure_people(gp, trials, ("A",))[["lapse", "surprise", "drift", "drift_low", "drift_high"]]
        for gp in (one, other)
    ]
    assert -6 < rows[0]["drift"][0] < 0 < rows[0]["lapse"][0]
    np.testing.assert_allclose(rows[1], rows[0], atol=1e-4)


def person(count, lapse, drift, seed=0):
    """Answers of one person at five renderings in turn, whose scores are 2, 1, ... -2."""
    rng, gp = np.random.default_rng(seed), model(CASE)
    places = np.arange(count) % 5
    score = 2.0 - places + drift * np.linspace(-0.5, 0.5, count) + 0.3 * rng.standard_normal(count)
    told = np.searchsorted(np.asarray(gp.likelihood.thresholds), score)
    q = np.where(rng.permutation(count) < lapse * count, rng.integers(gp.likelihood.categories, size=count), told)
    x = np.stack([places / 4, np.zeros(count), np.zeros(count)], axis=1)
    return gp, jax.tree.map(lambda leaf: leaf[None], Trials.from_arrays(x, q))


@pytest.mark.parametrize(("lapse", "drift"), [(0.0, -3.0), (0.0, 2.0), (0.4, 0.0)])
def test_guesses_and_a_drift_are_told_apart(lapse, drift):
    (row,) = measure_people(*person(120, lapse, drift), ("A",)).to_dict("records")
    assert row["lapse_low"] <= lapse <= row["lapse_high"] < 0.7 and (row["lapse_low"] > 0.1) == (lapse > 0)
    assert row["drift_low"] <= drift <= row["drift_high"]
    assert (row["drift_high"] < -1.0, row["drift_low"] > 0.5) == (drift < 0, drift > 0)


def test_an_interval_narrower_than_the_grid_is_that_of_a_fine_grid():
    rng, gp = np.random.default_rng(3), OrdinalGP(RBF(1.0, 1.0), OrdinalProbit((-0.5, 0.5), 0.02))
    x = rng.uniform(size=(60, 1)) * np.array([[1.0, 0.0, 0.0]])
    score = np.sin(6.0 * x[:, 0]) + 1.3 * np.linspace(-0.5, 0.5, 60)
    q = np.searchsorted(np.asarray(gp.likelihood.thresholds), score)
    trials = jax.tree.map(lambda leaf: leaf[None], Trials.from_arrays(x, q))
    (row,) = measure_people(gp, trials, ("A",)).to_dict("records")
    grid = response_quality._DRIFTS
    assert np.sum((grid >= row["drift_low"]) & (grid <= row["drift_high"])) < 4
    fine = np.linspace(row["drift_low"] - 0.1, row["drift_high"] + 0.1, 42)
    levelled = OrdinalGP(response_quality._Levelled(gp.kernel), gp.likelihood)
    profile = np.asarray(response_quality._log_likelihoods(levelled, trials, jnp.asarray(fine))).max(axis=(0, 1))
    within = fine[profile > profile.max() - chi2.ppf(0.95, 1) / 2]
    np.testing.assert_allclose([row["drift_low"], row["drift_high"]], within[[0, -1]], atol=fine[1] - fine[0])


def test_of_many_answers_an_even_part_is_measured(monkeypatch):
    gp, trials = person(26, 0.0, 0.0)
    monkeypatch.setattr(response_quality, "_MOST", 16)
    (row,) = measure_people(gp, trials, ("A",)).to_dict("records")
    part = np.linspace(0, 25, 16).round().astype(int)
    (few,) = measure_people(gp, jax.tree.map(lambda leaf: leaf[:, part], trials), ("A",)).to_dict("records")
    assert (row["trials"], few["trials"]) == (26, 16)
    for name in ("lapse_high", "drift", "surprise"):
        assert row[name] == pytest.approx(few[name], rel=1e-6)


def test_what_the_answers_do_not_tell_is_no_number():
    """Drifts make no difference to answers that are all guessed; and a lapse rate that may be any is none."""
    flat = np.full((18, 21), -30.0)
    assert response_quality._drift(response_quality._DRIFTS, flat, 5) == pytest.approx(
        (np.nan, -np.inf, np.inf), nan_ok=True
    )
    assert response_quality._lapse(flat, 5) == pytest.approx((np.nan, 0.0, 1.0), nan_ok=True)
    falls = flat - np.linspace(0.0, 4.0, 18)[:, None]  # from the lowest rate to the highest
    best, low, high = response_quality._lapse(falls, 5)
    assert 0 <= best < 0.01 and low == 0 and high < 1


def test_of_nobody_nothing_is_said():
    gp, trials = person(5, 0.0, 0.0)
    nobody = eqx.tree_at(lambda t: t.mask, trials, jnp.zeros_like(trials.mask))
    (row,) = measure_people(gp, nobody, ("A",)).to_dict("records")
    assert np.isnan([row["lapse"], row["drift"], row["surprise"]]).all()
    assert (row["lapse_low"], row["lapse_high"]) == (0.0, 1.0)
    assert (row["drift_low"], row["drift_high"]) == (-np.inf, np.inf)


def test_rules_name_who_and_why():
    trials = jax.vmap(lambda q: Trials(jnp.zeros((2, 3)), q, jnp.array([True, True])))(
        jnp.array([[0, 0], [0, 1]], jnp.int32)
    )
    table = measure_people(model(CASE), trials, ("A", "B"))
    assert excluded(table, "") == {}
    reasons = excluded(table, "trials < 2 or categories <= 1")
    assert reasons == {"A": "categories is 1, and the rule leaves out categories <= 1"}
    assert excluded(table, "consistency < 0.5") == {"B": "consistency is 0, and the rule leaves out consistency < 0.5"}
    for rule, words in (
        ("mood > 1", "is no condition"),
        ("trials < few", "is no condition"),
        ("lapse > 1e", "is no number"),
    ):
        with pytest.raises(InputError, match=words):
            excluded(table, rule)
