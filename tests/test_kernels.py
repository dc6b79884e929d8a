"""The covariances against their formulas in mpmath; gram matrices, dtypes and derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mpmath import mp

from hilbo.kernels import RBF, Matern32, gram

rng = np.random.default_rng(3)
X, Y = rng.random((7, 3)), rng.random((5, 3))
THETAS = [30.0, 1e-2, (4.0, 9.0, 2.5)]


def matern32(squared):
    root = mp.sqrt(6 * squared)
    return (1 + root) * mp.exp(-root)


CORRELATION = {RBF: lambda squared: mp.exp(-squared), Matern32: matern32}


def exact(kernel, x, y, theta, variance):
    thetas = np.broadcast_to(theta, x.shape)
    with mp.workdps(40):
        triples = (map(mp.mpf, map(float, triple)) for triple in zip(thetas, x, y, strict=True))
        squares = [t * (a - b) ** 2 for t, a, b in triples]
        return float(mp.mpf(float(variance)) * CORRELATION[kernel](mp.fsum(squares)))


@pytest.mark.parametrize("theta", THETAS)
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("kernel", CORRELATION)
def test_gram_against_mpmath(kernel, theta, dtype):
    x, y, scale = X.astype(dtype), Y.astype(dtype), np.asarray(theta, dtype)
    matrix = gram(kernel(scale, dtype(1.7)), jnp.asarray(x), jnp.asarray(y))
    expected = [[exact(kernel, p, r, scale, dtype(1.7)) for r in y] for p in x]
    assert matrix.dtype == dtype
    np.testing.assert_allclose(matrix, expected, rtol=60 * np.finfo(dtype).eps)


@pytest.mark.parametrize("step", [0.0, 0.3])
def test_second_derivatives_of_the_matern_kernel_also_where_points_meet(step):
    """Against central differences of the gradient in closed form, -6 theta (x - y) exp(-s) times the variance; at one
    point they are -6 theta times the variance."""
    theta, x = jnp.array([4.0, 9.0]), jnp.array([0.2, 0.7])
    y, kernel = x + step, Matern32((4.0, 9.0), 1.7)

    def slope(x):
        s = np.sqrt(6.0 * np.sum(np.asarray(theta) * (x - np.asarray(y)) ** 2))
        return -6.0 * 1.7 * np.asarray(theta) * (x - np.asarray(y)) * np.exp(-s)

    h = 1e-6
    moved = [(slope(np.asarray(x) + h * unit) - slope(np.asarray(x) - h * unit)) / (2 * h) for unit in np.eye(2)]
    gradient, hessian = jax.jit(lambda x, y: (jax.grad(kernel)(x, y), jax.hessian(kernel)(x, y)))(x, y)
    np.testing.assert_allclose(gradient, slope(np.asarray(x)), atol=1e-13)
    np.testing.assert_allclose(hessian, moved, rtol=1e-4, atol=1e-4)


def test_near_points_keep_their_difference():
    """1 - k/variance = theta |x - y|^2 would be rounding if it were formed from |x|^2 + |y|^2 - 2xy."""
    x = jnp.array([0.7, 0.3, 0.9])
    y = x + jnp.array([1e-6, 0.0, 0.0])
    np.testing.assert_allclose(1.0 - RBF(1e4)(x, y), 1e4 * float(y[0] - x[0]) ** 2, rtol=2e-8)


@pytest.mark.parametrize("theta", THETAS)
def test_gram_of_repeated_points_is_symmetric_with_the_variance_on_the_diagonal(theta):
    x = jnp.asarray(np.concatenate([X, X[:2], X[:1]]))
    matrix = np.asarray(gram(RBF(theta, 2.5), x, x))
    np.testing.assert_array_equal(matrix, matrix.T)
    np.testing.assert_array_equal(np.diagonal(matrix), jax.vmap(RBF(theta, 2.5).diagonal)(x))
    np.testing.assert_array_equal(matrix[0], matrix[7])
    assert np.linalg.eigvalsh(matrix)[0] > -1e-14


def test_scalar_theta_is_the_same_theta_in_every_dimension():
    x, y = jnp.asarray(X), jnp.asarray(Y)
    np.testing.assert_array_equal(gram(RBF(3.0), x, y), gram(RBF((3.0, 3.0, 3.0)), x, y))


def test_a_theta_of_the_wrong_length_is_refused():
    with pytest.raises(ValueError, match="broadcast"):
        RBF((1.0, 2.0))(jnp.zeros(3), jnp.zeros(3))


@pytest.mark.parametrize("kernel", [RBF, Matern32])
def test_what_is_traced_and_no_kernel_has_gives_nan(kernel):
    """exp(+|x - y|^2) would be no covariance, and a search that runs there would not see it."""
    x, y = jnp.zeros(2), jnp.ones(2)
    of_theta = jax.jit(lambda theta: kernel(theta)(x, y))
    of_variance = jax.jit(lambda variance: (kernel(3.0, variance)(x, y), kernel(3.0, variance).diagonal(x)))
    assert np.isnan(of_theta(-0.01)) and np.isnan(of_theta(jnp.array([1.0, -0.5]))) and of_theta(0.0) == 1.0
    assert np.isnan(of_variance(-1.0)).all() and np.isfinite(of_variance(1.0)).all()
    assert np.isnan(jax.jit(lambda theta: RBF(theta).along(0, x, y))(-1.0)).all()


def test_gradients_are_those_of_the_formula():
    x, y, theta = jnp.asarray(X[0]), jnp.asarray(Y[0]), jnp.array([4.0, 9.0, 2.5])
    kernel = RBF(theta, 1.7)
    by_kernel, by_x = jax.grad(lambda k, x: k(x, y), argnums=(0, 1))(kernel, x)
    value = kernel(x, y)
    np.testing.assert_allclose(by_kernel.theta, -value * (x - y) ** 2, rtol=1e-14)
    np.testing.assert_allclose(by_kernel.variance, value / 1.7, rtol=1e-14)
    np.testing.assert_allclose(by_x, -2.0 * theta * (x - y) * value, rtol=1e-14)


def test_dtypes_of_the_hyperparameters():
    kernel = RBF((1.0, 2.0, 3.0), 2)
    assert kernel.theta.dtype == kernel.variance.dtype == jnp.float64
    assert RBF(np.float32(3.0)).theta.dtype == jnp.float32
    assert RBF(jnp.array([1, 2])).theta.dtype == jnp.float64


@settings(deadline=None, max_examples=40)
@given(st.floats(1e-2, 1e4), st.floats(1e-3, 1e4), st.integers(0, 10**6))
def test_gram_is_positive_semidefinite_up_to_rounding(theta, variance, seed):
    x = jnp.asarray(np.random.default_rng(seed).random((12, 2)))
    matrix = np.asarray(gram(RBF(theta, variance), x, x))
    assert np.linalg.eigvalsh(matrix)[0] >= -1e-14 * variance * 12
    assert matrix.max() == variance


@pytest.mark.parametrize("kernel", [RBF, Matern32])
def test_whole_numbers_are_the_same_points(kernel):
    whole, k = jnp.array([[0, 1], [1, 1]]), kernel(0.63, 1.5)
    plain = whole.astype(float)
    np.testing.assert_array_equal(gram(k, whole, whole), gram(k, plain, plain))
    assert k.diagonal(whole[0]) == 1.5 and k.diagonal(plain.astype(np.float32)[0]).dtype == np.float32
