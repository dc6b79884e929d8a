"""learnt-1, learnt-2 and learnt-3 on answers that say little or contradict each other: what cannot be known is said."""

import tomllib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from studies import SOUND

from hilbo.ordinal_gp import Trials
from hilbo.report.results import result
from hilbo.study.analysis.model_check import model_check
from hilbo.study.analysis.region import hyperparameter_draws, optimum_region
from hilbo.study.cohort import Cohort
from hilbo.study.config import Study
from hilbo.study.estimate.aggregate import aggregate_cohort
from hilbo.study.estimate.learnt import resolved

PEOPLE, ANSWERS = 6, 12
NOWHERE = "Inconclusive: "

pytestmark = pytest.mark.deep  # a search of hyperparameters, and of the map, for each


def cohort(each):
    trials = jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)
    return Cohort(trials, np.asarray(trials.x), tuple(f"P{j}" for j in range(len(each))))


def person(rng, judge, count=ANSWERS):
    x = rng.uniform(size=(count, 2))
    return Trials.from_arrays(x, judge(x, rng), ANSWERS)


def likes_one_place(x, rng):
    felt = np.hypot(*(x - 0.4).T) + 0.1 * rng.normal(size=len(x))
    return (felt < 0.5).astype(int) + (felt < 0.25)


BEFORE_A_RELEASE = [pytest.param(rule, marks=pytest.mark.release) for rule in ("learnt-2", "learnt-3")]


@pytest.fixture(params=["learnt-1", *BEFORE_A_RELEASE])
def rule(request):
    return request.param


@pytest.fixture
def said(rule):
    """Makes result.json of some answers, and its warnings."""
    study = Study.from_dict(tomllib.loads(SOUND.replace("learnt-1", rule)))

    def of(answers):
        learnt = resolved(study, answers)
        aggregate = aggregate_cohort(learnt, answers, alternatives=False)
        region = optimum_region(learnt, aggregate.map, hyperparameter_draws(learnt, answers.trials))
        content = result(learnt, aggregate, 0, region=region, check=model_check(learnt, aggregate))
        unit = np.array(content["optimum"]["unit"])
        assert np.isfinite(unit).all() and ((unit >= 0) & (unit <= 1)).all()
        chances = np.array(list(content["optimum"]["class_probabilities"].values()))
        assert np.isfinite(chances).all() and chances.sum() == pytest.approx(1.0, abs=1e-12)
        return content, " ".join(content["warnings"])

    return of


@pytest.mark.parametrize("category", [0, 1, 2])
def test_everybody_always_says_the_same(category, said):
    rng = np.random.default_rng(0)
    content, words = said(cohort([person(rng, lambda x, _: np.full(len(x), category)) for _ in range(PEOPLE)]))
    assert NOWHERE in words
    assert {"theta.level", "theta.tone"} <= set(content["learnt"]["not_identified"])
    assert "The data do not constrain" in words


def test_two_people(said):
    rng = np.random.default_rng(1)
    content, _ = said(cohort([person(rng, likes_one_place) for _ in range(2)]))
    low, high = content["learnt"]["intervals"]["own"]
    assert high > 10 * low  # how two people differ says little of how people differ


def test_one_trial_each(said, rule):
    rng = np.random.default_rng(2)
    content, words = said(cohort([person(rng, likes_one_place, 1) for _ in range(PEOPLE)]))
    assert NOWHERE in words
    tone = {"theta.tone"} if rule == "learnt-1" else set()  # the others' wider prior gives way even to six answers
    assert {"theta.level", "own"} | tone <= set(content["learnt"]["not_identified"])


def test_answers_by_dice(said):
    rng = np.random.default_rng(3)
    content, words = said(cohort([person(rng, lambda x, r: r.integers(0, 3, len(x))) for _ in range(PEOPLE)]))
    assert NOWHERE in words
    assert max(content["optimum"]["class_probabilities"].values()) < 0.6


def test_the_same_rendering_gets_every_answer(said):
    """Three points, each asked four times of everybody, with all answers: nothing tells them apart."""
    rng = np.random.default_rng(4)
    places = rng.uniform(size=(3, 2))
    x, q = np.repeat(places, 4, axis=0), np.tile([0, 1, 2, 1], 3)
    content, words = said(cohort([Trials.from_arrays(x, q, ANSWERS) for _ in range(PEOPLE)]))
    assert NOWHERE in words
    assert content["learnt"]["converged"]


def test_forty_people_who_answer_alike(said):
    """One table forty times: they share everything, and the optimum is where that one person has it."""
    one = person(np.random.default_rng(5), likes_one_place)
    content, _ = said(cohort([one] * 40))
    assert content["learnt"]["share"] > 0.9
    assert np.hypot(*(np.array(content["optimum"]["unit"]) - 0.4)) < 0.2


def test_two_groups_that_say_the_opposite(said):
    rng = np.random.default_rng(6)
    each = [person(rng, likes_one_place) for _ in range(3)]
    each += [person(rng, lambda x, r: 2 - likes_one_place(x, r)) for _ in range(3)]
    content, _ = said(cohort(each))
    assert content["learnt"]["share"] < 0.6
    assert content["optimum"]["class_probabilities"]["good"] < 0.8
