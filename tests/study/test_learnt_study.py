"""A study file without [gp]: what is read, what a session starts from, and what its results say."""

import json
import re
import tomllib

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from commands import run
from studies import SOUND

from hilbo import Session
from hilbo.errors import InputError
from hilbo.ordinal_gp import Trials
from hilbo.population.judged.leave_one_out import leave_one_out_learnt
from hilbo.population.judged.left_out_kept import leave_one_out_kept
from hilbo.population.maps import learnt_map
from hilbo.population.rules.registry import RECOMMENDED
from hilbo.search.candidates import search_points
from hilbo.simulation.simulate import to_table
from hilbo.study.cohort import Cohort, cohort_of, read_trials
from hilbo.study.config import Study
from hilbo.study.estimate.aggregate import aggregate_cohort
from hilbo.study.estimate.best_places import best_places, nearness
from hilbo.study.estimate.learnt import effect_content, learnt_content, learnt_sentences, resolved, that_learns
from hilbo.study.estimate.optimum import map_optimum

PEOPLE, ANSWERS = 4, 12


def study_of(text=SOUND) -> Study:
    return Study.from_dict(tomllib.loads(text))


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    """A trial table of people who like one place."""
    rng = np.random.default_rng(0)
    each = []
    for j in range(PEOPLE):
        x = rng.uniform(size=(ANSWERS, 2))
        felt = np.hypot(*(x - 0.4 - 0.05 * j).T) + 0.1 * rng.normal(size=ANSWERS)
        each.append(Trials.from_arrays(x, (felt < 0.5).astype(int) + (felt < 0.25), ANSWERS))
    path = tmp_path_factory.mktemp("sound") / "trials.csv"
    to_table(study_of(), jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)).to_csv(path, index=False)
    return path


PLAIN_GP = "[gp]\ntheta = 30.0\nvariance = 1.0\nthresholds = [-0.5, 0.5]\nnoise = 0.5\n"
WITH_CLIPS = SOUND + '[random_effect]\ncolumn = "clip"\n'


def with_clips(table):
    """The same answers, of which only the last person's last one is of the last clip."""
    answers = read_trials(table, study_of())
    answers["clip"] = np.where(np.arange(len(answers)) % 2, "Sea ", "Fox")
    answers.iloc[-1, answers.columns.get_loc("clip")] = "Wolf"
    return answers


@pytest.fixture(scope="module")
def learnt_2(table):
    """The study by learnt-2, with a random effect, its cohort and its map: one search, 5 s."""
    study = study_of(WITH_CLIPS.replace("learnt-1", "learnt-2"))
    cohort = cohort_of(with_clips(table), study)
    study = resolved(study, cohort)
    return study, cohort, learnt_map(study.learnt, cohort.trials)


def test_a_session_starts_from_the_medians():
    study = study_of()
    np.testing.assert_allclose(study.gp.kernel.theta, 12.0)
    np.testing.assert_allclose(study.gp.likelihood.thresholds, (-0.4, 0.4))
    session = Session.start(study, seed=0)
    assert set(session.ask()) == {"level", "tone"}


def test_learnt_2_seeks_its_optimum_where_the_best_is_most_often_near(learnt_2):
    study, cohort, map_ = learnt_2
    x = search_points(study.space, 0)
    optimum = map_optimum(study, map_, x)
    places = best_places(study.space, study.goal, [map_.shared])
    theta, away = np.asarray(map_.shared.gp.kernel.theta), np.asarray(x)[:, None] - np.asarray(places.points)
    near = np.exp(-4 * np.sum(theta * away**2, axis=2)) @ np.asarray(places.share)
    chance = np.asarray(eqx.filter_jit(map_.class_probabilities)(study.gp.likelihood, x))[:, -1]
    known = np.asarray(map_.predict(x)[1]) <= np.asarray(map_.reach)
    known = known & (chance >= chance[known].max() - 0.05)
    assert learnt_content(study, cohort.names, map_)["recipe"] == "learnt-2"
    assert float(nearness(map_.shared.gp.kernel, places.points, places.share, optimum.x)) >= near[known].max() - 1e-12
    assert float(optimum.class_probabilities[-1]) >= chance[known].max() - 0.05 - 1e-6
    assert float(optimum.sd**2) <= float(map_.reach) * (1 + 1e-6)


