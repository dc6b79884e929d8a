"""A cohort's map by every rule: against the rule's own form, and what a rule refuses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hilbo import RBF, OrdinalGP, OrdinalProbit, Trials, fit
from hilbo.errors import InputError
from hilbo.population.maps import even_rows, rule_map, share_of
from hilbo.population.pointwise import aggregate
from hilbo.population.rules.registry import POINTWISE
from hilbo.population.shared.hierarchical import fit_people, of_people, shared_posterior

GP = OrdinalGP(RBF(4.0, 1.3), OrdinalProbit((-0.5, 0.5), 0.5))
X = jnp.asarray(np.random.default_rng(9).uniform(size=(6, 2)))


def cohort(people=3, answers=6, seed=0):
    rng = np.random.default_rng(seed)
    each = [Trials.from_arrays(rng.uniform(size=(answers, 2)), rng.integers(0, 3, answers), 8) for _ in range(people)]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)


@pytest.mark.parametrize("rule", [rule for rule in POINTWISE if rule != "hierarchical"])
def test_rules_by_points_are_the_sums_over_people(rule):
    trials = cohort()
    map_ = rule_map(GP, trials, rule)
    each = jax.vmap(lambda t: fit(GP, t, throw=False))(trials)
    means, explained = jax.vmap(lambda p: p.predict_explained(X))(each)
    for a, b in zip(map_.predict(X), aggregate(rule, means, explained, 1.3), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10)
    np.testing.assert_array_equal(map_.newcomer(X)[1], map_.predict(X)[1])


def test_few_answers_are_merged_exactly_and_many_by_points():
    trials = cohort()
    share = jnp.asarray(0.6)
    exact = rule_map(GP, trials, "hierarchical", share=share)
    dense = fit_people(GP, of_people(trials), 0.6)
    for a, b in zip(exact.predict(X), shared_posterior(dense).predict(X), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)
    np.testing.assert_allclose(exact.newcomer(X)[1] - exact.predict(X)[1], 0.4 * 1.3, rtol=1e-12)
    points = rule_map(GP, trials, "hierarchical", share=share, largest=5)
    assert (exact.method, points.method) == ("exact", "by points")
    # A share of 1 is the committee, by points, and the pooled model, exactly.
    one = rule_map(GP, trials, "hierarchical", share=jnp.ones(()), largest=5)
    for a, b in zip(one.predict(X), rule_map(GP, trials, "bcm").predict(X), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10)
    same = rule_map(GP, trials, "hierarchical", share=jnp.ones(()))
    for a, b in zip(same.predict(X), rule_map(GP, trials, "pooled").predict(X), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)


def test_what_a_rule_cannot_do_is_refused():
    with pytest.raises(InputError, match="are too many"):
        rule_map(GP, cohort(), "pooled", largest=5)
    with pytest.raises(InputError, match='responses are from 1 participant; use "bcm"'):
        share_of(GP, cohort(people=1))
    with pytest.raises(InputError, match='the rule is "median"'):
        rule_map(GP, cohort(), "median")
    with pytest.raises(InputError, match="there are no responses"):
        rule_map(GP, jax.vmap(Trials)(*jax.tree.map(jnp.zeros_like, (*jax.tree.leaves(cohort()),))), "pooled")


def test_an_even_choice_of_people():
    trials = cohort(people=10)
    assert len(even_rows(trials, 60)) == 10
    assert len(even_rows(trials, 30)) == 5
    assert len(even_rows(trials, 1)) == 2


def test_one_category_only_still_gives_a_map():
    trials = cohort()
    same = jax.vmap(Trials)(trials.x, jnp.full_like(trials.q, 2), trials.mask)
    for rule in ("bcm", "pooled"):
        mean, variance = rule_map(GP, same, rule).predict(X)
        assert bool(jnp.all(mean > 0)) and bool(jnp.all(variance > 0))
    share = share_of(GP, same)
    assert 0 < float(share.mean) < 1 and bool(share.converged)
