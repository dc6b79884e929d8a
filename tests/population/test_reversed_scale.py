"""Participants who take the lowest response for the highest are named; nobody else, and nothing is changed."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hilbo.ordinal_gp import RBF, OrdinalGP, OrdinalProbit, Trials
from hilbo.population.judged.reversed_scale import log_factors, reversed_people

GP = OrdinalGP(RBF(8.0), OrdinalProbit((-0.4, 0.4), 0.3))
SHARE = jnp.asarray(0.9)
PEOPLE, ANSWERS = 8, 16


@pytest.fixture(scope="module")
def trials():
    """Responses of participants with one common hill at (0.7, 0.4)."""
    rng = np.random.default_rng(0)
    x = rng.uniform(size=(PEOPLE, ANSWERS, 2))
    score = 1.0 - 8.0 * np.sum((x - [0.7, 0.4]) ** 2, axis=2) + 0.3 * rng.normal(size=(PEOPLE, ANSWERS))
    q = np.digitize(score, [-0.4, 0.4])
    mask = np.ones(q.shape, bool)
    return jax.vmap(Trials)(jnp.asarray(x), jnp.asarray(q, jnp.int32), jnp.asarray(mask))


def turned(trials, rows):
    """The trials with the scale of these participants reversed."""
    return eqx.tree_at(lambda t: t.q, trials, trials.q.at[jnp.asarray(rows)].set(2 - trials.q[jnp.asarray(rows)]))


def test_nobody_is_named_without_a_reason(trials):
    assert reversed_people(GP, trials, SHARE) == {}


@pytest.mark.parametrize("rows", [[3], [0, 5]])
def test_reversed_participants_are_named(trials, rows):
    factors = reversed_people(GP, turned(trials, rows), SHARE)
    assert set(factors) == set(rows) and min(factors.values()) > 2.0


def test_the_factor_changes_its_sign_with_the_scale(trials):
    """Of the same participant, with the same map of the others."""
    every = np.ones(PEOPLE, bool)
    given, other = (log_factors(GP, each, SHARE, every)[2] for each in (trials, turned(trials, [2])))
    assert given < -5 and other == pytest.approx(-given, rel=1e-9)


def test_participants_without_responses_count_for_nothing(trials):
    rest = eqx.tree_at(lambda t: t.mask, turned(trials, [3]), trials.mask.at[0].set(False))
    assert set(reversed_people(GP, rest, SHARE)) == {3}
    few = eqx.tree_at(lambda t: t.mask, trials, trials.mask.at[2:].set(False))
    assert reversed_people(GP, few, SHARE) == {}
