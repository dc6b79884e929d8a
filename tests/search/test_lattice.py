"""Screening on a lattice and of any points: the same maximum as when nothing is skipped."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hilbo import acquisition
from hilbo.ordinal_gp import RBF, OrdinalGP, OrdinalProbit, Trials, fit
from hilbo.search import lattice
from hilbo.search.box import Mechanics, Parameter
from hilbo.search.space import SearchSpace
from hilbo.search.space_lattice import lattice_of

K1, B1, ALPHA = Parameter("K1", 1.0, 32.0), Parameter("B1", 0.001, 32.0), Parameter("alpha", 0.01, 0.99)
SPACES = {
    "mechanics": SearchSpace((K1, B1, ALPHA), Mechanics(K_eff=0.44, damping=0.95)),
    "other order, damped": SearchSpace(
        (ALPHA, K1, B1), Mechanics(K_eff=0.44, damping=0.95, effective_damping=(10.0, 80.0))
    ),
    "plane": SearchSpace((Parameter("a", 0.0, 1.0), Parameter("b", 0.0, 1.0))),
}
SCORES = [acquisition.UCB(0.7), acquisition.LogEI(0.3), acquisition.TopCategory(0.5, 0.5)]
each_space = pytest.mark.parametrize("space", SPACES.values(), ids=SPACES)


def _case(score, name):
    """By default every score with the mechanics, and one score with the plane: every pair is a program of its own."""
    deep = name != "mechanics" and not (name == "plane" and isinstance(score, acquisition.UCB))
    return pytest.param(SPACES[name], score, id=f"{type(score).__name__}-{name}", marks=[pytest.mark.deep] * deep)


each_score_and_space = pytest.mark.parametrize(
    ("space", "score"), [_case(score, name) for score in SCORES for name in SPACES]
)
screen, screen_points = eqx.filter_jit(lattice.screen), eqx.filter_jit(lattice.screen_points)
everywhere = eqx.filter_jit(lattice.Lattice.everywhere)


@functools.cache
def posterior(dim, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.random((12, dim))
    q = (np.linalg.norm(x - 0.4, axis=1) < 0.45).astype(int) + (np.linalg.norm(x - 0.4, axis=1) < 0.25)
    gp = OrdinalGP(RBF(30.0, 1.0), OrdinalProbit((-0.5, 0.5), 0.5))
    return fit(gp, Trials.from_arrays(x, q, 16))


def known(posterior):
    return posterior.gp.kernel, posterior.trials.x, posterior.latent.weights, posterior.latent.factor


@eqx.filter_jit
def scored(fitted, score, points):
    """Values (m,) of points (m, d), and the largest ones with any variance."""
    mean, variance = fitted.predict(points)
    return score(mean, variance), score.optimistic(mean, jnp.asarray(1.0))


@each_score_and_space
def test_the_maximum_over_the_lattice_is_found_with_few_variances(space, score):
    lattice_, fitted = lattice_of(space, 12), posterior(space.dim)
    highest, hopes, points = screen(*known(fitted), lattice_, score)
    everything, usable = everywhere(lattice_)
    assert np.argmax(hopes) == 0 and hopes[0] == np.inf
    np.testing.assert_allclose(
        highest, np.max(scored(fitted, score, everything)[0], where=usable, initial=-np.inf), rtol=1e-11
    )
    np.testing.assert_allclose(scored(fitted, score, points)[0][0], highest, rtol=1e-9)


@each_score_and_space
def test_a_column_is_known_by_its_most_hopeful_point(space, score):
    lattice_, fitted = lattice_of(space, 12), posterior(space.dim)
    _, hopes, points = (np.asarray(part) for part in screen(*known(fitted), lattice_, score))
    value, bound = (np.asarray(part)[1:] for part in scored(fitted, score, points))
    hopes = hopes[1:]
    searched = hopes > -np.inf
    np.testing.assert_allclose(hopes[searched], (0.8 * value + 0.2 * bound)[searched], rtol=1e-9, atol=1e-12)
    everything, usable = everywhere(lattice_)
    value, bound = (np.asarray(part) for part in scored(fitted, score, everything))
    every_hope = np.where(usable, 0.8 * value + 0.2 * bound, -np.inf)
    columns = lattice_.inside.shape[1]
    of_columns = every_hope[: every_hope.size - len(lattice_.extra)].reshape(-1, columns)
    searched = searched[:columns]
    largest = np.max(of_columns, axis=0)[searched]
    np.testing.assert_allclose(hopes[:columns][searched], largest, rtol=1e-9, atol=1e-12)


def test_most_columns_get_no_variance():
    space = SPACES["mechanics"]
    lattice_ = lattice_of(space, 24)
    hopes = np.asarray(screen(*known(posterior(3)), lattice_, SCORES[0]).hopes)
    columns = lattice_.inside.shape[1]
    assert np.sum(hopes[1 : 1 + columns] > -np.inf) <= 96 < columns / 5


@pytest.mark.parametrize("score", SCORES, ids=lambda s: type(s).__name__)
@pytest.mark.parametrize("dtype", [pytest.param(np.float32, marks=pytest.mark.deep), np.float64])
def test_the_maximum_over_any_points_is_found(score, dtype):
    assert_the_maximum_is_found(score, dtype)


def test_the_maximum_over_any_points_is_found_in_float32():
    assert_the_maximum_is_found(SCORES[0], np.float32)


def assert_the_maximum_is_found(score, dtype):
    points = np.random.default_rng(1).random((3000, 3)).astype(dtype)
    fitted = posterior(3).astype(dtype)
    values = np.asarray(screen_points(*known(fitted), jnp.asarray(points), score, 64))
    everything = np.asarray(scored(posterior(3), score, points.astype(np.float64))[0])
    # A value above the true one's rounding below the maximum: in float32 the argmax may be a neighbour's.
    assert everything[np.argmax(values)] >= np.max(everything) - (1e-5 if dtype is np.float32 else 1e-12)
    assert np.sum(values > -np.inf) < 3000


@pytest.mark.parametrize("score", SCORES, ids=lambda s: type(s).__name__)
def test_optimistic_values_bound_the_score_and_rise_with_the_mean(score):
    mean, shares = np.linspace(-3.0, 3.0, 61), np.array([1e-6, 0.1, 0.5, 0.9, 1.0])
    bound = np.asarray(score.optimistic(jnp.asarray(mean), jnp.asarray(1.3)))
    assert np.all(np.diff(bound) >= 0)
    values = eqx.filter_jit(score)(*map(jnp.asarray, np.broadcast_arrays(mean, 1.3 * shares[:, None])))
    assert np.all(np.asarray(values) <= bound + 1e-13)


@each_space
def test_points_of_the_lattice_are_feasible_and_meet_the_wall(space):
    lattice_ = lattice_of(space, 12)
    points, usable = (np.asarray(part) for part in everywhere(lattice_))
    feasible = np.asarray(jax.jit(space.feasible)(points))
    assert np.all(feasible[usable])
    if space.mechanics is None:
        assert np.all(usable) and len(points) == 12**space.dim
        return
    inside = np.asarray(lattice_.inside).ravel()
    assert not np.any(feasible[: inside.size][~inside])
    w = np.asarray(jax.jit(space.to_box)(points))[:, space.names.index("K1")]
    assert len(lattice_.extra) > 50
    np.testing.assert_allclose(w[-len(lattice_.extra) :], 1.0, rtol=1e-12)
    last = np.asarray(lattice_.present[-1])
    ends = w[: w.size - len(lattice_.extra)].reshape(-1, last.size)[-1]
    np.testing.assert_allclose(ends[last], 1.0, rtol=1e-12)


def test_a_smallest_distance_is_kept():
    space, fitted = SPACES["mechanics"], posterior(3)
    lattice_ = lattice_of(space, 12)
    best = screen(*known(fitted), lattice_, SCORES[0]).points[0]
    far = jax.jit(lambda *args: lattice.screen(*args, allowed=lambda x: jnp.sum((x - best) ** 2) >= 0.3**2))
    _, hopes, points = (np.asarray(part) for part in far(*known(fitted), lattice_, SCORES[0]))
    assert np.all(np.linalg.norm(points[hopes > -np.inf] - np.asarray(best), axis=1) >= 0.3)


def test_nothing_to_choose_is_no_start():
    lattice_ = lattice_of(SPACES["mechanics"], 12)
    none = jax.jit(lambda *args: lattice.screen(*args, allowed=lambda x: jnp.sum(x) < 0))
    highest, hopes, _ = none(*known(posterior(3)), lattice_, SCORES[0])
    assert highest == -np.inf and np.all(np.asarray(hopes) == -np.inf)


def test_nodes_follow_the_length_scale():
    assert [lattice.nodes_for(theta) for theta in (1e-3, 30.0, 1e5)] == [12, 25, 32]


def test_a_kernel_is_the_product_of_its_coordinates():
    rng = np.random.default_rng(0)
    x, y = rng.random((4, 3)), rng.random((5, 3))

    @eqx.filter_jit
    def both(kernel, x, y):
        factors = [kernel.along(i, x[:, i], y[:, i]) for i in range(3)]
        product = 2.0 * factors[0] * factors[1] * factors[2]
        return product, jax.vmap(lambda p: jax.vmap(lambda r: kernel(p, r))(y))(x)

    for kernel in (RBF(30.0, 2.0), RBF((3.0, 10.0, 50.0), 2.0)):
        product, whole = both(kernel, jnp.asarray(x), jnp.asarray(y))
        np.testing.assert_allclose(product, whole, rtol=1e-14)
