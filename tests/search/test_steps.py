"""Whole numbers and levels: only their steps are drawn and chosen, and the best combination is found."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from hilltop import highest

from hilbo.errors import InputError
from hilbo.search.box import Constraint, Parameter
from hilbo.search.space import SearchSpace
from hilbo.search.steps import neighbours

COUNT = Parameter("count", 0.0, 6.0, integer=True)
SIZE = Parameter("size", 1.0, 64.0, scale="log", integer=True)
GAIN = Parameter("gain", 0.0, 1.0)
COUPLED = SearchSpace((COUNT, SIZE, GAIN), None, (Constraint((("count", 4.0), ("size", 1.0)), most=30.5),))


@pytest.mark.parametrize("draw", ["candidates", "walls", "latin_hypercube"])
def test_only_steps_are_drawn(draw):
    for space in (SearchSpace((COUNT, SIZE, GAIN)), COUPLED):
        physical = np.asarray(space.to_physical(getattr(space, draw)(64, 0)))
        assert np.all(physical[:, :2] % 1 == 0)
        assert space is not COUPLED or np.all(4 * physical[:, 0] + physical[:, 1] <= 30.5)


@pytest.mark.deep  # it compiles a search
def test_the_best_combination_is_chosen():
    top, sharpness = np.array([0.8, 0.9, 0.35]), np.array([1.0, 3.0, 2.0])
    choice = highest(COUPLED, top, sharpness)
    steps = np.array([c for c in itertools.product(range(7), range(1, 65)) if 4 * c[0] + c[1] <= 30.5], float)
    x = np.asarray(COUPLED.to_unit(np.column_stack([steps, np.full(len(steps), 0.35)])))
    best = -np.min((sharpness * (x - top) ** 2).sum(axis=1))
    assert float(choice.value) == pytest.approx(best, abs=1e-9)
    assert np.all(np.asarray(COUPLED.to_physical(choice.x))[:2] % 1 == 0)


def test_neighbours_are_a_step_away():
    x = COUPLED.to_unit(jnp.array([3.0, 8.0, 0.5]))
    near = np.asarray(COUPLED.to_physical(neighbours(COUPLED.parameters, False, x)))
    assert {2.0, 4.0, 1.0, 5.0} <= set(near[:, 0]) and {7.0, 9.0, 6.0, 10.0, 4.0, 12.0} <= set(near[:, 1])
    np.testing.assert_allclose(near[:, 2], 0.5)
    pairs = np.asarray(COUPLED.to_physical(neighbours(COUPLED.parameters, True, x)))
    assert [2.0, 9.0] in pairs[:, :2].tolist()


def test_ends_of_whole_numbers_are_whole():
    with pytest.raises(InputError, match=r"n\.high is 2\.5; it must be a whole number where integer"):
        Parameter("n", 0.0, 2.5, integer=True)
