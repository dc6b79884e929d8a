"""The closed forms of the FO-SLS against gamma functions, complex arithmetic and the numbers of the paper."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hilbo import viscoelastic

SETS = {  # K0, K1, B1, alpha as printed in the paper
    "system identification": (-2.89, 5.70, 5.89, 0.203),
    "aggregate": (-3.18, 5.58, 7.88, 0.176),
    "average": (-5.01, 8.44, 10.28, 0.282),
}
orders = st.floats(0.01, 0.99)
memories = st.sampled_from([1, 2, 25, 101])  # each is compiled


def exact_coefficients(alpha, N):
    return [(-1) ** i * mpmath.binomial(mpmath.mpf(alpha), i) for i in range(N + 1)]


@settings(deadline=None, max_examples=30)
@given(orders, memories)
def test_coefficients_are_signed_binomials(alpha, N):
    expected = np.array(exact_coefficients(alpha, N), float)
    np.testing.assert_allclose(viscoelastic.gl_coefficients(alpha, N), expected, rtol=1e-13)


def test_coefficients_of_several_orders_by_vmap():
    alphas = jnp.array([0.1, 0.5, 0.9])
    rows = jax.vmap(lambda alpha: viscoelastic.gl_coefficients(alpha, 7))(alphas)
    np.testing.assert_array_equal(rows, np.stack([viscoelastic.gl_coefficients(float(a), 7) for a in alphas]))


@pytest.mark.parametrize("alpha", [1e-12, 0.01, 0.176, 0.5, 0.99, 1 - 1e-9])
@pytest.mark.parametrize("N", [1, 2, 100, 101])
def test_sums_keep_their_digits_at_both_ends(alpha, N):
    with mpmath.workdps(40):
        c = exact_coefficients(alpha, N)
        at_dc, at_nyquist = mpmath.fsum(c), mpmath.fsum((-1) ** i * x for i, x in enumerate(c))
        exact = [at_dc, at_nyquist, at_nyquist - at_dc, -mpmath.fsum(i * x for i, x in enumerate(c))]
    sums = viscoelastic.gl_sums(alpha, N)
    computed = [sums.at_dc, sums.at_nyquist, sums.spread, sums.moment]
    np.testing.assert_allclose(computed, np.array(exact, float), rtol=1e-13)
    np.testing.assert_allclose(viscoelastic.gl_sum(alpha, N), sums.at_dc)
    np.testing.assert_allclose(viscoelastic.gl_alternating_sum(alpha, N), sums.at_nyquist)


@settings(deadline=None, max_examples=30)
@given(orders, memories)
def test_sum_and_moment_are_ratios_of_gamma_functions(alpha, N):
    sums, g = viscoelastic.gl_sums(alpha, N), mpmath.gamma
    S = g(N + 1 - alpha) / (g(1 - alpha) * g(N + 1))
    M = alpha * g(N + 1 - alpha) / (g(2 - alpha) * g(N))
    np.testing.assert_allclose([sums.at_dc, sums.moment], [float(S), float(M)], rtol=1e-12)


def test_alternating_sum_is_close_to_the_power_of_two():
    alpha = np.linspace(0.01, 0.99, 99)
    assert np.abs(viscoelastic.gl_alternating_sum(alpha, 101) - 2**alpha).max() <= 3.4e-4


@pytest.mark.parametrize(("name", "gain"), list(zip(SETS, (0.44325, 0.44616, 0.44586), strict=True)))
def test_static_stiffness_of_the_published_sets(name, gain):
    assert viscoelastic.dc_gain(*SETS[name]) == pytest.approx(gain, abs=5e-6)


def test_K0_at_the_corner_of_the_box():
    assert viscoelastic.K0_from_effective_stiffness(32, 32, 0.01) == pytest.approx(-15.696, abs=5e-4)


@pytest.mark.parametrize(("name", "damping"), [("system identification", 35.6), ("aggregate", 27.4)])
def test_effective_damping_of_the_published_sets(name, damping):
    assert viscoelastic.effective_damping(*SETS[name][1:]) == pytest.approx(damping, abs=0.05)


@settings(deadline=None, max_examples=30)
@given(st.floats(1, 32), st.floats(0.001, 32), orders, memories, st.floats(1e-4, 1e-2))
def test_K0_gives_the_static_stiffness_asked_for(K1, B1, alpha, N, T):
    K0 = viscoelastic.K0_from_effective_stiffness(K1, B1, alpha, 0.44, N, T)
    assert viscoelastic.dc_gain(K0, K1, B1, alpha, N, T) == pytest.approx(0.44, abs=1e-13)


@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize(("N", "T"), [(101, 1e-3), (24, 5e-4)])
def test_effective_damping_is_the_slope_of_the_response_at_rest(name, N, T):
    K0, K1, B1, alpha = SETS[name]
    c = viscoelastic.gl_coefficients(alpha, N)

    def response(s):
        pot = B1 * T**-alpha * jnp.sum(c * jnp.exp(-s * T * jnp.arange(N + 1.0)))
        return K0 + K1 * pot / (K1 + pot)

    slope = 1000 * jax.grad(response)(0.0)  # N/mm·s -> N·s/m
    assert viscoelastic.effective_damping(K1, B1, alpha, N, T) == pytest.approx(float(slope), rel=1e-12)


def test_arguments_broadcast_and_transform():
    B1, alpha = jnp.array([[0.5], [7.88]]), jnp.array([[0.1, 0.5, 0.9]])
    f = viscoelastic.K0_from_effective_stiffness
    table = f(5.58, B1, alpha)
    assert table.shape == (2, 3)
    np.testing.assert_allclose(table[1, 2], f(5.58, 7.88, 0.9), rtol=1e-14)
    np.testing.assert_allclose(jax.jit(f)(5.58, B1, alpha), table, rtol=1e-14)
    np.testing.assert_allclose(jax.vmap(f, (None, 0, None))(5.58, B1[:, 0], 0.9), table[:, 2], rtol=1e-14)


def test_single_precision_stays_single_and_close():
    alpha = np.linspace(0.01, 0.99, 50, dtype=np.float32)
    K1, B1 = np.float32(5.58), np.float32(7.88)
    single = viscoelastic.K0_from_effective_stiffness(K1, B1, alpha)
    assert single.dtype == jnp.float32
    exact = viscoelastic.K0_from_effective_stiffness(float(K1), float(B1), alpha.astype(float))
    np.testing.assert_allclose(single, exact, rtol=0, atol=2e-5)


@pytest.mark.parametrize("argument", range(3))
def test_gradients_match_finite_differences(argument):
    point = list(SETS["aggregate"][1:])
    for f in (viscoelastic.K0_from_effective_stiffness, viscoelastic.effective_damping):

        def along(x, f=f):
            return f(*point[:argument], x, *point[argument + 1 :])

        h = 1e-5 * point[argument]
        difference = (along(point[argument] + h) - along(point[argument] - h)) / (2 * h)
        assert jax.grad(along)(point[argument]) == pytest.approx(float(difference), rel=1e-7)


@pytest.mark.parametrize("alpha", [0.01, 0.3, 1.0])
def test_full_memory_has_the_gains_of_the_fractional_power(alpha):
    assert viscoelastic.dc_gain(0.44, 5.7, 5.89, alpha, memory="full") == 0.44
    assert viscoelastic.K0_from_effective_stiffness(5.7, 5.89, alpha, memory="full") == 0.44
    assert viscoelastic.effective_damping(5.7, 5.89, 1.0, memory="full") == pytest.approx(5890)


def test_a_memory_that_cannot_be_is_refused():
    with pytest.raises(ValueError, match="at least 1"):
        viscoelastic.gl_sum(0.5, 0)
    with pytest.raises(ValueError, match="one of 8, 10, 12"):
        viscoelastic.effective_damping(1.0, 1.0, 0.5, memory="full", states=9)
