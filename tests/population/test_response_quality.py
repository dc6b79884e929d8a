"""Consistency, lapses and drift of people whose answers are known, and the rule that leaves people out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from datasets import SMALL
from helpers import answers, model
from scipy.stats import binomtest, norm

from hilbo import RBF, OrdinalGP, OrdinalProbit, Trials, fit
from hilbo.errors import InputError
from hilbo.kernels import gram
from hilbo.population.response_quality import drift, excluded, lapse, left_out, measure_people, repeats

CASE = SMALL[0]()


@pytest.mark.deep
def test_leaving_an_answer_out_is_dropping_its_site():
    """The Gaussian of all sites but one, by dense algebra; and nearly EP's own fit without that answer."""
    data = CASE
    gp, trials = model(data), answers(data)
    mean, variance, chances = left_out(gp, trials)
    latent = fit(gp, trials, inference="ep").latent
    n = len(data.q)
    covariance = np.asarray(gram(gp.kernel, trials.x, trials.x))[:n, :n]
    inverse, weights, mode = (np.asarray(part)[:n] for part in (latent.inverse, latent.weights, latent.mode))
    precision = np.diagonal(inverse[:, :n]) / (1 - np.sum(inverse[:, :n] * covariance, axis=1))
    natural = weights + precision * mode
    for i in range(n):
        others = np.arange(n) != i
        kept = np.diag(1 / precision[others]) + covariance[np.ix_(others, others)]
        cross = np.linalg.solve(kept, covariance[others, i])
        expected = cross @ (natural[others] / precision[others]), covariance[i, i] - cross @ covariance[others, i]
        np.testing.assert_allclose([mean[i], variance[i]], expected, atol=1e-9)
        rest = Trials(trials.x, trials.q, trials.mask.at[i].set(False))
        np.testing.assert_allclose(
            expected, np.ravel(fit(gp, rest, inference="ep").predict(trials.x[i : i + 1])), atol=0.05
        )
        edges = np.concatenate([[-np.inf], data.thresholds, [np.inf]])
        z = (edges - float(mean[i])) / np.sqrt(data.noise**2 + float(variance[i]))
        np.testing.assert_allclose(chances[i], np.diff(norm.cdf(z)), atol=1e-12)


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
    x, q = np.array([[0.2] * 3, [0.3] * 3, [0.2] * 3, [0.5] * 3]), np.array([2, 1, 1, 0])
    trials = jax.tree.map(lambda leaf: leaf[None], Trials.from_arrays(x, q))
    square, wide = jnp.asarray(9.0), jnp.asarray(3.0)
    one = model(CASE)
    other = OrdinalGP(
        RBF(one.kernel.theta, square * one.kernel.variance),
        OrdinalProbit(wide * one.likelihood.thresholds, wide * one.likelihood.noise),
    )
    rows = [
        measure_people(gp, trials, ("A",))[["lapse", "surprise", "drift", "drift_low", "drift_high"]]
        for gp in (one, other)
    ]
    assert -6 < rows[0]["drift"][0] < 0
    np.testing.assert_allclose(rows[1], rows[0], atol=1e-4)


def test_the_lapse_rate_of_a_known_mixture():
    """Answers that a perfect model gives 0.9 to, but for the share that is guessed; its maximum is in closed form."""
    given = np.repeat([0.9, 0.05], [80, 20])
    best, low, high = lapse(given, 3)
    slopes = (1 / 3 - given) / ((1 - best) * given + best / 3)
    assert slopes.sum() == pytest.approx(0.0, abs=1e-3)
    assert low < best < high
    assert lapse(np.full(10, 0.95), 3)[0] == pytest.approx(0.0, abs=1e-5)
    assert lapse(np.full(10, 0.01), 3) == pytest.approx((1.0, lapse(np.full(10, 0.01), 3)[1], 1.0), abs=1e-5)
    assert np.isnan(lapse(np.zeros(0), 3)[0])


def test_drift_finds_the_shift_that_was_put_in():
    rng = np.random.default_rng(0)
    likelihood = model(CASE).likelihood
    count, shift = 4000, -1.5
    mean = rng.normal(size=count)
    noise = float(likelihood.noise) * rng.standard_normal(count)
    z = mean + shift * np.linspace(-0.5, 0.5, count) + noise
    q = np.searchsorted(np.asarray(likelihood.thresholds), z)
    best, low, high = drift(likelihood, mean, np.zeros(count), q)
    assert low < shift < high and high - low < 0.4
    assert abs(best - shift) < 0.2
    assert drift(likelihood, mean[:1], np.zeros(1), q[:1])[1:] == (-np.inf, np.inf)


def test_guesses_do_not_make_a_drift_sure():
    likelihood, held = model(CASE).likelihood, 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        mean = rng.normal(size=40)
        z = mean + np.linspace(-0.5, 0.5, 40) + float(likelihood.noise) * rng.standard_normal(40)
        told = np.searchsorted(np.asarray(likelihood.thresholds), z)
        q = np.where(rng.random(40) < 0.3, rng.integers(likelihood.categories, size=40), told)
        _, low, high = drift(likelihood, mean, np.zeros(40), q)
        held += low < 1.0 < high
    assert held >= 53  # of 60; taken for attentive, these people's intervals hold the truth less often


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
