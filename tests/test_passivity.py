"""The closed passivity bounds against the frequency response, the numbers of the paper, and each other."""

import jax
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.stats import qmc

from hilbo import passivity, viscoelastic

SETS = ((-2.89, 5.70, 5.89, 0.203), (-3.18, 5.58, 7.88, 0.176), (-5.01, 8.44, 10.28, 0.282))
B1s, orders = st.floats(0.001, 32), st.floats(0.01, 0.99)


@pytest.mark.parametrize(("printed", "damping"), list(zip(SETS, (0.91664, 0.76288, 1.34452), strict=True)))
def test_damping_of_the_published_sets_with_their_printed_K0(printed, damping):
    K_eff = viscoelastic.dc_gain(*printed)
    assert passivity.minimum_damping(*printed[1:], K_eff) == pytest.approx(damping, abs=5e-6)


@pytest.mark.parametrize(("printed", "damping"), list(zip(SETS, (0.91502, 0.75981, 1.34159), strict=True)))
def test_damping_of_the_published_sets_with_K_eff(printed, damping):
    assert passivity.minimum_damping(*printed[1:]) == pytest.approx(damping, abs=5e-6)


@pytest.mark.parametrize(("b", "K1"), [(0.836, 6.102), (0.9165, 6.643), (0.95, 6.867), (1.0, 7.198)])
def test_largest_K1_at_the_aggregate_optimum(b, K1):
    assert passivity.largest_K1(7.88, 0.176, b) == pytest.approx(K1, abs=5e-4)


@pytest.mark.parametrize(("b", "share"), [(0.5, 12.3), (0.917, 23.3), (0.95, 24.1), (1, 25.1), (2, 42.2), (5, 73.7)])
def test_passive_share_of_the_box(b, share):
    K1, B1, alpha = qmc.scale(qmc.Sobol(3, rng=0).random(2**15), (1, 0.001, 0.01), (32, 32, 0.99)).T
    passive = passivity.minimum_damping(K1, B1, alpha) <= b
    assert 100 * np.mean(passive) == pytest.approx(share, abs=0.2)
    np.testing.assert_array_equal(passive, passivity.largest_K1(B1, alpha, b) >= K1)


@pytest.mark.parametrize("N", [1, 25, 101])
@pytest.mark.parametrize("T", [1e-3, 2e-4])
def test_nyquist_binds_among_all_frequencies(N, T):
    rng = np.random.default_rng(N)
    angle = np.linspace(1e-3, np.pi, 4001)
    z = np.exp(-1j * np.outer(angle, np.arange(N + 1)))
    for K1, B1, alpha in rng.uniform((1, 0.001, 0.01), (32, 32, 0.99), (20, 3)):
        pot = B1 * T**-alpha * (z @ np.asarray(viscoelastic.gl_coefficients(alpha, N)))
        K0 = float(viscoelastic.K0_from_effective_stiffness(K1, B1, alpha, 0.44, N, T))
        response = K0 + K1 * pot / (K1 + pot)
        needed = 1000 * T / 2 / (1 - np.cos(angle)) * ((1 - np.exp(-1j * angle)) * response).real
        bound = passivity.minimum_damping(K1, B1, alpha, 0.44, N, T)
        assert needed.max() == pytest.approx(float(bound), rel=1e-12)


@settings(deadline=None)
@given(B1s, orders, st.floats(0.23, 40), st.sampled_from([1, 25, 101]), st.floats(1e-4, 2e-3))
def test_each_bound_is_the_inverse_of_the_other(B1, alpha, b, N, T):
    K1 = passivity.largest_K1(B1, alpha, b, 0.44, N, T)
    assume(0 < K1 < np.inf)
    assert passivity.minimum_damping(K1, B1, alpha, 0.44, N, T) == pytest.approx(b, rel=1e-10)


@settings(deadline=None)
@given(st.floats(0.1, 32), st.floats(0.1, 32), orders)
def test_single_precision_keeps_six_digits_of_the_damping(K1, B1, alpha):
    K1, B1, alpha = np.float32(K1), np.float32(B1), np.float32(alpha)
    single = passivity.minimum_damping(K1, B1, alpha)
    assert single.dtype == np.float32
    assert single == pytest.approx(float(passivity.minimum_damping(float(K1), float(B1), float(alpha))), rel=5e-6)
    limit = passivity.largest_K1(B1, alpha, np.float32(0.95))
    assert limit.dtype == np.float32
    if np.isfinite(limit):
        assert passivity.minimum_damping(limit, B1, alpha) == pytest.approx(0.95, rel=5e-6)


def test_the_limit_grows_to_infinity_and_shrinks_to_nothing_without_a_jump():
    unlimited = float(passivity.minimum_damping(1e300, 7.88, 0.176))
    below = passivity.largest_K1(7.88, 0.176, unlimited * (1 - np.array([1e-3, 1e-6, 1e-9, 1e-12])))
    assert np.all(np.diff(below) > 0)
    np.testing.assert_allclose(below[1:] / below[:-1], 1e3, rtol=2e-3)
    assert passivity.largest_K1(7.88, 0.176, unlimited * (1 + 1e-12)) == np.inf
    above = passivity.largest_K1(7.88, 0.176, 0.22 * (1 + np.array([1e-12, 1e-9, 1e-6])))
    assert np.all((above > 0) & (above < 1e-2)) and np.all(np.diff(above) > 0)


@pytest.mark.parametrize("b", [0.1, 0.22])
def test_nothing_is_passive_without_room_above_the_effective_stiffness(b):
    assert passivity.largest_K1(7.88, 0.176, b) == 0


def test_a_negative_static_stiffness_is_never_passive():
    assert passivity.minimum_damping(5.0, 7.88, 0.176, K_eff=-0.01) == np.inf
    assert passivity.largest_K1(7.88, 0.176, 10.0, K_eff=-0.01) == 0


@pytest.mark.parametrize("argument", range(3))
@pytest.mark.parametrize("f", [passivity.minimum_damping, passivity.largest_K1])
def test_gradients_match_finite_differences(f, argument):
    point = [5.58, 7.88, 0.176] if f is passivity.minimum_damping else [7.88, 0.176, 0.95]

    def along(x):
        return f(*point[:argument], x, *point[argument + 1 :])

    h = 1e-5 * point[argument]
    difference = (along(point[argument] + h) - along(point[argument] - h)) / (2 * h)
    assert jax.grad(along)(point[argument]) == pytest.approx(float(difference), rel=1e-7)


@pytest.mark.parametrize("b", [0.1, 0.22, 40.0])
def test_gradients_are_zero_where_the_limit_is_infinite_or_nothing(b):
    assert jax.grad(passivity.largest_K1, (0, 1, 2))(7.88, 0.176, b) == (0, 0, 0)


@pytest.mark.parametrize("call", [passivity.minimum_damping, passivity.largest_K1])
def test_even_N_and_full_memory_are_refused(call):
    with pytest.raises(ValueError, match="odd"):
        call(1.0, 1.0, 0.5, N=100)
    with pytest.raises(NotImplementedError, match="full"):
        call(1.0, 1.0, 0.5, memory="full")
