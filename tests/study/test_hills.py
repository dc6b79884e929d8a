"""Hills of a map: tops, centres and probabilities, on maps whose hills are known."""

import numpy as np
import pytest
from scipy.stats import qmc

from hilbo.kernels import RBF
from hilbo.study.analysis.hills import hills_of

POINTS = qmc.Sobol(2, seed=0).random(1024)
THETA = np.array([6.0, 6.0])
SURE = np.full(len(POINTS), 1e-4)


def bump(centre, width=0.15):
    return np.exp(-0.5 * ((POINTS - centre) ** 2).sum(axis=1) / width**2)


def test_one_hill_has_everything():
    height = bump([0.3, 0.6], 0.5)
    weight = bump([0.3, 0.6], 0.05)
    (hill,) = hills_of(POINTS, height, SURE, weight / weight.sum(), RBF(THETA))
    assert hill.probability == pytest.approx(1.0)
    np.testing.assert_allclose(hill.top, [0.3, 0.6], atol=0.03)
    np.testing.assert_allclose(hill.centre, [0.3, 0.6], atol=0.02)


def test_two_hills_share_the_draws_by_where_they_fell():
    first, second = bump([0.2, 0.2]), bump([0.8, 0.8])
    weight = 0.7 * first / first.sum() + 0.3 * second / second.sum()
    one, other = hills_of(POINTS, first + 1.2 * second, SURE, weight, RBF(THETA))
    assert (one.probability, other.probability) == pytest.approx((0.7, 0.3), abs=0.01)
    np.testing.assert_allclose(one.top, [0.2, 0.2], atol=0.04)
    np.testing.assert_allclose(other.centre, [0.8, 0.8], atol=0.03)


def test_probabilities_add_up_to_the_draws_but_for_rare_hills():
    """Rugged maps: hills are disjoint, and every point belongs to one."""
    rng = np.random.default_rng(0)
    for _ in range(6):
        weight = rng.dirichlet(np.full(len(POINTS), 0.05))
        hills = hills_of(POINTS, rng.normal(size=len(POINTS)), SURE, weight, RBF(THETA))
        total = sum(hill.probability for hill in hills)
        assert 0.5 < total <= 1.0 + 1e-12
        assert list(hills) == sorted(hills, key=lambda hill: -hill.probability)


def test_the_centre_of_a_plateau_is_in_its_middle():
    """Flat from 0.2 to 0.6, highest by a hair at one end: draws fall all over it."""
    flat = (np.abs(POINTS[:, 0] - 0.4) < 0.2) & (np.abs(POINTS[:, 1] - 0.5) < 0.2)
    height = np.where(flat, 1.0 + 1e-6 * POINTS[:, 0], 0.5 * bump([0.4, 0.5], 0.3))
    hill = hills_of(POINTS, height, SURE, flat / flat.sum(), RBF(THETA))[0]
    assert hill.top[0] > 0.55
    np.testing.assert_allclose(hill.centre, [0.4, 0.5], atol=0.02)


def test_a_dip_that_the_answers_do_not_show_is_none():
    first, second = bump([0.2, 0.2]), bump([0.8, 0.8])
    weight = first + second
    (hill,) = hills_of(POINTS, first + second, np.ones(len(POINTS)), weight / weight.sum(), RBF(THETA))
    assert hill.probability == pytest.approx(1.0)
