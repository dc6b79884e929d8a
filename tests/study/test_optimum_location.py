"""An optimum at an edge, at the border of what may be rendered, or where nobody was asked says so."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from studies import PLAIN, answered, plain_study

from hilbo.study.config import Study
from hilbo.study.estimate.location import goal_sentences, location_notes, location_sentences, truth_sentence
from hilbo.study.file.columns import meanings

STUDY = Study.load("hilbo/data/paper.toml")
SD, ASKED = jnp.asarray(0.3), jnp.asarray(0.25)


def test_inside_and_known_there_is_nothing_to_say():
    assert location_sentences(STUDY, jnp.array([0.1, 0.2, 0.2]), SD, ASKED) == []


def test_the_edge_of_a_range_is_named():
    (sentence,) = location_sentences(STUDY, jnp.array([0.1, 0.2, 0.0]), SD, ASKED)
    assert sentence.startswith("The optimum is at the lowest alpha that was searched (0.01):")


def test_a_natural_end_is_named_without_the_remark_on_what_is_beyond():
    numbers = PLAIN["parameters"] | {"u": PLAIN["parameters"]["u"] | {"natural_ends": ["low"]}}
    study = Study.from_dict(PLAIN | {"parameters": numbers})
    (sentence,) = location_sentences(study, jnp.array([0.0, 0.5]), SD, ASKED)
    assert sentence == "The optimum is at the natural end of u (0)."
    assert location_notes(study, jnp.array([0.0, 0.5]), SD, ASKED) == ["at the natural end of u (0)"]
    far, natural = location_sentences(study, jnp.array([0.0, 1.0]), SD, ASKED)
    assert "the highest v that was searched (20)" in far and natural == sentence
    (sentence,) = location_sentences(study, jnp.array([1.0, 0.5]), SD, ASKED)
    assert "the highest u that was searched (1): values beyond" in sentence
    assert study.file.meaning == Study.from_dict(PLAIN).file.meaning
    assert "natural end of a range" in meanings("optima", study.file.space)["location"][1]
    assert "natural" not in meanings("optima", Study.from_dict(PLAIN).file.space)["location"][1]


def test_the_border_of_the_passive_set_is_named():
    x = STUDY.space.from_box(jnp.array([1.0, 0.5, 0.5]))
    assert 0 < float(x[0]) < 1
    (sentence,) = location_sentences(STUDY, x, SD, ASKED)
    assert "boundary of the passive region of the device: K1 could not be higher" in sentence


def test_a_constraint_that_holds_the_optimum_is_named():
    limits = [{"terms": {"u": 10.0, "v": 1.0}, "least": 12.0, "most": 20.0}]
    study = Study.from_dict(PLAIN | {"constraints": limits})
    for x, words in (
        ([0.3, 0.7], "10 u + v <= 20"),
        ([0.3 - 1e-9, 0.7], "10 u + v <= 20"),
        ([0.15, 0.05], "12 <= 10 u + v"),
    ):
        (sentence,) = location_sentences(study, jnp.array(x), SD, ASKED)
        assert sentence.startswith(f"The optimum is on the study's constraint {words}: values beyond")
        assert location_notes(study, jnp.array(x), SD, ASKED) == [f"on the constraint {words}"]
    assert location_sentences(study, jnp.array([0.3, 0.69]), SD, ASKED) == []


def test_the_border_of_effective_damping_is_named():
    """Not the device's, and it may hold K1 from below."""
    mechanics = dataclasses.replace(STUDY.space.mechanics, damping=5.0, effective_damping=(30.0, 80.0))
    study = dataclasses.replace(STUDY, space=dataclasses.replace(STUDY.space, mechanics=mechanics))
    for share, way in ((0.0, "lower"), (1.0, "higher")):
        x = study.space.from_box(jnp.array([share, 0.5, 0.5]))
        assert 0 < float(x[0]) < 1
        (sentence,) = location_sentences(study, x, SD, ASKED)
        assert f"boundary of the study's range of effective damping: K1 could not be {way} there" in sentence
        assert location_notes(study, x, SD, ASKED) == [f"K1 could not be {way} within the range of effective damping"]


def test_an_extrapolation_is_called_one():
    x = jnp.array([0.1, 0.2, 0.2])
    (sentence,) = location_sentences(STUDY, x, jnp.asarray(0.9), ASKED)
    assert "there, 0.9, is larger than at all tested stimuli (0.5 at most)" in sentence
    assert location_sentences(STUDY, x, jnp.asarray(0.9), None) == []
    assert location_sentences(STUDY, x, jnp.asarray(0.5), ASKED) == []


def test_a_goal_that_nobody_answered_is_named():
    study = plain_study(2)
    cohort = answered(study)
    assert goal_sentences(study, cohort.trials) == []
    others = eqx.tree_at(lambda t: t.mask, cohort.trials, cohort.trials.mask & (cohort.trials.q == 0))
    (sentence,) = goal_sentences(study, others)
    assert sentence.startswith('No response is "good"')


def test_a_row_of_a_table_has_the_same_in_a_few_words():
    assert location_notes(STUDY, jnp.array([0.1, 0.2, 0.2]), SD, ASKED) == []
    edge, beyond = location_notes(STUDY, jnp.array([0.1, 0.2, 0.0]), jnp.asarray(0.9), ASKED)
    assert edge == "at the lowest alpha that was searched (0.01)"
    assert "its standard deviation is larger than at all tested stimuli" in beyond


def test_a_simulated_study_says_how_far_its_truth_is():
    sentence = truth_sentence(STUDY, np.asarray(STUDY.space.to_unit(np.array([8.0, 4.0, 0.25]))), 0.0844)
    assert sentence.startswith(
        "The true optimum of the simulated participants is K1 = 8 N/mm, B1 = 4 N.s^alpha/mm, alpha"
    )
    assert sentence.endswith("= 0.25; the optimum found is 8.4 % of the search ranges away (NRMSE).")
