"""Reading maps whose maxima, minima and class borders are known in closed form.

All read from as many points, so that they share what is compiled.
"""

import dataclasses
import functools
import json
from importlib.resources import files

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import norm
from studies import PLAIN, plain

from hilbo import Study, passivity
from hilbo.errors import InputError
from hilbo.search.candidates import search_points
from hilbo.study.analysis.best_mid_worst import best_mid_worst, second_choice_sentence
from hilbo.study.analysis.tolerance import dominant, slice_through, tolerance

POINTS = 1026  # of a slice through an optimum that is between the points of its grid


class Hill(eqx.Module):
    """Mean: a paraboloid around `top` with a dip at `dip`; sd `sd`, but `far_sd` beyond 0.25 of the dip and the top."""

    top: np.ndarray = eqx.field(converter=np.asarray)
    dip: np.ndarray = eqx.field(converter=np.asarray)
    sd: np.ndarray = eqx.field(converter=np.asarray, default=0.2)
    far_sd: np.ndarray = eqx.field(converter=np.asarray, default=0.2)

    def __call__(self, x):
        square = jnp.sum((x - self.top[None, :]) ** 2, axis=1)
        dip = jnp.sum((x - self.dip[None, :]) ** 2, axis=1)
        known = (square < 0.25**2) | (dip < 0.25**2)
        return 1.2 - 4.0 * square - 1.5 * jnp.exp(-dip / 0.005), jnp.where(known, self.sd, self.far_sd) ** 2


@functools.cache
def candidates():
    """Of the plain study: inside, and on the walls."""
    return search_points(plain().space, 0)


def three_sets(hill, **options):
    """Best, mid and worst of the plain study."""
    return jax.tree.map(np.asarray, best_mid_worst(plain(), hill, candidates(), **options))


def test_the_three_sets_of_a_hill_with_a_dip():
    hill = Hill([0.25, 0.3], [0.7, 0.75], far_sd=0.95)
    sets = three_sets(hill)
    np.testing.assert_allclose(sets.x[0], [0.25, 0.3], atol=1e-6)
    # The dip's bottom is where the slopes of dip and hill add up to 0.
    slope = jax.jit(jax.grad(lambda x: hill(x[None, :])[0][0]))(sets.x[2])
    np.testing.assert_allclose(slope, 0.0, atol=1e-6)
    assert np.linalg.norm(sets.x[2] - hill.dip) < 0.05
    middle = (sets.mean[0] + sets.mean[2]) / 2
    assert abs(sets.mean[1] - middle) < 0.01
    assert min(np.linalg.norm(sets.x[1] - sets.x[0]), np.linalg.norm(sets.x[1] - sets.x[2])) >= 0.2
    np.testing.assert_array_equal(three_sets(hill).x, sets.x)


def test_a_corner_that_nobody_knows_is_not_the_worst():
    """Without the bound on the sd the corner far from the top is lowest of all."""
    hill = Hill([0.25, 0.3], [0.5, 0.5], far_sd=0.95)
    assert np.linalg.norm(three_sets(hill).x[2] - 0.5) < 0.05
    np.testing.assert_allclose(three_sets(hill, known=1.0).x[2], [1.0, 1.0], atol=1e-9)
    # As known is a point whose sd of 0.95 is half of what the map says without answers.
    np.testing.assert_allclose(three_sets(hill, prior=4.0).x[2], [1.0, 1.0], atol=1e-9)


def test_maps_that_know_too_little_have_sets_of_second_choice():
    """Worst is the lowest of the best-known candidates that are apart from the best; mid is as far from both as can
    be."""
    defined = three_sets(Hill([0.2, 0.3], [0.7, 0.7]))
    assert defined.second_choice == ()
    nothing_known = three_sets(Hill([0.2, 0.3], [0.7, 0.7], 0.95, 0.95))
    assert nothing_known.second_choice == ("mid", "worst")
    crowded = three_sets(Hill([0.2, 0.3], [0.7, 0.7]), apart=1.5)
    assert crowded.second_choice == ("mid",)
    for sets in (nothing_known, crowded):
        assert sets.mean[0] > sets.mean[1] > sets.mean[2]
    names = [second_choice_sentence(plain(), name, "P07") for name in ("mid", "worst")]
    assert all("P07" in sentence for sentence in names)


def test_two_levels_or_a_map_that_is_not_finite_have_no_three_sets():
    with pytest.raises(InputError, match="no three different stimuli"):
        three_sets(Hill([np.nan, 0.3], [0.7, 0.7]))
    raw = {"schema": 1} | json.loads(plain().file.content)
    raw["parameters"] = {"u": {"levels": ["silk", "wood"]}}
    study = Study.from_dict(raw)
    with pytest.raises(InputError, match="no three different stimuli"):
        best_mid_worst(study, lambda x: (x[:, 0], jnp.full(len(x), 0.04)), search_points(study.space, 0))


