"""Linear constraints: the walls are reached and never crossed, and what leaves nothing is refused in a sentence."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hilltop import height, highest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.stats import qmc

from hilbo.errors import InputError
from hilbo.search.box import Box, Constraint, Mechanics, Parameter
from hilbo.search.linear import check_room
from hilbo.search.space import SearchSpace

BOX = (Parameter("a", 0.0, 10.0, "mm"), Parameter("b", 1.0, 100.0, scale="log"), Parameter("c", 0.0, 1.0))
HALF = Constraint((("a", 1.0), ("b", 0.1)), most=12.0)
BAND = Constraint((("a", 0.1), ("c", 1.0)), least=0.4, most=1.2)


def keeps(physical, constraint, names):
    """Without hilbo's code, and without slack."""
    total = sum(weight * physical[:, names.index(name)] for name, weight in constraint.terms)
    least = -np.inf if constraint.least is None else constraint.least
    return np.logical_and(least <= total, total <= (np.inf if constraint.most is None else constraint.most))


@pytest.fixture(scope="module")
def space():
    return SearchSpace(BOX, None, (HALF, BAND))


@pytest.mark.parametrize("draw", ["candidates", "walls", "latin_hypercube"])
def test_points_keep_the_constraints_and_repeat(space, draw):
    x = getattr(space, draw)(40, 3)
    physical = np.asarray(space.to_physical(x))
    assert x.shape == (40, 3) and len(np.unique(x, axis=0)) == 40
    assert np.all((x >= 0) & (x <= 1))
    for constraint in space.constraints:
        assert keeps(physical, constraint, space.names).all()
    np.testing.assert_array_equal(getattr(space, draw)(40, 3), x)


def test_walls_are_reached_from_the_inside(space):
    physical = np.asarray(space.to_physical(space.walls(400, 0)))
    at = [physical[:, 0] + 0.1 * physical[:, 1] - 12, 0.1 * physical[:, 0] + physical[:, 2] - 1.2, physical[:, 2]]
    touching = [np.abs(distance) < 1e-6 for distance in at]
    assert all(20 < one.sum() < 400 for one in touching)
    assert np.any(touching[0] & touching[1])  # edges


def test_box_coordinates_are_inverted_where_constraints_make_them_linear(space):
    x = space.candidates(50, 0)
    np.testing.assert_allclose(space.from_box(space.to_box(x)), x, atol=1e-14)
    half = space.from_box(jnp.array([0.5, 0.5, 0.5]))
    np.testing.assert_allclose(space.to_physical(half), [5.0, 50.5, 0.5])


@eqx.filter_jit
def falling(space, w, top, sharpness):
    return jax.value_and_grad(lambda w: -height(space.from_box(w), top, sharpness))(w)


@settings(deadline=None, max_examples=25)
@given(st.tuples(*[st.floats(-0.3, 1.3)] * 3), st.tuples(*[st.floats(0.5, 20.0)] * 3))
def test_the_choice_is_the_maximum_between_the_walls_and_never_outside(space, top, sharpness):
    hill = np.array(top), np.array(sharpness)
    choice = highest(space, *hill)
    physical = np.asarray(space.to_physical(choice.x))[None]
    for constraint in space.constraints:
        assert keeps(physical, constraint, space.names).all()
    inequalities = [
        lambda w: 12 - 10 * w[0] - 0.1 * (1 + 99 * w[1]),
        lambda w: 1.2 - w[0] - w[2],
        lambda w: w[0] + w[2] - 0.4,
    ]
    best = minimize(
        lambda w: [np.asarray(part) for part in falling(space, jnp.asarray(w), *map(jnp.asarray, hill))],
        np.asarray(space.to_box(choice.x)),
        jac=True,
        method="SLSQP",
        bounds=[(0, 1)] * 3,
        constraints=[{"type": "ineq", "fun": one} for one in inequalities],
        options={"ftol": 1e-12},
    )
    assert float(choice.value) >= -best.fun - 1e-5


@pytest.mark.deep
def test_a_vertex_is_reached():
    square = tuple(Parameter(name, 0.0, 1.0) for name in "abcdefgh")
    simplex = SearchSpace(square, None, (Constraint(tuple((name, 1.0) for name in "abcdefgh"), most=1.0),))
    goal = jnp.array([2.0, 0.5, *[-0.5] * 6])
    choice = highest(simplex, goal, jnp.ones(8))
    np.testing.assert_allclose(choice.x, [1.0, *[0.0] * 7], atol=1e-8)
    assert np.sum(np.asarray(simplex.to_physical(choice.x))) <= 1.0


def test_few_points_of_the_cube_are_enough():
    names = "abcdefgh"
    weights = tuple((name, 1.0) for name in names)
    corner = SearchSpace(tuple(Parameter(n, 0.0, 1.0) for n in names), None, (Constraint(weights, most=0.5),))
    x = corner.candidates(512, 0)  # 1e-7 of the cube
    sums = x.sum(axis=1)
    assert x.shape == (512, 8) and np.all(sums <= 0.5)
    assert np.mean((sums / 0.5) ** 8) == pytest.approx(0.5, abs=0.06)  # uniform in the simplex


MECHANICS = (Parameter("K1", 1.0, 32.0), Parameter("B1", 0.001, 32.0), Parameter("alpha", 0.01, 0.99))
PASSIVE = SearchSpace(MECHANICS, Mechanics(0.44, 0.95), (Constraint((("K1", 1.0), ("B1", 0.5)), most=12.0),))


