"""learnt-3: participants who differ in sensitivity about the highest threshold, and the integral over how much."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hilbo import Trials
from hilbo.population.learnt.factors import _with_sensitivities
from hilbo.population.learnt.posterior import KERNELS, NOTHING, cost_at, medians
from hilbo.population.learnt.rule import learn
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
    assert bool(end.converged) and end.gain_of_factors > 3 and end.model.sensitivity
    found = -np.asarray(end.coordinates["widths"])
    assert found[1::2].min() > found[::2].max() and 0.4 < float(end.scale.sd) < 1.3
    assert np.corrcoef(found, true)[0, 1] > 0.9


def test_people_who_are_alike_have_one_or_nearly():
    end = learn(people(np.zeros(10)), 3, recipe=LEARNT_3)
    assert bool(end.converged) and (end.scale is None or float(end.scale.sd) < 0.25)


@pytest.mark.release
def test_two_categories_have_sensitivities():
    trials = people(np.array([-1.0, 1.0] * 4))
    two = eqx.tree_at(lambda t: t.q, trials, (trials.q > 1).astype(trials.q.dtype))
    end = learn(two, 2, recipe=LEARNT_3)
    found = -np.asarray(end.coordinates["widths"])
    assert bool(end.converged) and found[1::2].mean() > found[::2].mean() + 0.3


def test_the_cost_has_the_integral_over_sensitivities():
    """Of two people, by a grid over both: exp(log evidence) times the prior; other coordinates stay."""
    answers = tallied(people((-0.5, 0.5), 40), 3)
    start = medians(answers, NOTHING, LEARNT_3.priors, KERNELS[LEARNT_3.kernel])
    search, problem = searched(
        *first_search(start, answers, NOTHING, LEARNT_3), frozenset(start) - {"widths", "sensitivity"}
    )
    search, problem = _with_sensitivities(search, problem, frozenset(start))
    sd = float(np.exp(search.coordinates["sensitivity"]))
    nodes, weights = np.polynomial.hermite_e.hermegauss(24)
    logs = np.array(
        [
            [
                cost_at(search.coordinates | {"widths": jnp.asarray([a, b])}, search.cost.weights, problem).log_evidence
                for b in sd * nodes
            ]
            for a in sd * nodes
        ]
    )
    weights = weights / weights.sum()
    expected = np.log(np.sum(np.outer(weights, weights) * np.exp(logs - logs.max()))) + logs.max()
    widths, information = np.asarray(search.coordinates["widths"]), np.asarray(problem.information)
    by_laplace = (
        float(search.cost.log_evidence) - 0.5 * np.sum((widths / sd) ** 2) - 0.5 * np.sum(np.log1p(sd**2 * information))
    )
    np.testing.assert_allclose(by_laplace, expected, atol=0.15)


@pytest.mark.release
def test_people_outside_of_a_sample_have_sensitivities():
    true = np.array([-0.8, 0.8] * 6)
    some = learn_from_sample(people(true), 3, recipe=LEARNT_3, most=8)
    found = -np.asarray(some.model.log_widths)
    assert bool(some.converged) and some.people == 8 and found[1::2].min() > found[::2].max()