def test_without_a_known_minimum_worst_is_the_lowest_known_place():
    """A hill that falls away on all sides, known only near its top: its minima are the unknown corners."""
    hill = Hill([0.5, 0.5], [5.0, 5.0], far_sd=0.95)
    sets = three_sets(hill)
    assert sets.second_choice == ("worst",)
    away = np.linalg.norm(sets.x[2] - 0.5)
    assert 0.2 <= away < 0.25 and sets.sd[2] <= 0.8


def test_tolerance_ends_where_close_stops_being_likeliest():
    """With equal noise and sd, "close" leads above the mean at which P(close) = P(similar): by root finding."""
    study = plain()
    hill = Hill([0.47, 0.5], [5.0, 5.0])
    spread = np.hypot(0.5, 0.2)

    def lead(mean):
        """P(close) - P(similar)."""
        different, not_close = norm.cdf((np.array([-0.5, 0.5]) - mean) / spread)
        return (1 - not_close) - (not_close - different)

    border = brentq(lead, -1.0, 2.0, xtol=1e-12)
    reach = np.sqrt((1.2 - border) / 4.0)
    interval = tolerance(study, hill, jnp.asarray(hill.top), "u")
    np.testing.assert_allclose([interval.low, interval.high], [0.47 - reach, 0.47 + reach], atol=1e-5)
    assert (interval.low_end, interval.high_end) == ("other answer", "other answer")
    hill = Hill([0.5, 0.47], [5.0, 5.0])
    physical = tolerance(study, hill, jnp.asarray(hill.top), "v")
    np.testing.assert_allclose([physical.low, physical.high], [14.7 - 10 * reach, 14.7 + 10 * reach], atol=1e-4)


def test_tolerance_ends_at_the_range_and_is_none_where_another_answer_leads():
    study = plain()
    hill = Hill([0.05, 0.5], [5.0, 5.0])
    interval = tolerance(study, hill, jnp.asarray(hill.top), "u")
    assert (interval.low, interval.low_end, interval.high_end) == (0.0, "range", "other answer")
    assert tolerance(study, hill, jnp.array([0.9, 0.5]), "u") is None


def haptic():
    return Study.load(files("hilbo") / "data" / "paper.toml")


def test_tolerance_on_the_passive_boundary():
    """At the paper's optimum K1 is cut, one-sided, by the closed form; along B1 and alpha every point is passive."""
    study = haptic()
    b = study.space.mechanics.damping * (1 - 1e-3)
    limit = float(passivity.largest_K1(7.88, 0.176, b))
    x = study.space.to_unit(np.array([0.999 * limit, 7.88, 0.176]))
    hill = Hill(x, np.full(3, 5.0))
    K1 = tolerance(study, hill, x, "K1")
    np.testing.assert_allclose(K1.high, limit, rtol=1e-9)
    assert (K1.low_end, K1.high_end) == ("range", "passive boundary")
    for name in ("B1", "alpha"):
        interval = tolerance(study, hill, x, name)
        assert interval.low < interval.high
        points, feasible = slice_through(study, x, name, jnp.asarray(np.linspace(0.0, 1.0, POINTS)))
        held = np.asarray(points[:, 0])
        assert np.all(held <= x[0]) and held.min() < 0.9 * x[0]
        damping = np.asarray(passivity.minimum_damping(*np.asarray(study.space.to_physical(points)).T))
        inside = np.asarray(feasible)
        assert np.all(damping[inside] <= b * (1 + 1e-12))
        assert inside.mean() > 0.5


def test_tolerance_ends_at_a_constraint():
    """Of a study without a renderer: nothing there is passive, and the hill is good beyond the constraint too."""
    study = Study.from_dict(PLAIN | {"constraints": [{"terms": {"u": 10.0, "v": 1.0}, "most": 20.0}]})
    hill = Hill([0.47, 0.5], [5.0, 5.0])
    interval = tolerance(study, hill, jnp.asarray(hill.top), "u")
    assert (interval.low_end, interval.high_end) == ("other answer", "constraint")
    np.testing.assert_allclose(interval.high, 0.5, atol=1e-9)


def test_tolerance_ends_at_the_range_of_effective_damping():
    """K1 is bounded on both sides by it, where the device would let it go on."""
    study = haptic()
    mechanics = dataclasses.replace(study.space.mechanics, damping=5.0, effective_damping=(30.0, 80.0))
    study = dataclasses.replace(study, space=dataclasses.replace(study.space, mechanics=mechanics))
    x = study.space.from_box(jnp.full(3, 0.5))
    K1 = tolerance(study, Hill(x, np.full(3, 5.0)), x, "K1")
    assert (K1.low_end, K1.high_end) == ("effective damping", "effective damping")


def test_dominant_is_what_the_probabilities_say():
    """Where little is known the middle answer is never the likeliest."""
    study = haptic()
    x = jnp.asarray(np.random.default_rng(0).uniform(size=(POINTS, 3)))
    hill = Hill([0.15, 0.2, 0.2], np.full(3, 5.0), far_sd=3.0)
    p = jax.jit(lambda x: jax.vmap(study.gp.likelihood.class_probabilities)(*hill(x)))(x)
    leads = np.argmax(np.asarray(p), axis=1) == 2
    assert 0.1 < leads.mean() < 0.9
    np.testing.assert_array_equal(dominant(study, hill, x), leads)
