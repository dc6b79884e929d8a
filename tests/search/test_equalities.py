"""Equalities, as of a mixture: every point satisfies them, whichever parameter is computed from the others."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hilltop import height, highest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from hilbo.errors import InputError
from hilbo.search.box import Box, Constraint, Mechanics, Parameter
from hilbo.search.equality import scale_of, solved, unbalanced
from hilbo.search.space import SearchSpace, share_of_cube

SHARES = tuple(Parameter(name, 0.0, 100.0, "%") for name in "abc")
WHOLE = Constraint(tuple((name, 1.0) for name in "abc"), 100.0, 100.0)
MIXTURE = SearchSpace(SHARES, None, (WHOLE,))
LOG = SearchSpace(
    (Parameter("dose", 1.0, 50.0, scale="log"), Parameter("count", 0.0, 6.0, integer=True), *SHARES[1:]),
    None,
    (
        Constraint((("dose", 1.0), ("count", 5.0), ("b", 1.0), ("c", 1.0)), 100.0, 100.0),
        Constraint((("b", 1.0), ("c", -1.0)), None, 20.0),
    ),
)
TWO = SearchSpace(
    (*SHARES, Parameter("d", 0.0, 100.0), Parameter("e", -5.0, 5.0)),
    None,
    (
        Constraint((("a", 1.0), ("b", 1.0), ("c", 1.0), ("d", 1.0)), 100.0, 100.0),
        Constraint((("a", 1.0), ("b", -2.0), ("e", 3.0)), 4.0, 4.0),
    ),
)
SMALL = SearchSpace((*SHARES, Parameter("d", 0.0, 3.0)), None, (Constraint((*WHOLE.terms, ("d", 1.0)), 100.0, 100.0),))
SPACES = {"mixture": MIXTURE, "log and whole": LOG, "two": TWO, "a pinch": SMALL}


def off(space, x):
    """Largest difference from an equality, of its scale, by plain arithmetic."""
    physical, at = np.asarray(space.to_physical(x)).reshape(-1, space.dim), space.names.index
    return max(
        np.abs(sum(w * physical[:, at(name)] for name, w in c.terms) - c.least).max() / scale_of(c, space.parameters)
        for c in space.constraints
        if c.equality
    )


@pytest.mark.parametrize("name", ["mixture", *(pytest.param(n, marks=pytest.mark.deep) for n in list(SPACES)[1:])])
def test_every_point_satisfies_the_equality(name):
    space = SPACES[name]
    for draw, seed in itertools.product(("candidates", "walls", "latin_hypercube"), (0, 5)):
        x = getattr(space, draw)(60, seed)
        assert x.shape == (60, space.dim) and np.all((x >= 0) & (x <= 1)) and np.asarray(space.feasible(x)).all()
        assert off(space, x) < 1e-12
        physical = np.asarray(space.to_physical(x))
        assert all(
            p.holds(value) for p, column in zip(space.parameters, physical.T.tolist(), strict=True) for value in column
        )


def test_walls_of_a_mixture_are_its_edges_and_corners():
    physical = np.asarray(MIXTURE.to_physical(MIXTURE.walls(300, 0)))
    none = np.abs(physical) < 1e-12
    assert np.all(none.sum(axis=1) >= 1) and 30 < np.sum(none.sum(axis=1) == 2) < 150
    assert np.all((physical == 0).sum(axis=0) > 50)


def test_candidates_fill_the_triangle_evenly():
    x = MIXTURE.candidates(2048, 0)
    np.testing.assert_allclose(x.mean(axis=0), 1 / 3, atol=0.02)
    np.testing.assert_allclose(np.cov(x.T), np.full((3, 3), -1 / 36) + np.eye(3) / 12, atol=0.005)
    assert share_of_cube(MIXTURE) == pytest.approx(0.5, abs=0.02) and off(MIXTURE, x) < 1e-12


ORDERS = [SearchSpace(tuple(SHARES["abc".index(n)] for n in order), None, (WHOLE,)) for order in ("abc", "bca", "cab")]
shares = st.tuples(st.floats(0, 1), st.floats(0, 1)).map(lambda ab: (min(ab), max(ab) - min(ab), 1 - max(ab)))


@given(shares, st.floats(-0.3, 0.3))
@settings(deadline=None, max_examples=25)
def test_the_feasible_set_is_the_same_by_elimination_of_each(share, more):
    assert [space.names[space.dependent[0]] for space in ORDERS] == ["c", "a", "b"]
    for space in ORDERS:
        x = np.array([share["abc".index(name)] for name in space.names])
        assert bool(space.feasible(x)) and off(space, x[None]) < 1e-12
        np.testing.assert_allclose(space.completed(x), x, atol=1e-14)
        moved = x + more * np.eye(3)[1]
        completed = np.asarray(space.completed(moved))
        assert completed.sum() == pytest.approx(1.0, abs=1e-14)
        assert abs(more) < 1e-6 or not bool(space.feasible(moved))
        for kept in range(3):
            np.testing.assert_allclose(np.asarray(space.completed(moved, (kept,)))[kept], moved[kept])


@pytest.mark.deep
@given(st.tuples(*[st.floats(-0.3, 1.3)] * 3), st.tuples(*[st.floats(0.5, 20.0)] * 3))
@settings(deadline=None, max_examples=15)
def test_the_optimum_is_the_same_by_elimination_of_each(top, sharpness):
    ends = []
    for space in ORDERS:
        at = ["abc".index(name) for name in space.names]
        choice = highest(space, np.array(top)[at], np.array(sharpness)[at])
        assert off(space, choice.x) < 1e-12 and bool(space.feasible(choice.x))
        ends.append(np.asarray(choice.x)[np.argsort(at)])
    np.testing.assert_allclose(ends[1:], [ends[0]] * 2, atol=1e-6)
    best = minimize(
        lambda x: -float(height(x, np.array(top), np.array(sharpness))),
        np.full(3, 1 / 3),
        jac=lambda x: 2 * np.array(sharpness) * (x - np.array(top)),
        method="SLSQP",
        bounds=[(0, 1)] * 3,
        constraints=[{"type": "eq", "fun": lambda x: x.sum() - 1}],
        options={"ftol": 1e-13},
    )
    assert float(choice.value) >= -best.fun - 1e-7


@pytest.mark.deep
@pytest.mark.parametrize("name", ["log and whole", "two"])
def test_the_optimum_between_other_walls_satisfies_the_equality(name):
    space = SPACES[name]
    choice = highest(space, np.full(space.dim, 0.9), np.linspace(1.0, 3.0, space.dim))
    assert off(space, choice.x) < 1e-12 and bool(space.feasible(choice.x))
    others = space.candidates(500, 3)
    best = jax.vmap(height, (0, None, None))(
        jnp.asarray(others), jnp.full(space.dim, 0.9), jnp.linspace(1, 3, space.dim)
    )
    assert float(choice.value) >= float(best.max())


def test_single_precision_accepts_its_own_points():
    x = jnp.asarray(MIXTURE.candidates(64, 0), jnp.float32)
    assert bool(jnp.all(MIXTURE.feasible(MIXTURE.from_box(MIXTURE.to_box(x)))))


def test_the_slope_at_the_end_of_a_dependent_range_is_that_within():
    slope = jax.jacfwd(MIXTURE.from_box)
    np.testing.assert_array_equal(slope(jnp.array([0.4, 0.6, 0.5])), slope(jnp.array([0.3, 0.3, 0.5])))
    assert float(MIXTURE.from_box(jnp.array([0.1, 0.9, 0.5]))[2]) == 0.0


def test_without_an_equality_there_is_nothing_to_complete():
    plain = SearchSpace(SHARES, None, (Constraint(WHOLE.terms, 99.0, 101.0),))
    assert plain.dependent == () and plain.free == (0, 1, 2) and "dependent" not in plain.searched
    x = np.array([[0.2, 0.3, 0.9]])
    np.testing.assert_array_equal(plain.completed(x), x)
    assert solved(SHARES, plain.constraints) is None


CASES = [
    (SHARES, [WHOLE, WHOLE], "constraints.2 follows from the earlier equalities, or contradicts them"),
    (SHARES, [Constraint((("a", 1.0),), 5.0, 5.0)], "constraints.1 leaves a no freedom: an equality needs two"),
    (SHARES, [WHOLE, Constraint((("a", 1.0), ("b", 1.0)), 60.0, 60.0)], "constraints.1 leaves c no freedom"),
    (
        (SHARES[0], Parameter("n", 0.0, 9.0, integer=True)),
        [Constraint((("a", 1.0), ("n", 1.0)), 9.0, 9.0)],
        "constraints.1 leaves a no freedom: an equality needs two continuous parameters",
    ),
    (SHARES, [Constraint(WHOLE.terms, 301.0, 301.0)], "constraints.1 leaves nothing of the ranges"),
    (SHARES, [Constraint(WHOLE.terms, 0.0, 0.0)], "constraints.1 leaves no more than an edge of the ranges"),
    (SHARES, [WHOLE, Constraint((("a", 1.0), ("b", 1.0)), 101.0, None)], "constraints.2 contradicts the first"),
    (SHARES, [WHOLE, Constraint(WHOLE.terms, 101.0, None)], "constraints.2 contradicts the first"),
    (
        (SHARES[0], Parameter.of_levels("t", ("x", "y"))),
        [Constraint((("a", 1.0), ("t", 1.0)), 9.0, 9.0)],
        "constraints.1.terms names t, whose levels are no numbers",
    ),
]


@pytest.mark.parametrize(("parameters", "constraints", "sentence"), CASES)
def test_an_equality_that_leaves_no_choice_is_refused(parameters, constraints, sentence):
    with pytest.raises(InputError) as refused:
        SearchSpace(parameters, None, tuple(constraints))
    assert str(refused.value).startswith(sentence) and str(refused.value).count(". ") == 0


def test_an_equality_beside_a_renderer_is_refused():
    model = (Parameter("K1", 1.0, 32.0), Parameter("B1", 0.001, 32.0), Parameter("alpha", 0.01, 0.99))
    with pytest.raises(
        InputError, match=r"constraints\.1 is an equality, which is not possible where there is a \[ren"
    ):
        Box(model, Mechanics(0.44, 0.95), (Constraint((("K1", 1.0), ("B1", 1.0)), 20.0, 20.0),))


def test_an_inequality_that_an_equality_settles_is_left_out():
    space = SearchSpace(SHARES, None, (WHOLE, Constraint(WHOLE.terms, None, 120.0)))
    np.testing.assert_array_equal(space.candidates(16, 0), MIXTURE.candidates(16, 0))


def test_rounded_cells_are_balanced_and_others_are_not():
    rows = np.array([[33.3, 33.3, 33.3], [33.0, 33.0, 33.0], [30.0, 20.0, 50.0]])
    total, wrong = unbalanced(WHOLE, dict(zip("abc", rows.T, strict=True)), np.zeros(3))
    np.testing.assert_allclose(total, [99.9, 99.0, 100.0])
    assert wrong.tolist() == [False, True, False]
    assert unbalanced(WHOLE, dict(zip("abc", rows.T, strict=True)), np.full(3, 1.0))[1].tolist() == [False] * 3
