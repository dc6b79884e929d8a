"""A new person's answers are predicted from the map and from how people differ about it; what a map knows is told by
its own variance without answers."""

import dataclasses
from functools import partial
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm
from studies import plain

from hilbo import Trials
from hilbo.likelihoods import Goal, OrdinalProbit
from hilbo.population import newcomer
from hilbo.population.maps import RuleMap, point_rule
from hilbo.population.rules.registry import POINTWISE
from hilbo.population.shared.scale_use import ScaleUse
from hilbo.report.figures import regions
from hilbo.report.figures import study as plotting_study
from hilbo.report.figures.maps import Slice
from hilbo.study.analysis import analysis
from hilbo.study.analysis.heterogeneity import how_aggregated
from hilbo.study.analysis.progress import _map_by_points
from hilbo.study.analysis.tolerance import _dominant_in_draws
from hilbo.study.cohort import Cohort
from hilbo.study.estimate.aggregate import Aggregate, fit_cohort
from hilbo.study.estimate.optimum import map_optimum, predict_people

STUDY = plain()
SHARE, PEOPLE = 0.4, 3


@pytest.fixture(scope="module")
def posteriors():
    """Three people of four answers, and the same who said nothing."""
    rng = np.random.default_rng(0)
    x, q = rng.uniform(size=(PEOPLE, 4, 2)), rng.integers(0, 3, (PEOPLE, 4))
    return {said: fit_cohort(STUDY, _cohort(x, q, np.full((PEOPLE, 4), said))) for said in (True, False)}


def _cohort(x, q, mask):
    trials = jax.vmap(Trials)(jnp.asarray(x), jnp.asarray(q, jnp.int32), jnp.asarray(mask))
    return Cohort(trials, x, ("A", "B", "C"))


def of_rule(rule, experts):
    share = SHARE if rule == "hierarchical" else 1.0
    return RuleMap(rule, "by points", experts, None, jnp.asarray(share), jnp.asarray(1.0))


def chances(mean, variance):
    """Ordinal probit with thresholds -0.5, 0.5 and noise 0.5, by scipy."""
    below = norm.cdf((np.array([-0.5, 0.5]) - mean) / np.sqrt(0.5**2 + variance))
    return np.diff(below, prepend=0.0, append=1.0)


@pytest.mark.parametrize("rule", POINTWISE)
def test_a_map_without_answers_has_its_prior(posteriors, rule):
    x = jnp.asarray(np.random.default_rng(1).uniform(size=(5, 2)))
    map_ = of_rule(rule, posteriors[False])
    np.testing.assert_allclose(map_.predict(x)[1], float(map_.map_prior), rtol=1e-12)


def test_class_probabilities_of_an_optimum_are_a_new_persons(posteriors):
    map_ = of_rule("hierarchical", posteriors[True])
    best = map_optimum(STUDY, map_, jnp.asarray(STUDY.space.candidates(64, 0)))
    mean, variance = (float(part[0]) for part in map_.predict(best.x[None, :]))
    np.testing.assert_allclose([best.mean, best.sd], [mean, np.sqrt(variance)], rtol=1e-10)
    np.testing.assert_allclose(best.class_probabilities, chances(mean, variance + 1.0 - SHARE), rtol=1e-9)


def test_draws_of_tolerance_intervals_are_a_new_persons(posteriors):
    """Between the means at which "close" leads for the map alone and for a new person about it."""
    x = jnp.asarray(STUDY.space.candidates(400, 3))
    means, explained = jax.vmap(lambda p: p.predict_explained(x))(posteriors[True])
    rows, share = jnp.arange(PEOPLE)[None, :], jnp.asarray(SHARE)
    inside = np.asarray(_dominant_in_draws(STUDY, 3 * means, explained, jnp.ones(400), rows, "hierarchical", share))[0]
    mean, variance = predict_people(posteriors[True], x, "hierarchical", share)
    expected, sure = (
        np.array([chances(m, v + more).argmax() == 2 for m, v in zip(3 * mean, variance, strict=True)])
        for more in (1.0 - SHARE, 0.0)
    )
    np.testing.assert_array_equal(inside, expected)
    assert (expected != sure).any()


def test_what_stands_in_place_of_a_map_is_said(posteriors):
    """Of a rule that takes all answers at once, maps of fewer trials and of other people are merged otherwise."""
    for rule in ("bcm", "average", "hierarchical"):
        assert how_aggregated(of_rule(rule, posteriors[True])) == "" and not list(
            analysis._aggregated_otherwise(of_rule(rule, None))
        )
    one = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[0]), posteriors[True])  # any posterior will do
    for rule, how in (("hierarchical", "by the method hierarchical point by point"), ("pooled", "by bcm")):
        whole = RuleMap(rule, "exact", None, one, jnp.asarray(SHARE), jnp.asarray(1.0))
        (words,) = analysis._aggregated_otherwise(whole)
        assert how_aggregated(whole) == how and f"are aggregated {how}" in words and f"by the rule {rule} from" in words
    share = jnp.asarray(SHARE)
    assert point_rule("hierarchical", share) == ("hierarchical", share)
    assert point_rule("bcm", share) == ("bcm", None) and point_rule("pooled", share) == ("bcm", None)


def test_maps_of_fewer_trials_are_merged_as_their_stars(posteriors):
    """Point by point, with the share that all answers say."""
    share = jnp.asarray(SHARE)
    merged = _map_by_points(dataclasses.replace(STUDY, rule="hierarchical"), share, posteriors[True])
    x = jnp.asarray(np.random.default_rng(2).uniform(size=(5, 2)))
    expected = predict_people(posteriors[True], x, "hierarchical", jnp.asarray(SHARE))
    np.testing.assert_allclose(np.stack(merged.predict(x)), np.stack(expected), rtol=1e-12)
    by_bcm = _map_by_points(dataclasses.replace(STUDY, rule="pooled"), share, posteriors[True])
    assert (by_bcm.rule, by_bcm.method) == ("bcm", "by points")


