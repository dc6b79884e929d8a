"""The nearest point of a polytope: the conditions that say it is, for random walls, corners, and walls said twice."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from hilbo.numerics.newton import TrustRegionNewton
from hilbo.numerics.polytope import Polytope, nearest, projector, walls_of_cube

compiled_nearest = jax.jit(nearest)


def problem(seed, d):
    """Walls around a point of the cube, some of them twice, some touching it, and a target."""
    rng = np.random.default_rng(seed)
    normals = rng.standard_normal((5, d))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    normals[4] = normals[3]
    at = rng.random(d) if seed % 3 else np.round(rng.random(d))
    offsets = normals @ at + np.maximum(rng.standard_normal(5) * 0.3, 0.0)
    offsets[4] = offsets[3]
    return Polytope(jnp.asarray(normals), jnp.asarray(offsets)), jnp.asarray(at), 2 * rng.standard_normal(d), rng


@pytest.mark.parametrize("d", [2, 8])
def test_the_nearest_point_meets_the_conditions_of_a_minimum(d):
    for seed in range(40):
        walls, at, target, rng = problem(seed, d)
        seen = walls_of_cube(walls, jnp.zeros(d, bool), at)
        root = rng.standard_normal((d, d)) + 2 * np.eye(d)
        spread = np.linalg.inv(root)
        point, multipliers = map(np.asarray, compiled_nearest(seen, jnp.asarray(target), jnp.asarray(spread)))
        slack = np.asarray(seen.offsets - seen.normals @ point)
        size = 1 + np.abs(multipliers).max()
        assert slack.min() > -1e-9 and multipliers.min() >= 0
        assert np.abs(multipliers * slack).max() < 1e-8 * size
        pull = root.T @ root @ (point - target) + np.asarray(seen.normals).T @ multipliers
        assert np.abs(pull).max() < 1e-8 * size


def test_what_is_held_does_not_move():
    walls, at, target, _ = problem(1, 4)
    held = jnp.array([True, False, True, False])
    seen = walls_of_cube(walls, held, at)
    point = compiled_nearest(seen, jnp.where(held, 0.0, target), jnp.eye(4)).point
    np.testing.assert_array_equal(np.asarray(point)[np.asarray(held)], 0.0)


def test_a_projector_leaves_what_is_along_the_walls():
    normals = jnp.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    np.testing.assert_allclose(projector(normals, jnp.array([True, True, False])), np.diag([0, 1, 1]), atol=1e-12)
    np.testing.assert_allclose(projector(normals, jnp.zeros(3, bool)), np.eye(3), atol=1e-12)


@jax.jit
def _descended(walls, top, bend, start):
    def bowl(w, _):
        return (w - top) @ bend @ (w - top) - jnp.exp(-20 * jnp.sum((w - 0.5 * top) ** 2))

    options = {"walls": walls, "held": jnp.zeros(start.shape, bool)}
    solver = TrustRegionNewton(atol=1e-8, resolution=1e-6)
    solution = optx.minimise(bowl, solver, start, options=options, max_steps=60, throw=False)
    return solution.value, solution.state.pressing, solution.stats["num_steps"]


def test_newton_between_walls_ends_where_nothing_presses():
    steps = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        normals, start = rng.standard_normal((4, 5)), rng.random(5)
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        walls = Polytope(jnp.asarray(normals), jnp.asarray(normals @ start + 0.2 * rng.random(4)))
        bend = rng.standard_normal((5, 5))
        top = 2 * rng.random(5) - 0.5
        w, pressing, count = _descended(walls, jnp.asarray(top), jnp.asarray(0.3 * bend @ bend.T), jnp.asarray(start))
        assert np.all(normals @ w <= np.asarray(walls.offsets) + 1e-12) and np.all((w > -1e-12) & (w < 1 + 1e-12))
        assert pressing <= 1e-8
        steps.append(int(count))
    assert np.mean(steps) < 15  # quadratic at the end: steepest descent would take hundreds
