"""Studies whose goal is another response than the highest: mirrored scales, and exhaustive searches."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm
from studies import paper_counts

from hilbo import OrdinalProbit, Study, Trials, acquisition, fit
from hilbo.errors import InputError
from hilbo.likelihoods import Goal
from hilbo.population.maps import RuleMap, rule_map
from hilbo.population.newcomer import log_goal
from hilbo.report.validation import validate
from hilbo.search.candidates import search_points
from hilbo.session.choose.selection import design, next_point
from hilbo.simulation.power import Plan, simulate_power
from hilbo.simulation.presets import PRESETS
from hilbo.study.analysis.best_mid_worst import best_mid_worst
from hilbo.study.analysis.region import optimum_region, region_sentences
from hilbo.study.analysis.tolerance import tolerance
from hilbo.study.cohort import Cohort
from hilbo.study.estimate.aggregate import fit_cohort
from hilbo.study.estimate.bootstrap import resampled_tops
from hilbo.study.estimate.optimum import individual_optima, map_optimum, score
from hilbo.study.tables.validation import RESPONSES

LIKELIHOOD = OrdinalProbit((-1.0, 0.2, 1.5), 0.6)
MEAN, VARIANCE = jnp.linspace(-4.0, 4.0, 33), jnp.linspace(0.01, 2.0, 33)
SCALE = ("too soft", "as the real one", "too hard")


def study_of(goal, responses=SCALE, thresholds=(-0.7, 0.4), parameters=("gain",), **selection):
    """A study of these parameters from 0 to 1, with the goal."""
    return Study.from_dict({
        "schema": 1,
        "study": {"name": "goal", "responses": list(responses)} | ({"goal": goal} if goal else {}),
        "parameters": {name: {"low": 0.0, "high": 1.0} for name in parameters},
        "gp": {"theta": [4.0] * len(parameters), "variance": 2.0, "thresholds": list(thresholds), "noise": 0.5},
        "selection": {"trials": 12, "space_filling": 4} | selection,
        "aggregation": {"rule": "bcm"},
    })  # fmt: skip


def answers(dim, people=3, seed=0):
    """Responses to a scale that rises along the first parameter, and falls again in the others."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(size=(people, 12, dim))
    f = 4.0 * (x[..., 0] - 0.45) - 3.0 * np.sum((x[..., 1:] - 0.5) ** 2, axis=-1) + 0.5 * rng.normal(size=(people, 12))
    q = np.searchsorted([-0.7, 0.4], f.ravel()).reshape(people, 12)
    return jax.vmap(lambda x, q: Trials(x, q, jnp.ones(12, bool)))(jnp.asarray(x), jnp.asarray(q))


def mirrored(trials):
    return eqx.tree_at(lambda t: t.q, trials, 2 - trials.q)


def first(trials):
    return jax.tree.map(lambda leaf: leaf[0], trials)


@pytest.mark.parametrize("category", range(4))
def test_the_closer_the_likelier_whatever_the_noise(category):
    goal = Goal(category, 4)
    near = np.asarray(goal.closeness(LIKELIHOOD, MEAN))
    for noise in (0.05, 0.6, 3.0):
        person = OrdinalProbit(LIKELIHOOD.thresholds, noise)
        chances = np.asarray(log_goal(person, goal, MEAN, jnp.zeros_like(MEAN)))[np.argsort(near)]
        assert np.all(np.diff(chances) >= -1e-9)
    edges = np.array([-np.inf, *LIKELIHOOD.thresholds, np.inf])[[category, category + 1]]
    upper, lower = (norm.cdf((edge - MEAN) / np.sqrt(0.36 + VARIANCE)) for edge in edges[::-1])
    np.testing.assert_allclose(np.exp(log_goal(LIKELIHOOD, goal, MEAN, VARIANCE)), upper - lower, atol=1e-12)


@pytest.mark.parametrize("category", range(4))
def test_no_smaller_variance_scores_above_the_optimistic_bound(category):
    prior = jnp.asarray(2.0)
    scores = [acquisition.InCategory(LIKELIHOOD, category)]
    scores.append(acquisition.TowardsGoal(acquisition.UCB(0.7), Goal(category, 4), LIKELIHOOD))
    for score_ in scores:
        bound = np.asarray(score_.optimistic(MEAN, prior))
        for variance in (0.0, 0.1, 0.5, 1.0, 2.0):
            assert np.all(np.asarray(score_(MEAN, jnp.full_like(MEAN, variance))) <= bound + 1e-12)


@pytest.mark.deep  # compiles the search for optima, the region and trial selection of another study
def test_a_mirrored_scale_has_the_same_optima_and_trials():
    parameters = "gain", "delay"
    up = study_of("", parameters=parameters)
    down = study_of(SCALE[2], SCALE[::-1], (-0.4, 0.7), parameters=parameters)  # too hard is lowest, and the goal
    both = [(up, answers(up.space.dim)), (down, mirrored(answers(up.space.dim)))]
    found = []
    for study, trials in both:
        candidates = search_points(study.space, 0)
        posteriors = fit_cohort(study, Cohort(trials, np.asarray(trials.x), ("A", "B", "C")))
        map_ = rule_map(study.gp, trials, "bcm", posteriors=posteriors)
        optimum = map_optimum(study, map_, candidates)
        person = first(trials)
        sets = best_mid_worst(study, map_.predict, candidates, known=2.0)
        interval = tolerance(study, map_.newcomer, optimum.x, "gain")
        found.append({
            "map": optimum.x,
            "individual": individual_optima(study, posteriors, candidates).x,
            "next": next_point(study, design(study, 0), person, 12),
            "sets": sets.x,
            "tolerance": [interval.low, interval.high],
            "resampled": resampled_tops(study, posteriors, candidates[:50], "bcm", None, 2.0, draws=20),
        })  # fmt: skip
    for name, value in found[0].items():
        np.testing.assert_allclose(value, found[1][name], atol=1e-7, err_msg=name)