@pytest.mark.deep  # three programs of whole fits are compiled
def test_left_out_people_are_predicted_as_by_maps_without_them(learnt_2):
    """The maps take an eigendecomposition, and all points; with an effect, and in groups of two sizes."""
    study, cohort, _ = learnt_2
    groups, folds = [np.array([0, 2]), np.array([3])], []
    fast = leave_one_out_kept(study.learnt, cohort.trials, groups, lambda done, of: folds.append((done, of)))
    by_maps, _ = leave_one_out_learnt(study.learnt, cohort.trials, study.stated, again=False, groups=groups)
    np.testing.assert_allclose(fast.probabilities, by_maps.probabilities, rtol=1e-10)
    np.testing.assert_allclose(fast.log_given, by_maps.log_given, rtol=1e-10)
    np.testing.assert_array_equal([fast.person, fast.q], [by_maps.person, by_maps.q])
    assert fast.not_converged == by_maps.not_converged == 0 and folds == [(1, 2), (2, 2)]


def test_what_the_file_states_is_kept():
    study = study_of(SOUND + "[gp]\nnoise = 0.5\ntheta = 3.0\n")
    np.testing.assert_allclose(study.gp.kernel.theta, 3.0)
    np.testing.assert_allclose(study.gp.likelihood.noise, 0.5)
    assert study.stated.theta == (3.0, 3.0)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            SOUND.replace("learnt-1", "bcm"),
            "gp.theta is missing and so are gp.variance, gp.thresholds, ",
        ),
        (SOUND + '[gp]\ninference = "ep"\n', 'gp.inference is "ep"; it must be "laplace" with rule = "learnt-1"'),
        (SOUND + "[gp]\nthresholds = [0.0]\n", "gp.thresholds is [0.0]; it must have one number fewer than the 3"),
        (SOUND.replace("learnt-1", "learnt-0"), 'aggregation.rule is "learnt-0"; it must be one of'),
        (
            SOUND + '[random_effect]\ncolumn = "level"\n',
            'random_effect.column is "level", which has a',
        ),
    ],
)
def test_bad_files_get_one_sentence(text, sentence):
    with pytest.raises(InputError) as caught:
        study_of(text)
    assert str(caught.value).startswith(sentence)


def test_results_hold_the_resolved_recipe(table):
    study = study_of()
    cohort = cohort_of(read_trials(table, study), study)
    learnt = resolved(study, cohort)
    assert resolved(learnt, cohort) is learnt
    map_ = learnt_map(learnt.learnt, cohort.trials)
    content = learnt_content(learnt, cohort.names, map_)
    assert content is not None
    json.dumps(content, allow_nan=False)
    assert content["recipe"] == "learnt-1" and content["log_evidence"] == float(map_.shared.log_evidence)
    assert set(content["theta"]) == {"level", "tone"}
    assert set(content["intervals"]) == {"theta.level", "theta.tone", "shared", "own", "middle", "gap 1"}
    assert learnt_content(study, cohort.names, map_) is None
    assert learnt_sentences(study) == []


@pytest.mark.deep  # the searches of all maps are compiled
def test_the_optimum_is_where_a_newcomer_most_often_says_the_highest(table):
    study = study_of()
    cohort = cohort_of(read_trials(table, study), study)
    learnt = resolved(study, cohort)
    aggregate = aggregate_cohort(study, cohort)
    assert aggregate.map.rule == "learnt-1"
    np.testing.assert_allclose(aggregate.map.share, learnt.learnt.model.share)
    assert np.hypot(*(np.asarray(aggregate.optimum.x) - 0.475)) < 0.2

    def chance(x):
        mean, variance = aggregate.newcomer(x)
        return np.array(
            [learnt.gp.likelihood.class_probabilities(m, v)[-1] for m, v in zip(mean, variance, strict=True)]
        )

    side = np.linspace(0, 1, 12)
    everywhere = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
    assert chance(aggregate.optimum.x[None, :])[0] >= chance(everywhere).max()
    np.testing.assert_allclose(aggregate.optimum.class_probabilities[-1], chance(aggregate.optimum.x[None, :])[0])


