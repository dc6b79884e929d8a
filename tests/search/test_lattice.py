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
SCORES = [acquisition.UCB(0.7), acquisition.LogEI(0.3), acquisition.TopCategory(0.5, 0.5), acquisition.Mean()]
each_space = pytest.mark.parametrize("space", SPACES.values(), ids=SPACES)


def _case(score, name):
    """Every space and every score by default, not each with each: every pair is a program of its own."""
    deep = name != "mechanics" and not isinstance(score, acquisition.UCB)
    return pytest.param(SPACES[name], score, id=f"{type(score).__name__}-{name}", marks=[pytest.mark.deep] * deep)


each_score_and_space = pytest.mark.parametrize(
    ("space", "score"), [_case(score, name) for score in SCORES for name in SPACES]
)
screen, screen_points = eqx.filter_jit(lattice.screen), eqx.filter_jit(lattice.screen_points)


@functools.cache
def posterior(dim, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.random((12, dim))
    q = (np.linalg.norm(x - 0.4, axis=1) < 0.45).astype(int) + (np.linalg.norm(x - 0.4, axis=1) < 0.25)
    gp = OrdinalGP(RBF(30.0, 1.0), OrdinalProbit((-0.5, 0.5), 0.5))
    return fit(gp, Trials.from_arrays(x, q, 16))


def known(posterior):
    return posterior.gp.kernel, posterior.trials.x, posterior.latent.weights, posterior.latent.factor


def every_point(lattice_):
    """All points of a lattice that may be chosen."""
    usable = jnp.concatenate([lattice_.inside, lattice_.present])
    points = lattice_.points(*map(jnp.asarray, np.indices(usable.shape)))
    return jnp.concatenate([points[usable], lattice_.extra])


@each_score_and_space
def test_the_maximum_over_the_lattice_is_found_with_few_variances(space, score):
    lattice_, fitted = lattice_of(space, 12), posterior(space.dim)
    highest, hopes, points = screen(*known(fitted), lattice_, score)
    everything = score(*fitted.predict(every_point(lattice_)))
    assert jnp.argmax(hopes) == 0 and hopes[0] == jnp.inf
    np.testing.assert_allclose(highest, jnp.max(everything), rtol=1e-11)
    mean, variance = fitted.predict(points[:1])
    np.testing.assert_allclose(score(mean[0], variance[0]), highest, rtol=1e-9)


@each_score_and_space
def test_a_column_is_known_by_its_most_hopeful_point(space, score):
    lattice_, fitted = lattice_of(space, 12), posterior(space.dim)
    _, hopes, points = screen(*known(fitted), lattice_, score)
    mean, variance = fitted.predict(points[1:])
    value, bound = score(mean, variance), score.optimistic(mean, jnp.asarray(1.0))
    searched = hopes[1:] > -jnp.inf
    np.testing.assert_allclose(hopes[1:][searched], (0.8 * value + 0.2 * bound)[searched], rtol=1e-9, atol=1e-12)
    usable = jnp.concatenate([lattice_.inside, lattice_.present])
    everywhere = fitted.predict(lattice_.points(*map(jnp.asarray, np.indices(usable.shape))).reshape(-1, space.dim))
    every_hope = 0.8 * score(*everywhere) + 0.2 * score.optimistic(everywhere[0], jnp.asarray(1.0))
    largest = jnp.max(jnp.where(usable, every_hope.reshape(usable.shape), -jnp.inf), axis=0)
    columns = searched[: usable.shape[1]]
    np.testing.assert_allclose(hopes[1:][: usable.shape[1]][columns], largest[columns], rtol=1e-9, atol=1e-12)


def test_most_columns_get_no_variance():
    space = SPACES["mechanics"]
    lattice_ = lattice_of(space, 24)
    hopes = screen(*known(posterior(3)), lattice_, SCORES[0]).hopes
    columns = lattice_.inside.shape[1]
    assert jnp.sum(hopes[1 : 1 + columns] > -jnp.inf) <= 96 < columns / 5


@pytest.mark.parametrize("score", SCORES, ids=lambda s: type(s).__name__)
@pytest.mark.parametrize("dtype", [pytest.param(np.float32, marks=pytest.mark.deep), np.float64])
def test_the_maximum_over_any_points_is_found(score, dtype):
    assert_the_maximum_is_found(score, dtype)


def test_the_maximum_over_any_points_is_found_in_float32():
    assert_the_maximum_is_found(SCORES[0], np.float32)


def assert_the_maximum_is_found(score, dtype):
    points = jnp.asarray(np.random.default_rng(1).random((3000, 3)), dtype)
    fitted = posterior(3).astype(dtype)
    values = screen_points(*known(fitted), points, score, 64)
    everything = score(*posterior(3).predict(points.astype(jnp.float64)))
    # A value above the true one's rounding below the maximum: in float32 the argmax may be a neighbour's.
    assert everything[jnp.argmax(values)] >= jnp.max(everything) - (1e-5 if dtype is np.float32 else 1e-12)
    assert jnp.sum(values > -jnp.inf) < 3000


@pytest.mark.parametrize("score", SCORES, ids=lambda s: type(s).__name__)
def test_optimistic_values_bound_the_score_and_rise_with_the_mean(score):
    mean = jnp.linspace(-3.0, 3.0, 61)
    bound = score.optimistic(mean, jnp.asarray(1.3))
    assert jnp.all(jnp.diff(bound) >= 0)
    for share in (1e-6, 0.1, 0.5, 0.9, 1.0):
        assert jnp.all(score(mean, jnp.full_like(mean, 1.3 * share)) <= bound + 1e-13)


@each_space
def test_points_of_the_lattice_are_feasible_and_meet_the_wall(space):
    lattice_ = lattice_of(space, 12)
    points = every_point(lattice_)
    assert jnp.all(space.feasible(points))
    outside = jnp.argwhere(~lattice_.inside)
    if space.mechanics is None:
        assert len(outside) == 0 and len(points) == 12**space.dim
        return
    wrong = lattice_.points(outside[:, 0], outside[:, 1])
    assert not jnp.any(space.feasible(wrong))
    w = space.to_box(lattice_.extra)[:, space.names.index("K1")]
    np.testing.assert_allclose(w, 1.0, rtol=1e-12)
    assert len(w) > 50
    last = lattice_.present[-1]
    ends = lattice_.points(jnp.full(last.shape, 11 + len(lattice_.ends)), jnp.arange(last.size))[last]
    np.testing.assert_allclose(space.to_box(ends)[:, space.names.index("K1")], 1.0, rtol=1e-12)


def test_a_smallest_distance_is_kept():
    space, fitted = SPACES["mechanics"], posterior(3)
    lattice_ = lattice_of(space, 12)
    best = screen(*known(fitted), lattice_, SCORES[0]).points[0]
    far = jax.jit(lambda *args: lattice.screen(*args, allowed=lambda x: jnp.sum((x - best) ** 2) >= 0.3**2))
    _, hopes, points = far(*known(fitted), lattice_, SCORES[0])
    assert jnp.all(jnp.linalg.norm(points[hopes > -jnp.inf] - best[None, :], axis=1) >= 0.3)


def test_nothing_to_choose_is_no_start():
    lattice_ = lattice_of(SPACES["mechanics"], 12)
    none = jax.jit(lambda *args: lattice.screen(*args, allowed=lambda x: jnp.sum(x) < 0))
    highest, hopes, _ = none(*known(posterior(3)), lattice_, SCORES[0])
    assert highest == -jnp.inf and jnp.all(hopes == -jnp.inf)


def test_nodes_follow_the_length_scale():
    assert [lattice.nodes_for(theta) for theta in (1e-3, 30.0, 1e5)] == [12, 25, 32]


def test_a_kernel_is_the_product_of_its_coordinates():
    rng = np.random.default_rng(0)
    x, y = jnp.asarray(rng.random((4, 3))), jnp.asarray(rng.random((5, 3)))
    for kernel in (RBF(30.0, 2.0), RBF((3.0, 10.0, 50.0), 2.0)):
        factors = [kernel.along(i, x[:, i], y[:, i]) for i in range(3)]
        whole = jax.vmap(lambda p, kernel=kernel: jax.vmap(lambda r: kernel(p, r))(y))(x)
        np.testing.assert_allclose(2.0 * factors[0] * factors[1] * factors[2], whole, rtol=1e-14)
