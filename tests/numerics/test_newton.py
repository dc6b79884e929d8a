"""Newton's method in a box: valleys, saddles, walls, and starts from which nothing can be done."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from jaxopt import ProjectedGradient
from jaxopt.projection import projection_box

from hilbo.numerics.newton import Expansion, TrustRegionNewton, arrives


def rosenbrock(y, _):
    return (1 - y[0]) ** 2 + 100 * (y[1] - y[0] ** 2) ** 2


def saddle(y, _):
    return (y[0] ** 2 - 1) ** 2 + y[0] * 1e-3 + y[1] ** 2


def walled(y, _):
    return jnp.where(y[0] < 0.1, jnp.nan, y[0] - jnp.log(y[0])) + (y[1] - 2) ** 2


@pytest.mark.parametrize(
    ("function", "start", "end"),
    [(rosenbrock, (-1.2, 1.0), (1.0, 1.0)), (saddle, (0.0, 1.0), (-1.000125, 0.0)), (walled, (0.2, 9.0), (1.0, 2.0))],
)
def test_the_search_follows_valleys_leaves_saddles_and_turns_at_walls(function, start, end):
    solver = TrustRegionNewton(atol=1e-9)
    solution = optx.minimise(function, solver, jnp.array(start), max_steps=60, throw=False)
    np.testing.assert_allclose(solution.value, end, atol=1e-6)
    assert bool(solution.result == optx.RESULTS.successful)


def test_a_search_that_cannot_begin_ends_where_it_began():
    solution = optx.minimise(walled, TrustRegionNewton(), jnp.array([0.0, 2.0]), max_steps=60, throw=False)
    np.testing.assert_array_equal(solution.value, [0.0, 2.0])
    assert not np.isfinite(solution.state.here.value)


def bumps(y, centres):
    """A smooth function with many minima."""
    return -jnp.sum(jnp.exp(-8.0 * jnp.sum((y[None, :] - centres) ** 2, axis=1)) * jnp.arange(1.0, 6.0))


@pytest.mark.parametrize("seed", range(12))
def test_the_end_in_a_box_is_a_minimum_that_jaxopt_cannot_better(seed):
    rng = np.random.default_rng(seed)
    centres, start = jnp.asarray(rng.uniform(-0.3, 1.3, (5, 3))), rng.uniform(size=3)
    box = {"lower": jnp.zeros(3), "upper": jnp.ones(3)}
    solution = optx.minimise(
        bumps, TrustRegionNewton(atol=1e-9), jnp.asarray(start), centres, options=box, max_steps=60, throw=False
    )
    end = np.asarray(solution.value)
    assert bool(solution.result == optx.RESULTS.successful)
    assert np.all((end >= 0) & (end <= 1))
    reference = ProjectedGradient(lambda y: bumps(y, centres), projection_box, maxiter=500, tol=1e-9)
    again = reference.run(jnp.asarray(end), hyperparams_proj=(jnp.zeros(3), jnp.ones(3)))
    assert float(solution.state.here.value) <= float(bumps(again.params, centres)) + 1e-12


def test_a_start_at_a_wall_may_leave_it():
    box = {"lower": jnp.zeros(2), "upper": jnp.ones(2)}
    solution = optx.minimise(
        lambda y, _: jnp.sum((y - jnp.array([0.5, -1.0])) ** 2), TrustRegionNewton(), jnp.array([1.0, 1.0]), options=box
    )
    np.testing.assert_allclose(solution.value, [0.5, 0.0], atol=1e-9)


def test_every_lane_of_a_batch_ends():
    starts = jnp.array([[-1.2, 1.0], [3.0, 3.0], [0.0, jnp.nan]])
    solve = jax.vmap(lambda y: optx.minimise(rosenbrock, TrustRegionNewton(), y, max_steps=80, throw=False).value)
    ends = solve(starts)
    np.testing.assert_allclose(ends[:2], 1.0, atol=1e-5)
    assert not np.isfinite(ends[2]).all()


def ridge(y, form):
    centre, matrix = form
    return -jnp.exp(-(y - centre) @ matrix @ (y - centre))


@jax.jit
def climbed(start, centre, matrix):
    box = {"lower": jnp.zeros(2), "upper": jnp.ones(2)}
    solver = TrustRegionNewton(atol=1e-9)
    solution = optx.minimise(ridge, solver, start, (centre, matrix), options=box, max_steps=60, throw=False)
    return solution.result == optx.RESULTS.successful, solution.state.radius


@pytest.mark.parametrize("seed", [10, 27, 55, 67, 75, 84])
def test_a_step_that_a_wall_turns_uphill_is_refused_and_shortened(seed):
    """A narrow ridge across a wall: cut off there, Newton's step would rise by its own model, which trusted itself."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    matrix = turn @ np.diag([rng.uniform(1, 5), rng.uniform(20, 300)]) @ turn.T
    centre, start = rng.uniform(-0.3, 1.3, 2), rng.uniform(size=2)
    converged, radius = climbed(jnp.asarray(start), jnp.asarray(centre), jnp.asarray(matrix))
    assert bool(converged) and float(radius) < 1e6


