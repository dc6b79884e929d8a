"""The search for hyperparameters by costs that are known: where it goes, and when it has ended."""

import jax.numpy as jnp
import numpy as np
import pytest

from hilbo.kernels import RBF
from hilbo.population.learnt import search
from hilbo.population.learnt.posterior import NOTHING, Cost
from hilbo.population.learnt.search import first_search, searched
from hilbo.population.rules.recipes import LEARNT_1
from hilbo.population.shared.features import pivots_for, unexplained
from hilbo.population.shared.tallies import Tallies

COMMON = frozenset({"theta", "shared"})


def one_answer():
    return Tallies(jnp.full((1, 1, 2), 0.5), jnp.array([[[1.0, 0.0]]]))


def searched_by(monkeypatch, cost, theta=(0.0, 0.0)):
    """The end of a search from `theta` and log shared variance 0; `cost`: of both, a value, slopes, and usable."""
    places = []

    def cost_at(coordinates, weights, problem):
        z = np.append(coordinates["theta"], coordinates["shared"])
        places.append(z - np.append(np.log(problem.theta), 0.0))
        value, slope, usable = cost(z)
        gradient = {"theta": jnp.asarray(slope[:2]), "shared": jnp.asarray(slope[2])}
        return Cost(jnp.asarray(value), gradient, jnp.asarray(-value), weights, jnp.asarray(usable))

    monkeypatch.setattr(search, "cost_at", cost_at)
    start = {"theta": jnp.asarray(theta), "shared": jnp.asarray(0.0), "own": jnp.asarray(0.0)}
    start |= {"middle": jnp.asarray(0.0), "gaps": jnp.zeros(0)}
    return searched(*first_search(start, one_answer(), NOTHING, LEARNT_1), COMMON)[0], np.array(places)


def bowl(z, lowest=(3.0, -4.0, 2.0)):
    off = z - np.array(lowest)
    return 50.0 + 20.0 * np.sum(off**2), 40.0 * off, True


def test_lengths_far_away_are_reached_by_short_ways_each_with_features_of_its_own(monkeypatch):
    end, places = searched_by(monkeypatch, bowl)
    assert end.ended
    np.testing.assert_allclose(np.append(end.coordinates["theta"], end.coordinates["shared"]), (3, -4, 2), atol=1e-2)
    assert np.abs(places[:, :2]).max() < 1.5 + 1e-9
    np.testing.assert_allclose(end.cost.value, bowl(np.append(end.coordinates["theta"], end.coordinates["shared"]))[0])


@pytest.mark.parametrize("limit", [0.3, -1.0])
def test_a_search_that_is_stopped_by_unusable_costs_has_not_ended(monkeypatch, limit):
    """From where it has come to, or from its start."""
    end, _ = searched_by(monkeypatch, lambda z: (*bowl(z)[:2], bool(z[2] < limit)))
    assert not end.ended
    assert limit < 0 or end.coordinates["shared"] < limit


def test_features_that_are_asked_for_again_and_again_end_a_search(monkeypatch):
    end, places = searched_by(monkeypatch, lambda z: (-20.0 * z[0], np.array([-20.0, 0.0, 0.0]), True))
    assert not end.ended
    assert len(places) < 100


def test_a_search_that_runs_out_of_steps_has_not_ended(monkeypatch):
    monkeypatch.setattr(search, "_STEPS", 1)
    end, _ = searched_by(monkeypatch, lambda z: bowl(z**3 / 9), (0.5, -0.5))
    assert not end.ended


@pytest.mark.parametrize("level", [0.0, 2e4, -3e5])
def test_a_search_ends_as_near_the_maximum_by_many_answers_as_by_few(monkeypatch, level):
    """Costs grow with the answers, what a hyperparameter may still be does not: within a tenth of its own error."""

    def valley(z):
        along, across = z[0] + z[2], np.array([z[0] - z[2], z[1]])
        slope = np.array([2e-2 * along**3 + 2e3 * across[0], 2e3 * across[1], 2e-2 * along**3 - 2e3 * across[0]])
        return level + 5e-3 * along**4 + 1e3 * np.sum(across**2), slope, True

    end, _ = searched_by(monkeypatch, valley, (1.0, 1.0))
    assert end.ended and float(end.cost.value) - level < 0.005


def test_pivots_leave_what_they_say_and_are_no_more_than_wanted():
    rng = np.random.default_rng(0)
    answers = Tallies(jnp.asarray(rng.uniform(size=(4, 75, 2))), jnp.ones((4, 75, 3)))
    rough, smooth = RBF(jnp.array([60.0, 60.0])), RBF(jnp.array([1e-3, 1e-3]))
    for kernel, most, rank, used in (
        (rough, 1024, 256, (64, 256)),
        (rough, 50, 64, (50, 50)),
        (smooth, 1024, 32, (2, 9)),
    ):
        pivots = pivots_for(kernel, answers, 1e-4, most=most)
        assert len(pivots.points) == rank
        assert used[0] <= int(pivots.used.sum()) <= used[1]
        assert (float(pivots.left) <= 1e-4) == (most == 1024)
        np.testing.assert_allclose(unexplained(kernel, answers, pivots), pivots.left, atol=1e-9)
    assert len(pivots_for(smooth, answers, 1e-4, fewest=128).points) == 128
