"""The excess hazard phi(z)/Q(z) - z against mpmath, and its Chebyshev coefficients computed again."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mpmath import mp

from hilbo.numerics import normal


def exact_excess_hazard(z, digits=40):
    """phi(z)/Q(z) - z as an mpf; the subtraction cancels 2 log10(z) digits, which are added beforehand."""
    with mp.workdps(digits + 30):
        z = mp.mpf(z)
        return mp.npdf(z) / (mp.erfc(z / mp.sqrt(2)) / 2) - z


def relative_errors(hazards, points):
    pairs = zip(map(float, hazards), map(float, points), strict=True)
    return [abs(float(v / exact_excess_hazard(z) - 1)) for v, z in pairs]


POINTS = np.concatenate([[0.0, 1e-300, 1e-8, 4.0], np.linspace(0, 50, 301), np.logspace(-3, 7, 100)])


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_excess_hazard_against_mpmath(dtype):
    points = POINTS.astype(dtype)
    hazards = jax.jit(normal.excess_hazard)(jnp.asarray(points))
    assert hazards.dtype == dtype
    assert max(relative_errors(hazards, points)) < 4 * np.finfo(dtype).eps


def test_at_infinity_it_vanishes():
    assert normal.excess_hazard(jnp.array([jnp.inf])) == 0.0


def test_it_falls_like_one_over_z():
    z = jnp.asarray(np.logspace(3, 15, 13))
    np.testing.assert_allclose(normal.excess_hazard(z) * z, 1.0, rtol=2.1e-6)
    assert np.all(np.diff(normal.excess_hazard(jnp.asarray(POINTS[4:305]))) < 0)


def test_coefficients_computed_again():
    """(z + 1) (phi/Q - z) as a series in t = (z - 4)/(z + 4), by its values at 64 Chebyshev nodes."""
    with mp.workdps(40):
        angles = [mp.pi * (j + mp.mpf("0.5")) / 64 for j in range(64)]
        z = [4 * (1 + mp.cos(angle)) / (1 - mp.cos(angle)) for angle in angles]
        values = [(s + 1) * exact_excess_hazard(s) for s in z]
        series = [mp.fsum(v * mp.cos(k * a) for v, a in zip(values, angles, strict=True)) / 32 for k in range(64)]
        series[0] /= 2
    stored = normal._EXCESS_HAZARD
    np.testing.assert_allclose(stored, np.array(series[: len(stored)], float), rtol=0, atol=3e-17)
    assert float(mp.fsum(map(abs, series[len(stored) :]))) < 3e-17  # what is cut off is below rounding


def test_half_log_2pi():
    assert float(mp.log(2 * mp.pi) / 2) == normal.HALF_LOG_2PI
