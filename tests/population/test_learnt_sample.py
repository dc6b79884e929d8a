"""Hyperparameters of a crowd from a sample of its people."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hilbo import Trials
from hilbo.population.learnt.rule import learn, learnt_function
from hilbo.population.learnt.sample import learn_from_sample
from hilbo.population.rules.recipes import LEARNT_2

PEOPLE, ANSWERS = 12, 20


def answers(silent=()):
    """People who like one place."""
    rng = np.random.default_rng(1)
    each = []
    for j in range(PEOPLE):
        x = rng.uniform(size=(ANSWERS, 2))
        felt = 3 * (0.5 - np.hypot(*(x - 0.4).T)) + 0.1 * rng.normal(size=ANSWERS)
        q = (felt > -0.4).astype(int) + (felt > 0.4)
        held = 0 if j in silent else ANSWERS
        each.append(Trials.from_arrays(x[:held].reshape(-1, 2), q[:held], ANSWERS))
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *each)


@pytest.mark.deep
def test_few_people_are_all_learnt_from():
    trials = answers()
    some, everybody = (each(trials, 3, recipe=LEARNT_2) for each in (learn_from_sample, learn))
    for a, b in zip(jax.tree.leaves(some), jax.tree.leaves(everybody), strict=True):
        np.testing.assert_array_equal(a, b)
    assert some.people == PEOPLE


@pytest.mark.deep
def test_the_map_is_of_everybody_s_answers():
    trials = answers(silent=(3,))
    some = learn_from_sample(trials, 3, recipe=LEARNT_2, most=6)
    assert bool(some.converged) and some.people == 6 and some.weights.shape == (PEOPLE, ANSWERS)
    function = learnt_function(some, trials).function
    assert bool(function.certificate.converged)
    by_all = learnt_function(learn(trials, 3, recipe=LEARNT_2), trials).function
    x = jnp.asarray(np.random.default_rng(2).uniform(size=(40, 2)))
    mean, sd = np.asarray(function.predict(x)[0]), np.asarray(by_all.predict(x)[1]) ** 0.5
    scale = float(by_all.predict(x)[0] @ mean) / float(mean @ mean)  # in units of a noise that is learnt as well
    assert np.abs(scale * mean - np.asarray(by_all.predict(x)[0])).max() < 3 * sd.max()


@pytest.mark.deep
def test_people_outside_of_the_sample_have_widths_of_their_own():
    """Half of the people have a wide middle category, half a narrow one."""
    rng, each = np.random.default_rng(0), []
    for j in range(10):
        x = rng.uniform(size=(60, 2))
        felt = 2.0 * np.sin(4.0 * x[:, 0]) + x[:, 1] + rng.normal(size=60)
        half = 2.2 if j % 2 else 0.25
        each.append(Trials.from_arrays(x, (felt > 0.5 - half).astype(int) + (felt > 0.5 + half), 60))
    trials = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *each)
    some = learn_from_sample(trials, 3, recipe=LEARNT_2, most=7)
    widths = np.asarray(some.model.log_widths)
    assert some.scale is not None and bool(some.converged) and widths[1::2].min() > widths[::2].max() + 0.5
    np.testing.assert_array_equal(some.coordinates["widths"], widths)
    assert np.all(np.asarray(some.sd["widths"]) < 1)
    assert bool(learnt_function(some, trials).function.certificate.converged)