@pytest.mark.deep  # it compiles the mechanics
def test_constraints_beside_the_passive_wall():
    for x in (PASSIVE.candidates(100, 0), PASSIVE.walls(100, 0), PASSIVE.latin_hypercube(5, 0)):
        physical = np.asarray(PASSIVE.to_physical(x))
        assert keeps(physical, PASSIVE.constraints[0], PASSIVE.names).all()
        margin = PASSIVE.passivity_margin(dict(zip(PASSIVE.names, physical.T, strict=True)))
        assert margin is not None and np.all(margin > 0)
    choice = highest(PASSIVE, jnp.array([1.0, 0.3, 0.2]), jnp.ones(3))
    K1, B1, _ = np.asarray(PASSIVE.to_physical(choice.x)).tolist()
    assert pytest.approx(12.0, abs=1e-6) == K1 + 0.5 * B1


RATIOS = (MECHANICS[0], Parameter("B1", 0.01, 32.0, scale="log"), MECHANICS[2])
GAIN = (*MECHANICS, Parameter("gain", 0.0, 10.0))


@pytest.mark.deep  # it compiles the mechanics
@pytest.mark.parametrize(
    ("parameters", "constraint"),
    [
        (MECHANICS, Constraint((("K1", 1.0), ("B1", -1.0)), least=2.0)),  # a lower end of the columns
        (MECHANICS, Constraint((("B1", 1.0), ("alpha", 20.0)), most=20.0)),
        (RATIOS, Constraint((("B1", 1.0), ("alpha", 20.0)), most=20.0)),  # B1 is linear in the box, logarithmic in x
        (GAIN, Constraint((("K1", 1.0), ("gain", 1.0)), most=12.0)),  # the columns depend on what is no mechanics
    ],
    ids=lambda value: value.words if isinstance(value, Constraint) else "",
)
def test_candidates_beside_the_passive_wall_are_even(parameters, constraint):
    space = SearchSpace(parameters, Mechanics(0.44, 0.95), (constraint,))
    cube = qmc.Sobol(space.dim, rng=7).random(2**18)
    usable = cube[np.asarray(space.feasible(cube))]
    ends = [(0.0, 1.0)] * space.dim
    shares = [np.histogramdd(x, 4, ends)[0] / len(x) for x in (space.candidates(2**14, 0), usable)]
    assert np.abs(shares[0] - shares[1]).sum() / 2 < 0.03


@pytest.mark.parametrize(
    ("constraints", "sentence"),
    [
        ([Constraint((("a", 1.0),), most=-1.0)], "constraints.1 leaves nothing of the ranges"),
        (
            [Constraint((("a", 1.0), ("c", 1.0)), least=8.0), Constraint((("a", 1.0),), most=2.0)],
            "constraints.2 contradicts the first within the ranges",
        ),
        (
            [
                Constraint((("a", 0.1), ("c", 1.0)), least=1.2),
                Constraint((("a", 1.0),), most=5.0),
                Constraint((("c", 1.0),), most=0.5),
            ],
            "constraints leave nothing of the ranges, all together",
        ),
        ([Constraint((("a", 1.0), ("c", 10.0)), most=0.0)], "constraints.1 leaves no more than an edge"),  # a corner
    ],
)
def test_constraints_that_leave_nothing_are_refused(constraints, sentence):
    with pytest.raises(InputError, match=sentence):
        check_room(BOX, constraints)


@pytest.mark.parametrize(
    ("constraint", "sentence"),
    [
        (Constraint((("z", 1.0),), most=1.0), "constraints.1.terms names z, which is no parameter"),
        (Constraint((("a", 0.0),), most=1.0), "has no weight but 0"),
        (Constraint((("a", np.inf),), most=1.0), "must be a finite number"),
        (Constraint((("a", 1e200), ("b", 1e200)), most=1.0), "constraints.1.terms has a sum too large or too small"),
        (Constraint((("a", 1e-200),), most=1.0), "constraints.1.terms has a sum too large or too small"),
        (Constraint((("a", 1.0),), most=np.inf), "constraints.1.most is inf; it must be a finite number, or be left"),
        (Constraint((("a", 1.0),), least=np.nan), "constraints.1.least is nan"),
        (Constraint((("a", 1.0),)), "has no least and no most"),
        (Constraint((("a", 1.0),), 3.0, 2.0), "least is 3.0; it must be below most = 2.0"),
    ],
)
def test_a_constraint_that_is_none_is_refused(constraint, sentence):
    with pytest.raises(InputError, match=sentence):
        Box(BOX, None, (constraint,))


def test_more_parameters_than_a_study_has_are_refused():
    with pytest.raises(InputError, match=r"parameters are 9, .* 8 at most"):
        Box(tuple(Parameter(f"p{i}", 0.0, 1.0) for i in range(9)))


def test_few_renderings_are_asked_in_turn_and_nothing_is_said_of_clusters(recwarn):
    whole = tuple(Parameter(name, 1.0, 3.0, integer=True) for name in ("a", "b"))
    space = SearchSpace(whole, None, (Constraint((("a", 1.0), ("b", 1.0)), most=3.0),))
    design = space.latin_hypercube(8, 0)
    assert len(np.unique(design, axis=0)) == 3 and len(np.unique(design[:3], axis=0)) == 3
    assert not recwarn.list
