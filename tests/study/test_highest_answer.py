"""The probability of the highest answer, and an interval of what is not known of the map."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm
from studies import plain

from hilbo import RBF, OrdinalGP, OrdinalProbit, Trials, fit
from hilbo.population.learnt.rule import DrawnMap
from hilbo.population.maps import RuleMap
from hilbo.population.shared.people_model import PeopleModel
from hilbo.population.shared.scale_use import ScaleUse
from hilbo.study.analysis.highest_answer import highest_answer
from hilbo.study.analysis.tolerance import dominant

GP = OrdinalGP(RBF(6.0, 3.0), OrdinalProbit((-0.5, 0.5), 0.5))
SHARE, PRIOR = jnp.asarray(0.6), jnp.asarray(5.0)
STUDY = dataclasses.replace(plain(), gp=OrdinalGP(RBF(6.0, 5.0), GP.likelihood))
X = np.array([0.4, 0.6])


@pytest.fixture(scope="module")
def function():
    rng = np.random.default_rng(0)
    return fit(GP, Trials.from_arrays(rng.uniform(size=(12, 2)), rng.integers(0, 3, 12), 12))


def map_of(function, scale, rule="learnt-3"):
    return RuleMap(rule, "exact", None, function, SHARE, PRIOR, None, scale)


def chance(function, shift, sd):
    """Of the highest answer of a person whose own part has the variance 2 and whose log factor is N(0, sd^2), where the
    shared function is `shift` standard deviations from its mean."""
    mean, variance = (float(value[0]) for value in function.predict(X[None]))
    g = mean + shift * np.sqrt(variance)

    def given(w):
        return norm.cdf((g - 0.5) / np.sqrt(0.25 * np.exp(2 * w) + 2.0)) * norm.pdf(w, 0.0, sd)

    return quad(given, -6 * sd, 6 * sd)[0]


@pytest.mark.parametrize("sd", [1e-3, 0.5])
def test_the_interval_is_of_the_shared_function(function, sd):
    found = highest_answer(STUDY, map_of(function, ScaleUse(sensitivity=jnp.asarray(sd))), X)
    np.testing.assert_allclose([found.low, found.high], [chance(function, z, sd) for z in (-1.96, 1.96)], atol=2e-3)
    expected = quad(lambda z: chance(function, z, sd) * norm.pdf(z), -6, 6)[0]
    assert found.low < found.probability < found.high and found.probability == pytest.approx(expected, abs=2e-4)


def test_drawn_hyperparameters_widen_it(function):
    """Two draws, of which the second has a highest threshold that is far lower."""
    model = PeopleModel.of(STUDY.gp, SHARE, 3)
    lower = dataclasses.replace(model, thresholds=model.thresholds - 2.0)
    plain_ = highest_answer(STUDY, map_of(function, None), X)
    drawn = highest_answer(STUDY, map_of(function, None), X, [DrawnMap(function, m, None) for m in (model, lower)])
    assert drawn.probability == plain_.probability and drawn.high > plain_.high + 0.1
    assert drawn.low == pytest.approx(plain_.low, abs=0.05)


@pytest.mark.parametrize("rule", ["pooled", "learnt-2"])
def test_methods_that_do_not_predict_it_do_not_say_it(function, rule):
    assert highest_answer(STUDY, map_of(function, None, rule), X) is None


def test_tolerances_are_read_where_a_new_participant_s_likeliest_response_is_the_highest(function):
    """With sensitivities, which change the other responses' probabilities: as the figure of the classes has it."""
    scale = ScaleUse(sensitivity=jnp.asarray(0.8))
    map_ = map_of(function, scale)
    x = jnp.asarray(np.random.default_rng(1).uniform(size=(400, 2)))
    chances = np.asarray(map_.class_probabilities(GP.likelihood, x))
    leads = np.asarray(dominant(STUDY, map_.newcomer, x, scale))
    np.testing.assert_array_equal(leads, chances[:, -1] > chances[:, :-1].max(axis=1))
    assert np.any(leads != np.asarray(dominant(STUDY, map_.newcomer, x)))
