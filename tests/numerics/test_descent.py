"""Descents by L-BFGS-B: the lowest point met, where it starts and ends, and values that are not finite."""

import numpy as np
import pytest

from hilbo.numerics.descent import Point, descended

LOWEST = np.array([1.0, -2.0])


def bowl(seen, edge=np.inf):
    """A quadratic, not finite where the first variable exceeds `edge`; `seen` collects the points."""

    def function(x):
        seen.append(x.copy())
        value = float(np.sum((x - LOWEST) ** 2)) if x[0] < edge else np.inf
        return Point(value, 2 * (x - LOWEST), tuple(x))

    return function


def test_it_ends_at_the_minimum_and_evaluates_no_point_twice():
    seen, begin = [], np.zeros(2)
    function = bowl(seen)
    end = descended(function, begin, function(begin), 1e-9)
    assert end.ended and end.steps > 0
    np.testing.assert_allclose(end.lowest, LOWEST, atol=1e-3)
    assert len({tuple(x) for x in seen}) == len(seen)


def test_it_stays_within_its_bounds():
    end = descended(bowl([]), np.zeros(2), bowl([])(np.zeros(2)), 1e-9, [(-0.5, 0.5), (-0.5, 0.5)])
    assert end.lowest == (0.5, -0.5)


@pytest.mark.parametrize("edge", [0.9, -1.0])
def test_a_value_that_is_not_finite_ends_it_at_the_lowest_point_met(edge):
    """On its way, or at its start."""
    function = bowl([], edge)
    end = descended(function, np.zeros(2), function(np.zeros(2)), 1e-9)
    assert not end.ended
    assert end.lowest[0] < max(edge, 1e-9)