def test_a_search_on_its_way_to_a_known_end_stops():
    def solve(known):
        options = {"known": jnp.asarray(known)}
        return optx.minimise(
            rosenbrock, TrustRegionNewton(), jnp.array([-1.2, 1.0]), options=options, max_steps=60, throw=False
        )

    nothing, other, there = (solve([end]) for end in ([np.nan] * 2, [2.0, 4.0], [1.0, 1.0]))
    assert not bool(arrives(nothing.value, nothing.state.move, jnp.full((1, 2), jnp.nan)))
    assert int(nothing.stats["num_steps"]) == int(other.stats["num_steps"]) > int(there.stats["num_steps"])
    assert bool(arrives(there.value, there.state.move, jnp.ones((1, 2))))


def plateau(y, _):
    """A shallow bowl of degree four, on whose floor Newton's steps shorten by a third only, and a steep one."""
    return 1e-3 * y[0] ** 4 + jnp.abs(y[1] - 0.3)


def test_a_search_ends_on_a_plateau_but_not_on_a_slope_that_a_kink_makes_long():
    def solve(gain):
        solver = TrustRegionNewton(atol=1e-14, resolution=1e-9, gain=gain)
        return optx.minimise(plateau, solver, jnp.array([0.5, 0.9]), max_steps=200, throw=False)

    to_the_end, early = solve(0.0), solve(1e-7)
    assert int(early.stats["num_steps"]) <= int(to_the_end.stats["num_steps"])
    np.testing.assert_allclose(plateau(early.value, None), 0.0, atol=1e-4)  # the kink was followed all the same

    flat = [
        optx.minimise(
            lambda y, _: 1e-3 * y[0] ** 4,
            TrustRegionNewton(atol=1e-14, gain=gain),
            jnp.array([0.5]),
            max_steps=200,
            throw=False,
        )
        for gain in (0.0, 1e-7)
    ]
    many, few = (int(solution.stats["num_steps"]) for solution in flat)
    assert few < many / 2 and float(1e-3 * flat[1].value[0] ** 4) < 1e-6


def test_an_expansion_of_ones_own_replaces_differentiation():
    @jax.jit
    def expand(y, aux):
        derivatives = jax.grad(rosenbrock)(y, None), jax.hessian(rosenbrock)(y, None)
        return Expansion(rosenbrock(y, None), *derivatives, aux + 1)

    def solved(**options):
        return optx.minimise(
            lambda y, _: (rosenbrock(y, None), jnp.asarray(0)),
            TrustRegionNewton(atol=1e-9),
            start,
            has_aux=True,
            options={"expand": expand} | options,
            max_steps=60,
            throw=False,
        )

    start = jnp.array([-1.2, 1.0])
    solution, begun = solved(), solved(begun=expand(start, jnp.asarray(0)))
    np.testing.assert_allclose(solution.value, [1.0, 1.0], atol=1e-6)
    assert 0 < int(solution.aux) <= int(solution.stats["num_steps"])  # counted where a step was taken
    # With the start's expansion given, the same way by one evaluation less.
    np.testing.assert_array_equal(begun.value, solution.value)
    assert int(begun.stats["num_steps"]) == int(solution.stats["num_steps"]) - 1
