"""The sum of exponentials against infinite Grünwald-Letnikov memory, and what it keeps exactly."""

import importlib

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from helpers import check_grad

from hilbo.mechanics.exponentials import exponentials
from hilbo.mechanics.memory import gl_coefficients, gl_sums, response, sums
from hilbo.mechanics.span import STATES, span
from hilbo.viscoelastic import FOSLS, creep_load, relaxation_load

ORDERS = np.concatenate([[1e-6, 1e-3], np.linspace(0.01, 0.99, 50), [0.999, 1 - 1e-6, 1.0]])


@pytest.mark.parametrize("states", STATES)
def test_what_the_exponentials_keep_exactly(states):
    weight, loss = map(np.asarray, jax.vmap(lambda alpha: exponentials(alpha, states))(jnp.asarray(ORDERS)))
    assert weight.min() >= 0 and loss.min() > 0 and loss.max() <= 1
    assert np.all(np.diff(loss, axis=1) < 0)
    np.testing.assert_allclose(weight.sum(axis=1), 1, rtol=1e-15)
    np.testing.assert_allclose((weight * 2 / (2 - loss)).sum(axis=1), 2**ORDERS, rtol=1e-14)


@pytest.mark.parametrize(("states", "bound"), [(8, 2e-3), (10, 2e-4), (12, 2e-5)])
def test_partial_sums_for_ten_seconds(states, bound):
    n = np.unique(np.geomspace(1, 10_000, 300).astype(int))
    for alpha in ORDERS[2:-3:7]:
        weight, loss = map(np.asarray, exponentials(jnp.asarray(alpha), states))
        exact = np.cumprod(1 - alpha / np.arange(1, 10_001))[n - 1]
        assert np.abs((1 - loss) ** n[:, None] @ weight - exact).max() <= bound


def test_ends_of_the_range_of_orders():
    weight, loss = exponentials(jnp.asarray(1.0))
    assert weight[0] == 1 and loss[0] == 1 and not np.any(weight[1:])
    weight, loss = exponentials(jnp.asarray(1e-12))
    assert weight[-1] == pytest.approx(1) and loss[-1] < 1e-12


def test_the_quadrature_is_differentiable():
    for alpha in (0.05, 0.5, 0.97):
        check_grad(jax.jit(lambda a: jnp.stack(exponentials(a)).ravel()), np.array(alpha), rtol=1e-6)


def test_sums_are_those_of_the_response():
    for memory in (span("short", 7), span("full", 101)):
        summed = sums(0.3, memory)
        at = response(0.3, jnp.array([0.0, 1e-7, jnp.pi]), memory)
        np.testing.assert_allclose(at[jnp.array([0, 2])], [summed.at_dc, summed.at_nyquist], atol=1e-14)
        assert at[1].imag / 1e-7 == pytest.approx(float(summed.moment), rel=1e-4 if memory.memory == "full" else 1e-8)


def test_derivatives_of_the_sums_are_those_of_their_polynomials():
    """The sums are polynomials in alpha; their derivatives of first and second order, along several directions."""
    alpha, N = mp.mpf("0.203"), 7

    def exact(order):
        def c(i):
            return lambda a: mp.binomial(a, i) * (-1) ** i

        with mp.workdps(40):
            return [float(sum(w(i) * mp.diff(c(i), alpha, order) for i in range(N + 1))) for w in WEIGHTS]

    def ours(a):
        summed = gl_sums(a, N)
        return jnp.stack([summed.at_dc, summed.at_nyquist, summed.spread, summed.moment])

    for derivative, order in ((jax.jacfwd, 1), (jax.jacrev, 1), (lambda f: jax.jacfwd(jax.jacrev(f)), 2)):
        np.testing.assert_allclose(jax.jit(derivative(ours))(0.203), exact(order), rtol=1e-12)
    mixed = jax.jit(jax.hessian(lambda w: gl_sums(w[0] * w[1], N).spread))(jnp.array([0.406, 0.5]))
    first, second = exact(1)[2], exact(2)[2]
    np.testing.assert_allclose(
        mixed, [[0.25 * second, first + 0.203 * second], [first + 0.203 * second, 0.406**2 * second]]
    )


WEIGHTS = (lambda i: 1, lambda i: (-1) ** i, lambda i: (-1) ** i - 1, lambda i: -i)

# Corners and centre of the search box: (K1, B1).
CASES = jnp.array([(1.0, 0.001), (1.0, 32.0), (32.0, 0.001), (32.0, 32.0), (16.5, 16.0005)])


@jax.jit
def _responses(alpha):
    """Force in relaxation and position in creep: all of the past, and 8 and 10 exponentials."""

    def each(K1, B1):
        def both(**memory):
            model = FOSLS(0.44, K1, B1, alpha, **memory)
            return model.simulate(relaxation_load()), model.simulate_force(creep_load())

        return both(N=6000), both(memory="full", states=8), both(memory="full", states=10)

    return jax.lax.map(lambda case: each(*case), CASES)


def worst_errors(alphas):
    worst = {8: 0.0, 10: 0.0}
    for alpha in alphas:
        exact, *approximations = _responses(alpha)
        for states, approximation in zip(worst, approximations, strict=True):
            for a, b in zip(exact, approximation, strict=True):
                a, b = np.asarray(a), np.asarray(b)
                worst[states] = max(worst[states], np.max(np.abs(a - b).max(axis=1) / np.abs(a).max(axis=1)))
    return worst


@pytest.mark.deep
def test_error_of_the_exponentials_over_all_orders():
    worst = worst_errors(np.linspace(0.01, 0.99, 50))
    print(worst)
    assert worst[8] <= 6e-4 and worst[10] <= 4e-5  # asked for: 1e-3 and 1e-4


def test_error_of_the_exponentials():
    worst = worst_errors([0.6])
    assert worst[8] <= 6e-4 and worst[10] <= 4e-5


@pytest.mark.deep
def test_the_table_can_be_made_again():
    make = importlib.import_module("benchmarks.exponentials")
    from hilbo.mechanics import exponentials as module

    np.testing.assert_allclose(make.table(8, 8), module.TABLE[8], atol=1e-4)


def test_taps_are_differences_of_partial_sums():
    c = np.asarray(gl_coefficients(0.3, 50))
    np.testing.assert_allclose(np.cumsum(c), np.concatenate([[1], np.cumprod(1 - 0.3 / np.arange(1, 51))]), rtol=1e-12)
