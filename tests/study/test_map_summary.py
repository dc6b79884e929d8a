"""Reading maps whose maxima, minima and class borders are known in closed form."""

from importlib.resources import files

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm
from studies import plain

from hilbo import Study, passivity
from hilbo.errors import InputError
from hilbo.search.candidates import search_points
from hilbo.study.map_summary import best_mid_worst, dominant, slice_through, tolerance


class Hill(eqx.Module):
    """Mean: a paraboloid around `top` with a dip at `dip`; sd `sd`, but `far_sd` beyond 0.25 of the dip and the top."""

    top: jax.Array
    dip: jax.Array
    sd: float = 0.2
    far_sd: float = 0.2

    def __call__(self, x):
        square = jnp.sum((x - self.top[None, :]) ** 2, axis=1)
        dip = jnp.sum((x - self.dip[None, :]) ** 2, axis=1)
        known = (square < 0.25**2) | (dip < 0.25**2)
        return 1.2 - 4.0 * square - 1.5 * jnp.exp(-dip / 0.005), jnp.where(known, self.sd, self.far_sd) ** 2


def test_the_three_sets_of_a_hill_with_a_dip():
    study, points = plain(), jnp.asarray(plain().space.candidates(4096, 0))
    hill = Hill(jnp.array([0.25, 0.3]), jnp.array([0.7, 0.75]), far_sd=0.95)
    sets = best_mid_worst(study, hill, points)
    np.testing.assert_allclose(sets.x[0], [0.25, 0.3], atol=1e-6)
    # The dip's bottom is where the slopes of dip and hill add up to 0.
    slope = jax.grad(lambda x: hill(x[None, :])[0][0])(sets.x[2])
    np.testing.assert_allclose(slope, 0.0, atol=1e-6)
    assert np.linalg.norm(sets.x[2] - hill.dip) < 0.05
    middle = (sets.mean[0] + sets.mean[2]) / 2
    assert abs(sets.mean[1] - middle) < 0.01
    assert min(np.linalg.norm(sets.x[1] - sets.x[0]), np.linalg.norm(sets.x[1] - sets.x[2])) >= 0.2
    again = best_mid_worst(study, hill, points)
    np.testing.assert_array_equal(again.x, sets.x)


def test_a_corner_that_nobody_knows_is_not_the_worst():
    """Without the bound on the sd the corner far from the top is lowest of all."""
    study, points = plain(), jnp.asarray(plain().space.candidates(4096, 0))
    hill = Hill(jnp.array([0.25, 0.3]), jnp.array([0.5, 0.5]), far_sd=0.95)
    assert np.linalg.norm(best_mid_worst(study, hill, points).x[2] - 0.5) < 0.05
    everywhere = jnp.concatenate([points, jnp.asarray(study.space.walls(512, 0))])
    np.testing.assert_allclose(best_mid_worst(study, hill, everywhere, known=1.0).x[2], [1.0, 1.0], atol=1e-9)
    # As known is a point whose sd of 0.95 is half of what the map says without answers.
    np.testing.assert_allclose(best_mid_worst(study, hill, everywhere, prior=4.0).x[2], [1.0, 1.0], atol=1e-9)


def test_maps_that_know_too_little_are_refused():
    study, points = plain(), jnp.asarray(plain().space.candidates(512, 0))
    with pytest.raises(InputError, match="more answers are needed"):
        best_mid_worst(study, Hill(jnp.array([0.2, 0.3]), jnp.array([0.7, 0.7]), 0.95, 0.95), points)
    with pytest.raises(InputError, match="smaller `apart`"):
        best_mid_worst(study, Hill(jnp.array([0.2, 0.3]), jnp.array([0.7, 0.7])), points, apart=1.5)


def test_tolerance_ends_where_close_stops_being_likeliest():
    """With equal noise and sd, "close" leads above the mean at which P(close) = P(similar): by root finding."""
    study = plain()
    hill = Hill(jnp.array([0.5, 0.5]), jnp.array([5.0, 5.0]))
    spread = np.hypot(0.5, 0.2)
    grid = np.linspace(-1, 2, 3_000_001)
    top = 1 - norm.cdf((0.5 - grid) / spread)
    middle = norm.cdf((0.5 - grid) / spread) - norm.cdf((-0.5 - grid) / spread)
    border = grid[np.argmax(top > middle)]
    reach = np.sqrt((1.2 - border) / 4.0)
    interval = tolerance(study, hill, hill.top, "u")
    np.testing.assert_allclose([interval.low, interval.high], [0.5 - reach, 0.5 + reach], atol=1e-5)
    assert (interval.low_end, interval.high_end) == ("other answer", "other answer")
    physical = tolerance(study, hill, hill.top, "v")
    np.testing.assert_allclose([physical.low, physical.high], [15 - 10 * reach, 15 + 10 * reach], atol=1e-4)


def test_tolerance_ends_at_the_range_and_is_none_where_another_answer_leads():
    study = plain()
    hill = Hill(jnp.array([0.05, 0.5]), jnp.array([5.0, 5.0]))
    interval = tolerance(study, hill, hill.top, "u")
    assert (interval.low, interval.low_end, interval.high_end) == (0.0, "range", "other answer")
    assert tolerance(study, hill, jnp.array([0.9, 0.5]), "u") is None


def haptic():
    return Study.load(files("hilbo") / "data" / "paper.toml")


def test_tolerance_on_the_passive_boundary():
    """At the paper's optimum K1 is cut, one-sided, by the closed form; along B1 and alpha every point is passive."""
    study = haptic()
    b = study.space.mechanics.damping * (1 - 1e-3)
    limit = float(passivity.largest_K1(7.88, 0.176, b))
    x = study.space.to_unit(jnp.array([0.999 * limit, 7.88, 0.176]))
    hill = Hill(x, jnp.full(3, 5.0))
    K1 = tolerance(study, hill, x, "K1")
    np.testing.assert_allclose(K1.high, limit, rtol=1e-9)
    assert (K1.low_end, K1.high_end) == ("range", "passive boundary")
    for name in ("B1", "alpha"):
        interval = tolerance(study, hill, x, name)
        assert interval.low < interval.high
        points, feasible = slice_through(study, x, name, jnp.linspace(0.0, 1.0, 201))
        held = np.asarray(points[:, 0])
        assert np.all(held <= x[0]) and held.min() < 0.9 * x[0]
        inside = np.asarray(feasible)
        physical = np.asarray(study.space.to_physical(points))[inside]
        assert np.all(passivity.minimum_damping(*physical.T) <= b * (1 + 1e-12))
        assert inside.sum() > 100


def test_dominant_is_what_the_probabilities_say():
    study = haptic()
    x = jnp.asarray(search_points(study.space, 0))[:500]
    hill = Hill(jnp.array([0.15, 0.2, 0.2]), jnp.full(3, 5.0))
    p = jax.vmap(study.gp.likelihood.class_probabilities)(*hill(x))
    np.testing.assert_array_equal(dominant(study, hill, x), np.argmax(p, axis=1) == 2)
