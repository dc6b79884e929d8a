"""learnt-3: participants who differ in sensitivity and width, and the integral over how much."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hilbo import Trials
from hilbo.population.learnt.factors import _with_sensitivities
from hilbo.population.learnt.posterior import KERNELS, NOTHING, cost_at, medians
from hilbo.population.learnt.rule import drawn_maps, learn
from hilbo.population.learnt.sample import learn_from_sample
from hilbo.population.learnt.search import first_search, searched
from hilbo.population.rules.recipes import LEARNT_3
from hilbo.population.shared.tallies import tallied

pytestmark = pytest.mark.deep  # searches of their own


def people(log_sensitivities, answers=60, seed=0):
    """Stacked trials of people whose function is one function, about the highest threshold, times their sensitivity."""
    rng, each = np.random.default_rng(seed), []
    for log_sensitivity in log_sensitivities:
        x = rng.uniform(size=(answers, 2))
        above = 3.0 * np.sin(4.0 * x[:, 0]) + x[:, 1] - 2.0
        felt = np.exp(log_sensitivity) * above + rng.normal(size=answers)
        each.append(Trials.from_arrays(x, (felt > -1.5).astype(int) + (felt > 0.0), answers))
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *each)


def test_sensitivities_are_found_where_people_have_them():
    true = np.array([-0.8, 0.8] * 5)
    end = learn(people(true), 3, recipe=LEARNT_3)
    assert bool(end.converged) and end.gains["sensitivities"] > 3
    found = np.asarray(end.coordinates["sensitivities"])
    assert found[1::2].min() > found[::2].max() and 0.4 < float(end.scale.sensitivity) < 1.3
    assert np.corrcoef(found, true)[0, 1] > 0.9


def test_people_who_are_alike_have_one_or_nearly():
    end = learn(people(np.zeros(10)), 3, recipe=LEARNT_3)
    assert bool(end.converged) and (end.scale is None or float(end.scale.sensitivity) < 0.25)
    assert "widths" not in end.coordinates


@pytest.mark.release
def test_two_categories_have_sensitivities():
    trials = people(np.array([-1.0, 1.0] * 4))
    two = eqx.tree_at(lambda t: t.q, trials, (trials.q > 1).astype(trials.q.dtype))
    end = learn(two, 2, recipe=LEARNT_3)
    found = np.asarray(end.coordinates["sensitivities"])
    assert bool(end.converged) and "widths" not in end.gains and found[1::2].mean() > found[::2].mean() + 0.3


def test_the_cost_has_the_integral_over_sensitivities():
    """Of two people, by a grid over both: exp(log evidence) times the prior; other coordinates stay."""
    answers = tallied(people((-0.5, 0.5), 40), 3)
    start = medians(answers, NOTHING, LEARNT_3.priors, KERNELS[LEARNT_3.kernel])
    common = frozenset(start) - {"widths"}
    search, problem = searched(*first_search(start, answers, NOTHING, LEARNT_3), common)
    search, problem = _with_sensitivities(search, problem, 1.0)
    sd = float(np.exp(search.coordinates["spread"]))
    nodes, weights = np.polynomial.hermite_e.hermegauss(24)

    def log_evidence(pair):
        moved = search.coordinates | {"sensitivities": jnp.asarray(pair)}
        return float(cost_at(moved, search.cost.weights, problem).log_evidence)

    logs = np.array([[log_evidence((a, b)) for b in sd * nodes] for a in sd * nodes])
    weights = weights / weights.sum()
    expected = np.log(np.sum(np.outer(weights, weights) * np.exp(logs - logs.max()))) + logs.max()
    at_mode, information = np.asarray(search.coordinates["sensitivities"]), np.asarray(problem.information)
    prior_and_integral = -0.5 * np.sum((at_mode / sd) ** 2 + np.log1p(sd**2 * information))
    by_laplace = float(search.cost.log_evidence) + prior_and_integral
    np.testing.assert_allclose(by_laplace, expected, atol=0.15)


@pytest.mark.release
def test_people_outside_of_a_sample_have_sensitivities():
    true = np.array([-0.8, 0.8] * 6)
    some = learn_from_sample(people(true), 3, recipe=LEARNT_3, most=8)
    found = np.asarray(some.model.log_sensitivities)
    assert bool(some.converged) and some.people == 8 and found[1::2].min() > found[::2].max()


def test_people_differ_in_widths_beside_sensitivities():
    """Widths are tried after sensitivities, with them, and are kept where people have both."""
    rng, each = np.random.default_rng(3), []
    log_widths, log_sensitivities = np.tile([-0.9, 0.9], 6), np.repeat([-0.7, 0.7], 6)
    for log_width, log_sensitivity in zip(log_widths, log_sensitivities, strict=True):
        x = rng.uniform(size=(80, 2))
        edges = np.exp(log_width) * np.array([-0.6, 0.0, 0.6])
        above = 3.0 * np.sin(4.0 * x[:, 0]) + x[:, 1] - 1.4 - edges[-1]
        felt = edges[-1] + np.exp(log_sensitivity) * above + rng.normal(size=80)
        each.append(Trials.from_arrays(x, (felt[:, None] > edges).sum(axis=1), 80))
    end = learn(jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *each), 4, recipe=LEARNT_3)
    assert bool(end.converged) and end.gains["sensitivities"] > 3 and end.gains["widths"] > 3
    for name, true in (("widths", log_widths), ("sensitivities", log_sensitivities)):
        assert np.corrcoef(np.asarray(end.coordinates[name]), true)[0, 1] > 0.9 and np.all(np.asarray(end.sd[name]) < 1)
    assert end.scale.width is not None and float(end.scale.sensitivity) > 0.4 and end.model.fixed_point == 1.0


@pytest.mark.release
def test_the_middle_is_the_fixed_point_where_people_have_it():
    """In a sample, too, and in drawn maps. Scales of 8 categories, as of confidence in one of two answers."""
    rng, each = np.random.default_rng(5), []
    true = np.array([-0.8, 0.8] * 20)
    for log_sensitivity in true:
        x = rng.uniform(size=(60, 2))
        felt = np.exp(log_sensitivity) * (4.0 * np.sin(6.0 * x[:, 0]) + x[:, 1]) + rng.normal(size=60)
        edges = np.exp(log_sensitivity) * np.linspace(-3.0, 3.0, 7)
        each.append(Trials.from_arrays(x, (felt[:, None] > edges).sum(axis=1), 60))
    trials = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *each)
    some = learn_from_sample(trials, 8, recipe=LEARNT_3, most=34)
    assert bool(some.converged) and some.model.fixed_point == 0.0
    assert np.corrcoef(np.asarray(some.model.log_sensitivities), true)[0, 1] > 0.9
    assert all(np.all(np.isfinite(some.sd[name])) for name in ("theta", "spread", "sensitivities"))
    drawn = drawn_maps(some, trials, NOTHING, 0, 2)
    assert drawn and all(one.scale.fixed_point == 0.0 for one in drawn)
