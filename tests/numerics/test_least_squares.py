"""The bounded solver against scipy's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares as scipy_least_squares

from hilbo.numerics.least_squares import least_squares

T = np.linspace(0, 3, 40)
RNG = np.random.default_rng(0)
DATA = 2.0 * np.exp(-1.3 * T) + 0.5 + 0.02 * RNG.standard_normal(T.size)


def decay(q):
    return q[0] * jnp.exp(-q[1] * T) + q[2] - DATA


def rosenbrock(q):
    return jnp.stack([10 * (q[1] - q[0] ** 2), 1 - q[0], 0.1 * q[2]])


BOXES = {
    "free": ([-10, -10, -10], [10, 10, 10]),
    "a bound that holds": ([-10, -10, 0.6], [10, 10, 10]),
    "two bounds that hold": ([-10, 1.5, 0.6], [1.9, 10, 10]),
}


@pytest.mark.parametrize("function", [decay, rosenbrock])
@pytest.mark.parametrize("box", BOXES)
def test_it_finds_what_scipy_finds(function, box):
    lower, upper = (jnp.array(end, float) for end in BOXES[box])
    start = jnp.clip(jnp.array([1.2, 1.0, 0.7]), lower + 1e-3, upper - 1e-3)
    solution = jax.jit(lambda s: least_squares(function, s, lower, upper, max_steps=200))(start)
    expected = scipy_least_squares(
        lambda q: np.asarray(function(jnp.asarray(q))),
        start,
        bounds=(np.asarray(lower), np.asarray(upper)),
        xtol=1e-14,
        ftol=1e-14,
        gtol=1e-14,
    )
    assert solution.converged
    assert float(solution.cost) <= 2 * expected.cost * (1 + 1e-10) + 1e-15
    np.testing.assert_allclose(solution.q, expected.x, atol=1e-5)


def test_a_fixed_parameter_stays_and_the_others_follow():
    lower, upper = jnp.array([-10.0, 2.0, -10.0]), jnp.array([10.0, 2.0, 10.0])
    solution = least_squares(decay, jnp.array([1.0, 1.0, 0.0]), lower, upper)
    basis = np.stack([np.exp(-2.0 * T), np.ones_like(T)], axis=1)
    np.testing.assert_allclose(np.delete(solution.q, 1), np.linalg.lstsq(basis, DATA)[0], atol=1e-8)
    assert solution.q[1] == 2.0


def test_many_starts_are_one_function():
    starts = jnp.array([[1.0, 1.0, 0.0], [3.0, 0.2, 1.0], [0.1, 5.0, -1.0]])
    wide = jnp.full(3, 20.0)
    solution = jax.vmap(lambda s: least_squares(decay, s, -wide, wide))(starts)
    np.testing.assert_allclose(solution.q, jnp.tile(solution.q[0], (3, 1)), atol=1e-6)


def test_what_cannot_be_computed_has_not_converged():
    solution = least_squares(lambda q: jnp.log(q - 2), jnp.ones(2), jnp.zeros(2), jnp.ones(2))
    assert not solution.converged
