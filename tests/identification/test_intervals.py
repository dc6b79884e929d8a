"""Intervals against brute force: profiles by scipy, spectra by Toeplitz matrices, the bootstrap by refits."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from material import FOAM, foam_tests
from scipy.linalg import toeplitz
from scipy.optimize import brentq
from scipy.optimize import least_squares as scipy_least_squares
from scipy.stats import t as student

from hilbo.errors import InputError
from hilbo.identification import intervals, residual_noise
from hilbo.identification.fitting import Curve, Fit, Test, fit, residuals
from hilbo.identification.sampled import Sampled
from hilbo.numerics.least_squares import Solution, least_squares
from hilbo.viscoelastic import FOSLS


@pytest.fixture(scope="module")
def fitted():
    return fit(foam_tests(6, noise=0.004, rho=0.8, seed=1, hold=0.5), Sampled())


@pytest.mark.deep
def test_noise_is_recognised(fitted):
    for part in residual_noise.noise(fitted):
        assert int(part.order) >= 1
        assert float(part.lag_one) == pytest.approx(0.8, abs=0.1)
    sizes = [curve.time.size for curve in fitted.curves]
    shares = [float(part.effective) / size for part, size in zip(residual_noise.noise(fitted), sizes, strict=True)]
    assert shares == pytest.approx([1 / 9, 1 / 9], rel=0.5)  # (1 - 0.8)/(1 + 0.8)


def test_a_filtered_product_is_that_with_the_autocovariance_matrix():
    rng = np.random.default_rng(0)
    slopes, a = rng.standard_normal((200, 3)), np.array([0.5, 0.2])
    lags = [1.0, a[0] / (1 - a[1])]
    for _ in range(198):
        lags.append(a[0] * lags[-1] + a[1] * lags[-2])
    innovation = 1 - a @ lags[1:3]
    model = residual_noise.Noise(
        jnp.asarray(2),
        jnp.zeros(8).at[:2].set(a),
        jnp.asarray(0.0),
        jnp.asarray(0.0),
        jnp.asarray(0.0),
        jnp.asarray(innovation),
    )
    expected = slopes.T @ toeplitz(lags) @ slopes
    np.testing.assert_allclose(
        residual_noise.weighted_normal(jnp.asarray(slopes), model), expected, rtol=1e-9, atol=1e-9
    )


@pytest.mark.parametrize("freedom", [5, 12, 100])
def test_the_quantile_is_students(freedom):
    assert float(intervals._student(1.959964, jnp.asarray(float(freedom)))) == pytest.approx(
        student.ppf(0.975, freedom), rel=2e-2 if freedom == 5 else 2e-3
    )


@pytest.mark.deep
def test_ends_of_a_profile_are_where_scipy_finds_them(fitted):
    around, sides = intervals.spread(fitted), intervals.profile_intervals(fitted)
    assert np.all(sides.bracketed)
    assert not np.any(sides.open_lower) and not np.any(sides.open_upper)
    misfit = jax.jit(lambda q: residuals(fitted.model, fitted.curves, fitted.weights, q))
    slopes = jax.jit(jax.jacfwd(misfit))
    j, q = 3, np.asarray(fitted.q)

    def rise(value):
        whole = lambda p: jnp.asarray(np.insert(p, j, value))  # noqa: E731
        best = scipy_least_squares(
            lambda p: np.asarray(misfit(whole(p))),
            np.delete(q, j),
            jac=lambda p: np.delete(np.asarray(slopes(whole(p))), j, axis=1),
            x_scale="jac",
        )
        return 2 * best.cost - float(fitted.solution.cost) - float(around.cut[j])

    ends = brentq(rise, q[j] - 2, q[j], xtol=1e-4), brentq(rise, q[j], q[j] + 2, xtol=1e-4)
    width = ends[1] - ends[0]
    assert float(sides.lower[j]) == pytest.approx(ends[0], abs=3e-3 * width)
    assert float(sides.upper[j]) == pytest.approx(ends[1], abs=3e-3 * width)
    truth = fitted.model.coordinates(*FOAM)
    assert np.all((sides.lower < truth) & (truth < sides.upper))


class Line(eqx.Module):
    """An intercept and a slope, which are fitted to a rising line."""

    free: bool = eqx.field(static=True, default=False)
    labels = ("intercept", "slope")

    def physical(self):
        return (False, False), (False, self.free)

    def predict(self, q, curve, weights):
        return q[0] + q[1] * curve.time


@pytest.mark.deep
@pytest.mark.parametrize("natural", [False, True])
def test_an_end_that_another_bound_sets_is_open(natural):
    """Lower intercepts need a steeper slope than the box has: a wider box would move that end."""
    t = jnp.linspace(0, 1, 50)
    noise = 0.05 * np.random.default_rng(0).standard_normal(50)
    curve = Curve("modulus", t, (1 + 2 * t + noise)[None], jnp.zeros(1), jnp.ones(50))
    upper = jnp.asarray([5.0, 2.07])
    lower, weights = jnp.asarray([-5.0, -5.0]), (jnp.ones(1),)
    model = Line(natural)
    solution = least_squares(
        lambda q: residuals(model, (curve,), weights, q), jnp.asarray([1.0, 1.9]), lower, upper, max_steps=50
    )
    assert float(solution.q[1]) < 2.07
    sides = intervals.profile_intervals(Fit(model, (curve,), solution, lower, upper, weights))
    assert bool(sides.open_lower[0]) is not natural and not bool(sides.open_upper[0])


@pytest.mark.deep
def test_the_bootstrap_is_about_as_wide_as_the_profile(fitted):
    sides = intervals.profile_intervals(fitted)
    lower, upper = intervals.block_bootstrap(fitted, jax.random.key(0))
    ratio = (upper - lower) / (sides.upper - sides.lower)
    assert np.all((ratio > 0.4) & (ratio < 3))


@pytest.mark.deep
def test_influences_are_refits_to_first_order(fitted):
    quick = intervals.block_bootstrap(fitted, jax.random.key(1), 100)
    exact = intervals.block_bootstrap(fitted, jax.random.key(1), 100, exact=True)
    width = np.asarray(quick[1] - quick[0])
    np.testing.assert_array_less(np.abs(np.asarray(exact[0] - quick[0])), 0.25 * width)
    np.testing.assert_array_less(np.abs(np.asarray(exact[1] - quick[1])), 0.25 * width)


@pytest.mark.deep
def test_white_noise_has_the_classical_cut():
    """On average over data sets: in each the noise is estimated, slow noise included."""
    ratios = []
    for seed in range(3, 7):
        fitted = fit(foam_tests(noise=0.01, hold=0.5, seed=seed), Sampled())
        m, p = sum(c.time.size for c in fitted.curves), 4
        assert [int(part.order) for part in residual_noise.noise(fitted)] == [0, 0]
        classical = student.ppf(0.975, m - p) ** 2 * float(fitted.solution.cost)
        ratios.append(np.asarray(intervals.spread(fitted).cut) * m / classical)
    # Two curves of different length have weights of their own, so that the classical cut is met to first order.
    assert np.mean(ratios, axis=0) == pytest.approx(np.ones(4), rel=0.6)


@pytest.mark.deep
def test_what_differs_between_repeats_is_in_the_interval():
    """Positions held an unknown part of a count beside where they are said to be: no residual shows it."""
    truth, rng, inside = FOSLS(*FOAM).dc_gain(), np.random.default_rng(0), 0
    tests = foam_tests(16, noise=1e-3, hold=0.3)
    for _ in range(30):
        scales = 1 + 1e-3 * rng.standard_normal((2, 16, 1))
        moved = [Test(t.kind, t.time, t.output * s, t.input) for t, s in zip(tests, scales, strict=True)]
        fitted = fit(moved, Sampled())
        half = 2.04 * np.sqrt(intervals.spread(fitted).covariance[1, 1])  # Student's, of 30 degrees of freedom
        inside += abs(float(fitted.q[1] - truth)) <= half
    assert inside >= 26


@pytest.mark.deep
def test_what_the_data_do_not_tell_has_an_open_end():
    """Half a second of one slow test: κ and α cannot be told apart from a slower, weaker branch."""
    fitted = fit(foam_tests(noise=0.3, hold=0.1, seed=5), Sampled())
    sides = intervals.profile_intervals(fitted)
    assert np.any(sides.open_lower | sides.open_upper | ~sides.bracketed)


def test_too_few_repeats_have_no_bootstrap():
    model, tests = Sampled(), foam_tests(repeats=4, hold=0.1)
    curves, weights = tuple(model.prepare(t) for t in tests), (jnp.ones(4) / 4, jnp.ones(4) / 4)
    q, nothing = jnp.zeros(4), jnp.asarray(0)
    solution = Solution(q, jnp.asarray(0.0), jnp.eye(4), q, nothing, nothing > 0)
    fitted = Fit(model, curves, solution, q, q, weights)
    with pytest.raises(InputError, match="has 4 repeats"):
        intervals.block_bootstrap(fitted, jax.random.key(0))