def test_a_random_effect_is_read_from_its_column_and_stands_in_the_results(learnt_2):
    learnt, cohort, map_ = learnt_2
    assert cohort.contexts == ("Fox", "Sea", "Wolf")
    np.testing.assert_array_equal(cohort.trials.context[0, :4], [0, 1, 0, 1])
    assert "random effect" in learnt_content(learnt, cohort.names, map_)["intervals"]

    def levels(of):
        content = effect_content(learnt, of, map_)
        json.dumps(content, allow_nan=False)
        return list(content["levels"])

    assert levels(cohort) == ["Fox", "Sea", "Wolf"]
    # A level of nobody whose answers count is none.
    assert levels(cohort.first(ANSWERS - 1)) == levels(cohort.rows(np.arange(PEOPLE - 1))) == ["Fox", "Sea"]


def test_one_level_is_no_effect_and_rules_that_do_not_learn_need_no_column(table):
    answers, study = with_clips(table), study_of(WITH_CLIPS)
    assert cohort_of(answers.assign(clip="Fox"), study).trials.context is None
    given = WITH_CLIPS.replace("learnt-1", "bcm") + PLAIN_GP
    assert cohort_of(answers.drop(columns="clip"), study_of(given)).trials.context is None


def test_a_random_effect_is_no_part_of_a_studys_hash():
    assert study_of(WITH_CLIPS).file.hash == study_of().file.hash
    for rule in ("", '[aggregation]\nrule = "bcm"\n'):
        plain = SOUND.replace('[aggregation]\nrule = "learnt-1"\n', rule) + PLAIN_GP
        assert study_of(plain + '[random_effect]\ncolumn = "clip"\n').file.hash == study_of(plain).file.hash


def test_a_table_without_the_column_with_an_empty_cell_or_too_many_levels_gets_one_sentence(tmp_path, table):
    study, answers = study_of(WITH_CLIPS), with_clips(table)
    missing = re.escape('the table has no column "clip", which [random_effect] names')
    with pytest.raises(InputError, match=missing):
        cohort_of(answers.drop(columns="clip"), study)
    lines = table.read_text().splitlines()
    path = tmp_path / "trials.csv"
    path.write_text("\n".join([lines[0] + ",clip", lines[1] + ",Fox", *(line + ",nan" for line in lines[2:])]))
    with pytest.raises(InputError, match=":3: clip is empty"):
        read_trials(path, study)
    path.write_text("\n".join([lines[0] + ",clip", *(line + ",Fox" for line in lines[1:])]))
    assert set(read_trials(path, study, others=False)["clip"]) == {"Fox"}
    many = pd.concat([answers] * 5, ignore_index=True)
    many["trial"] = np.arange(1, len(many) + 1)
    with pytest.raises(InputError, match="has 240 different texts; a random effect takes up to 200"):
        cohort_of(many.assign(clip=[f"at {row}" for row in range(len(many))]), study)


def test_another_rule_has_no_model_to_go_by(tmp_path, table, capsys, monkeypatch):
    (tmp_path / "study.toml").write_text(SOUND)
    command = ["aggregate", str(table), "--study", str(tmp_path / "study.toml"), "--out", str(tmp_path / "out")]
    code, _, said = run(capsys, monkeypatch, *command, "--rule", "bcm")
    assert code == 2
    assert "has no [gp] for it" in said
    assert not (tmp_path / "out").exists()


def test_by_the_command_line_nothing_stated_is_kept():
    study = that_learns(Study.load("hilbo/data/paper.toml"))
    np.testing.assert_allclose(study.gp.kernel.theta, 8.0)
    assert study.rule == RECOMMENDED
    assert not any(study.stated)


@pytest.mark.deep  # the searches of all maps are compiled
def test_no_optimum_where_the_answers_tell_less_than_wherever_somebody_was_asked():
    """People who like more of everything, asked in one corner only: the best would be far outside."""
    rng = np.random.default_rng(1)
    each = []
    for _ in range(PEOPLE):
        x = 0.4 * rng.uniform(size=(ANSWERS, 2))
        felt = 4.0 * (x.sum(axis=1) - 0.4) + 0.3 * rng.normal(size=ANSWERS)
        each.append(Trials.from_arrays(x, (felt > -0.5).astype(int) + (felt > 0.5), ANSWERS))
    trials = jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)
    study = study_of()
    cohort = Cohort(trials, np.asarray(trials.x), tuple(f"P{j}" for j in range(PEOPLE)))
    aggregate = aggregate_cohort(study, cohort, alternatives=False)
    assert float(aggregate.optimum.sd) ** 2 <= float(aggregate.asked_variance) * (1 + 1e-9)
    assert float(jnp.max(aggregate.optimum.x)) < 0.6