@pytest.mark.deep  # compiles the search for optima, the region and trial selection of another study
def test_a_goal_between_others_is_where_it_is_likeliest():
    study, trials = study_of(SCALE[1]), answers(1)
    candidates = search_points(study.space, 0)
    map_ = rule_map(study.gp, trials, "bcm")
    optimum = map_optimum(study, map_, candidates)
    x = jnp.linspace(0.0, 1.0, 4001)[:, None]
    chances = np.asarray(map_.class_probabilities(study.gp.likelihood, x))[:, 1]
    assert float(optimum.x[0]) == pytest.approx(float(x[np.argmax(chances), 0]), abs=1e-3)
    assert float(optimum.x[0]) == pytest.approx(0.41, abs=0.1)  # f = -0.15, amid the thresholds
    sets = best_mid_worst(study, map_.predict, candidates, known=2.0)
    away = np.abs(np.asarray(sets.mean) + 0.15)
    assert away[0] < away[1] < away[2]
    interval = tolerance(study, map_.newcomer, optimum.x, "gain")
    inside = x[(chances > 0.5), 0]
    assert interval.low < interval.high and interval.low <= float(inside.min()) and interval.high >= float(inside.max())


@pytest.mark.parametrize(("parameters", "kind"), [(("gain",), "ucb"), (("gain", "delay"), "top_category")])
def test_trials_towards_a_goal_between_others_maximise_the_acquisition(parameters, kind):
    study = study_of(SCALE[1], parameters=parameters, acquisition=kind)
    trials = answers(study.space.dim, people=1, seed=2)
    person = first(trials)
    point = next_point(study, design(study, 0), person, 12)
    posterior = fit(study.gp, person)

    def height(x):
        mean, variance = posterior.predict(x)
        if kind == "ucb":
            return study.file.selection.weight * jnp.sqrt(variance) - jnp.abs(mean + 0.15)
        return score(study.goal, study.gp.likelihood, mean, variance)

    everywhere = np.asarray(height(jnp.asarray(study.space.candidates(4000, 1))))
    assert float(height(point[None])[0]) >= everywhere.max() - 1e-4


def test_where_many_stimuli_are_equally_good_no_single_one_is_judged():
    """A curve of optima has a region, and neither hills nor an error that more people could make smaller."""
    study, trials = study_of(SCALE[1], parameters=("gain", "delay")), answers(2)
    assert not study.one_optimum and study_of(SCALE[1]).one_optimum and study_of("", parameters=("a", "b")).one_optimum
    posterior = fit(study.gp, first(trials))
    one = jnp.ones(())
    region = optimum_region(study, RuleMap("pooled", "exact", None, posterior, one, 2.0 * one), (), 0, 100)
    (sentence,) = region_sentences(region, study.one_optimum)
    assert region.hills == () and "many stimuli are equally good" in sentence
    inside, outside = (np.abs(posterior.mean(jnp.asarray(x)) + 0.15) for x in (region.points, region.others))
    assert np.median(inside) < np.median(outside)
    with pytest.raises(InputError, match="many stimuli are as good as the optimum"):
        simulate_power(study, PRESETS["paper"], Plan((4,), (8,), 2, 0))


def test_tables_of_a_validation_are_of_the_goal():
    """Those of a mirrored scale, too hard being the goal and lowest, are the same."""
    table = paper_counts(np.random.default_rng(1))
    up = validate(table)
    mirror = dict(zip(RESPONSES, RESPONSES[::-1], strict=True))
    turned = table.assign(**{side: table[side].map(lambda c: mirror.get(c, c)) for side in ("class_a", "class_b")})
    down = validate(turned, goal=RESPONSES[0])
    for name in ("table_2", "table_3"):
        ours, theirs = (getattr(each.tables, name) for each in (up, down))
        np.testing.assert_allclose(ours.table["estimate"], theirs.table["estimate"], rtol=1e-6)


@pytest.mark.parametrize(
    ("goal", "selection", "sentence"),
    [
        ("right", {}, 'study.goal is "right"; it must be one of the responses, too soft, as the real one, too hard.'),
        (SCALE[1], {"acquisition": "log_ei"}, 'selection.acquisition is "log_ei", which has no form'),
    ],
)
def test_bad_goals_are_refused(goal, selection, sentence):
    with pytest.raises(InputError, match=sentence.replace(".", r"\.")):
        study_of(goal, **selection)


def test_a_study_without_a_goal_has_the_highest_response():
    assert study_of("").goal == study_of(SCALE[2]).goal == Goal.highest(3)
    assert study_of("").file.hash == study_of(SCALE[2]).file.hash != study_of(SCALE[1]).file.hash
    assert '"goal":' not in study_of("").file.content and study_of("").goal_label == SCALE[2]