def test_readings_are_of_new_people(monkeypatch):
    aggregate = SimpleNamespace(
        optimum=SimpleNamespace(x=jnp.zeros(2)),
        map=of_rule("hierarchical", None),
        posteriors=None,
        surface="the map",
        newcomer=lambda x: (jnp.zeros(len(x)), jnp.full(len(x), 3.0)),
    )
    aggregate.class_probabilities = partial(Aggregate.class_probabilities, aggregate)
    monkeypatch.setattr(analysis, "tolerance", lambda study, predict, x, name, scale: predict)
    monkeypatch.setattr(analysis, "tolerance_ends", lambda *args, **named: None)
    read = analysis._reading(STUDY, aggregate, 0)
    assert all(tolerance[0] is aggregate.newcomer for tolerance in read.tolerances.values())
    np.testing.assert_allclose(regions._probabilities(read, jnp.zeros((1, 2)))[0], chances(0.0, 3.0), rtol=1e-12)


@pytest.mark.parametrize(("prior", "hatched"), [(0.1, True), (1.0, False)])
def test_what_a_map_does_not_know_is_hatched(prior, hatched):
    """A map whose variance is 0.09 everywhere knows nothing if that is 0.9 of its own prior's."""
    drawn = []
    axes = SimpleNamespace(contourf=lambda *args, **named: drawn.append(args))
    sides = (np.linspace(0, 1, 101), np.linspace(0, 1, 101))
    map_slice = Slice(np.zeros((101, 101)), np.full((101, 101), 0.3), sides)
    assert plotting_study._hatch(axes, map_slice, prior) == bool(drawn) == hatched


# Widths of people's middle categories are integrated out.

LIKELIHOOD = OrdinalProbit(jnp.array([-0.5, 0.2, 1.3]), jnp.asarray(0.8))
MEAN, VARIANCE = jnp.array([0.3, -1.0, 4.0]), jnp.array([0.2, 0.5, 2.0])
HIGHEST = Goal.highest(LIKELIHOOD.categories)
class_probabilities, log_goal = map(eqx.filter_jit, (newcomer.class_probabilities, newcomer.log_goal))


WIDTHS, WIDE = ScaleUse(jnp.asarray(0.4)), ScaleUse(sensitivity=jnp.asarray(0.8))
SENSITIVITY = ScaleUse(sensitivity=jnp.asarray(0.4))
BOTH = ScaleUse(jnp.asarray(0.4), jnp.asarray(0.5))
MIDDLE = ScaleUse(sensitivity=jnp.asarray(0.8), fixed_point=jnp.asarray(0.0))


def by_quadrature(mean, variance, category, scale):
    """Over the log factors: of the widths about the middle, then of a function that is multiplied by the sensitivity
    about the highest threshold, or their middle."""
    edges = np.array([-np.inf, -0.5, 0.2, 1.3, np.inf])

    def given(w, s):
        ends = edges[1:4].mean() * (1 - np.exp(w)) + np.exp(w) * edges
        fixed = ends[3] if scale.fixed_point is None else ends[1:4].mean()
        at = fixed + (mean - fixed) * np.exp(s)
        low, high = (ends[category : category + 2] - at) / np.sqrt(0.8**2 + variance * np.exp(2 * s))
        return norm.cdf(high) - norm.cdf(low)

    def over(f, sd):
        return f(0.0) if sd is None else quad(lambda u: f(u) * norm.pdf(u, 0, sd), -9 * sd, 9 * sd, epsabs=1e-11)[0]

    return over(lambda w: over(lambda s: given(w, s), scale.sensitivity), scale.width)


@pytest.mark.parametrize("scale", [WIDTHS, SENSITIVITY, WIDE, MIDDLE, pytest.param(BOTH, marks=pytest.mark.deep)])
def test_the_use_of_the_scale_is_integrated_out(scale):
    pairs, sds = zip(*map(np.asarray, (MEAN, VARIANCE)), strict=True), jax.tree.map(float, scale)
    expected = [[by_quadrature(*pair, c, sds) for c in range(4)] for pair in pairs]
    np.testing.assert_allclose(class_probabilities(LIKELIHOOD, MEAN, VARIANCE, scale), expected, atol=2e-5)


@pytest.mark.parametrize("scale", [None, WIDTHS, SENSITIVITY, BOTH])
def test_the_highest_category_is_the_last_one(scale):
    chances = np.asarray(class_probabilities(LIKELIHOOD, MEAN, VARIANCE, scale))
    np.testing.assert_allclose(
        np.exp(log_goal(LIKELIHOOD, HIGHEST, MEAN, VARIANCE, scale)),
        chances[:, -1],
        rtol=1e-12,
    )


def test_the_highest_category_far_below():
    """Its logarithm stays finite, and so does its slope, where the probability is 0 in double precision."""
    height = jax.jit(jax.value_and_grad(lambda m: newcomer.log_goal(LIKELIHOOD, HIGHEST, m, jnp.zeros(1))[0]))
    value, slope = height(jnp.array([-60.0]))
    np.testing.assert_allclose(value, norm.logcdf((-60.0 - 1.3) / 0.8), rtol=1e-12)
    assert np.isfinite(slope).all() and slope[0] > 0


def test_without_widths_it_is_one_model():
    expected = jax.jit(jax.vmap(LIKELIHOOD.class_probabilities))(MEAN, VARIANCE)
    np.testing.assert_array_equal(class_probabilities(LIKELIHOOD, MEAN, VARIANCE), expected)
