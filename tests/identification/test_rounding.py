"""Rounding of a channel: its step, its covariance, and intervals that contain what a held position hides."""

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import identification_coverage as study
from hilbo.identification.fitting import Curve, Test, fit
from hilbo.identification.intervals import spread
from hilbo.identification.recorded import local_line
from hilbo.identification.rounding import Rounding, rounding, variance_of_rounding
from hilbo.identification.sampled import Sampled

STEP = 0.01
STILL = np.ones(400, bool)


def held(noise, step=STEP):
    """Two repeats at places of their own, rounded."""
    rng = np.random.default_rng(0)
    values = np.array([[1.2341], [1.3077]]) + noise * rng.standard_normal((2, STILL.size))
    return np.round(values / step) * step


def test_the_step_is_found_and_its_errors_have_the_size_of_a_uniform_one():
    path = np.concatenate([np.linspace(0, 1, 20), 1 + 0.3 * np.linspace(0, 1, 400)])[None]
    found = rounding(np.round(path / STEP * 2) * STEP / 2, np.arange(420) > 30)
    assert found is not None
    assert np.sum(np.square(found.sizes)) == pytest.approx((STEP / 2) ** 2 / 12, rel=0.2)
    assert np.ptp(found.turns) == pytest.approx(2 * 1.3 / STEP, abs=1)


@pytest.mark.parametrize("rows", [2, 20, 1000])
def test_a_programmed_input_is_not_rounded(rows):
    path = np.concatenate([np.linspace(0, 5, rows), np.full(400, 5.0)])[None]
    assert rounding(path, np.zeros(path.size, bool)) is None


@pytest.mark.parametrize("noise", [1.0, 2.0])
def test_noise_above_the_step_leaves_none(noise):
    assert rounding(held(noise * STEP), STILL) is None


def test_numbers_that_are_not_rounded_have_none():
    assert rounding(held(0.1, step=1e-12), STILL) is None


def test_the_variance_is_that_of_the_matrix():
    rng = np.random.default_rng(1)
    m, turns = 60, np.cumsum(rng.uniform(0, 0.4, (2, 60)), axis=1)
    sizes, slopes, weights = np.array([0.3, 0.1]), rng.standard_normal((m, 3)), np.array([0.25, 0.75])
    curve = Curve("modulus", jnp.arange(60.0), jnp.zeros((2, m)), jnp.zeros(2), jnp.full(m, 2.0))
    errors = Rounding(jnp.asarray(turns), jnp.asarray(sizes))
    curve = Curve(*(getattr(curve, n) for n in ("kind", "time", "output", "offset", "scale")), rounded_output=errors)
    found = variance_of_rounding(None, jnp.zeros(3), curve, jnp.asarray(weights), jnp.asarray(slopes))
    expected = np.zeros((3, 3))
    for w, path in zip(weights, turns, strict=True):
        apart = 2 * np.pi * (path[:, None] - path[None, :])
        cov = sum(s**2 * np.cos((h + 1) * apart) for h, s in enumerate(sizes))
        expected += w**2 * slopes.T @ cov @ slopes / (4 * m)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9)


def test_a_local_line_keeps_lines_up_to_their_ends():
    line = np.linspace(0, 3, 40)[None]
    chosen = np.ones(40, bool)
    chosen[15:24] = False
    np.testing.assert_allclose(local_line(line, chosen), line, atol=1e-12)


@pytest.mark.deep
def test_the_interval_contains_where_an_encoder_rounds_one_held_position_to():
    case, inside = study.Case("", repeats=1), 0
    truth = study.truth_of(case)["K_eff"]
    rng = np.random.default_rng(2)
    for number in range(20):
        tests, size = [], 1 + 0.01 * rng.random()
        for kind, t, x, F in study.records(case, number, 0.5):
            x = np.round(size * x / STEP) * STEP
            tests.append(Test(kind, t, *((size * F, x) if kind == "relaxation" else (x, size * F))))
        found = fit(tests, Sampled())
        inside += abs(float(found.q[1]) - truth) < 1.96 * np.sqrt(spread(found).covariance[1, 1])
    assert inside >= 17
