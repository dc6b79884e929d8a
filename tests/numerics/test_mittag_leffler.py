"""Mittag-Leffler functions against series, asymptotic series and quadrature by mpmath."""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from helpers import check_grad
from scipy.special import erfcx

from hilbo.numerics.mittag_leffler import mittag_leffler, mittag_leffler_increment, mittag_leffler_two


def by_series(a, b, z):
    """Power series; needs about z^(1/a) digits."""
    size = float(z) ** (1 / a)
    with mp.workdps(30 + int(0.5 * size)):
        a, b, z = map(mp.mpf, (a, b, z))
        total, power = mp.mpf(0), mp.mpf(1)
        for k in range(int(40 + 6 * size / float(a) + 60 / float(a))):
            total += power * mp.rgamma(a * k + b)
            power *= -z
        return float(total)


def by_asymptotics(a, b, z):
    """Σ (-1)^(k+1) z^(-k)/Γ(b - ak) up to its smallest term, and that term."""
    with mp.workdps(30):
        total, least = mp.mpf(0), mp.inf
        for k in range(1, 400):
            term = -((-mp.mpf(z)) ** -k) * mp.rgamma(mp.mpf(b) - mp.mpf(a) * k)
            size = mp.mpf(z) ** -k * abs(mp.gamma(mp.mpf(a) * k))
            if size > least:
                break
            least, total = size, total + term
        return float(total), float(least)


def by_quadrature(a, b, z):
    """The spectral integral of t^(b-1)·E_{a,b}(-t^a) with z put in, in logarithmic frequency."""
    with mp.workdps(30):
        a, b, z = map(mp.mpf, (a, b, z))
        top, bottom = mp.sin(mp.pi * (b - a)) * z, mp.sin(mp.pi * b)

        def density(x):
            power = mp.exp(a * x)
            return (
                mp.exp((a - b + 1) * x - mp.exp(x))
                * (top + power * bottom)
                / (power**2 + 2 * z * power * mp.cos(mp.pi * a) + z**2)
            )

        knee, narrow, low = mp.log(z) / a, 1 - a, -75 / (a - b + 1)
        points = [low, low / 2, low / 4, low / 16, -60, -20, -5, 0, 2, 5]
        points += [knee + s * w for s in (-1, 1) for w in (0, narrow, 10 * narrow, 1 / a, 5 / a)]
        return float(mp.quad(density, sorted({p for p in points if low <= p <= 5})) / mp.pi)


def exact(a, b, z):
    if a == 1 and b == 1:
        return float(mp.exp(-z))
    if b == 1:
        total, least = by_asymptotics(a, b, z)
        if least < 1e-14:
            return total
    return by_series(a, b, z) if a > 0.05 and z ** (1 / a) <= 40 else by_quadrature(a, b, z)


def test_the_oracles_overlap():
    for a, z in ((0.3, 1.5), (0.6, 4.0), (0.9, 20.0)):
        assert by_series(a, 1.0, z) == pytest.approx(by_quadrature(a, 1.0, z), abs=1e-14)
    for a, z in ((0.3, 1e4), (0.6, 1e5), (0.95, 3e3)):
        assert by_asymptotics(a, 1.0, z)[0] == pytest.approx(by_quadrature(a, 1.0, z), abs=1e-14)


def largest_error(orders, arguments):
    a, z = (grid.ravel() for grid in np.meshgrid(orders, arguments))
    values = np.asarray(mittag_leffler(a, z))
    return np.max(np.abs(values - [exact(*pair) for pair in zip(a, np.ones_like(a), z, strict=True)]))


def test_E_alpha_at_both_ends_and_between():
    assert largest_error([0.01, 0.3, 2 / 3, 0.95, 0.999, 1.0], [1e-6, 0.1, 1.0, 7.0, 3.2e8]) <= 1e-12


@pytest.mark.deep
def test_E_alpha_over_all_that_the_search_box_needs():
    """z = (K1/B1)·t^α up to 32/0.001·(1e4)^α."""
    for alpha in (0.01, 0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.68, 0.75, 0.85, 0.93, 0.97, 0.985, 0.99, 0.997, 1.0):
        largest = 32_000 * 1e4**alpha
        assert largest_error([alpha], np.geomspace(1e-6, largest, 40)) <= 1e-10


def test_half_order_is_an_error_function():
    z = np.geomspace(1e-9, 1e6, 60)
    np.testing.assert_allclose(mittag_leffler(0.5, z), erfcx(z), rtol=1e-12)


@pytest.mark.parametrize(
    ("a", "b"),
    [
        (0.05, 0.5),
        (0.5644, 0.8899),
        (0.97, 0.99),
        *(pytest.param(*orders, marks=pytest.mark.deep) for orders in ((0.8, 0.95), (0.01, 0.99), (0.5, 0.5))),
    ],
)
def test_two_parameters(a, b):
    z = np.array([1e-3, 0.1, 1.0, 30.0, 1e5])
    np.testing.assert_allclose(mittag_leffler_two(a, b, z), [exact(a, b, v) for v in z], atol=1e-11)


def test_b_one_is_the_one_parameter_function():
    z = np.geomspace(1e-4, 1e6, 30)
    for a in (0.02, 0.7, 1.0):
        np.testing.assert_allclose(mittag_leffler_two(a, 1.0, z), mittag_leffler(a, z), atol=2e-12)


def test_values_and_slopes_at_zero():
    gammas = [float(mp.rgamma(b)) for b in (0.3, 1.0)]
    np.testing.assert_allclose(mittag_leffler_two(0.2, np.array([0.3, 1.0]), 0.0), gammas, rtol=1e-13)
    assert mittag_leffler(0.2, 0.0) == 1
    assert mittag_leffler_increment(0.2, 0.0) == pytest.approx(float(mp.rgamma(1.2)), rel=1e-13)


def test_increment_has_no_seam():
    for alpha in (0.01, 0.4, 1.0):
        z = np.array([1e-12, 1e-4, 0.029999, 0.030001, 1.0])
        with mp.workdps(30):
            a = mp.mpf(alpha)
            expected = [
                float(mp.nsum(lambda k, a=a, v=v: (-mp.mpf(v)) ** k * mp.rgamma(1 + a * (k + 1)), [0, mp.inf]))
                for v in z[:4]
            ]
        np.testing.assert_allclose(mittag_leffler_increment(alpha, z)[:4], expected, rtol=1e-10)
        assert mittag_leffler_increment(alpha, 1.0) == pytest.approx(1 - float(mittag_leffler(alpha, 1.0)))


def test_derivatives():
    z = np.array([0.01, 1.0, 40.0])
    for alpha in (0.05, 2 / 3, 0.98):
        check_grad(jax.jit(mittag_leffler), np.array(alpha), z, rtol=1e-6)
    check_grad(jax.jit(mittag_leffler_two), np.array(0.56), np.array(0.89), z, rtol=1e-6)
    assert jax.grad(mittag_leffler, 1)(1.0, 2.0) == pytest.approx(-np.exp(-2), abs=1e-13)


def test_single_precision():
    z = np.geomspace(1e-3, 1e6, 50, dtype=np.float32)
    for alpha in (0.05, 0.5, 0.95, 1.0):
        single = mittag_leffler(np.float32(alpha), z)
        assert single.dtype == jnp.float32
        np.testing.assert_allclose(single, mittag_leffler(float(np.float32(alpha)), z.astype(float)), atol=2e-5)
