"""Unordered levels: what a study file may say of them, their names in tables, and that their order means nothing."""

import itertools
import tomllib

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from surfaces import SURFACES, TEXTURES, surfaces

from hilbo import Session
from hilbo.errors import InputError
from hilbo.kernels import RBF, Matern32, embedded, gram, theta_of
from hilbo.population.rules.registry import RECIPES
from hilbo.search.apart import differences, middle_of, nrmse
from hilbo.search.rendering import Rendering
from hilbo.simulation.presets import population_of
from hilbo.simulation.simulate import people
from hilbo.study.analysis.hills import hills_of
from hilbo.study.cohort import cohort_of, read_trials
from hilbo.study.config import Study
from hilbo.study.estimate.aggregate import aggregate_cohort
from hilbo.study.estimate.learnt import that_learns
from hilbo.study.formats.json_file import check_values
from hilbo.study.tables.trials import write_trials
from hilbo.study.tables.validation import sets_frame
from hilbo.study.template import NewStudy, parameter_of, study_text

orders = st.permutations(TEXTURES)
correlations = st.floats(0.02, 0.98)


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        ({"levels": ["silk", "wood", "silk"]}, 'parameters.texture.levels has "silk" twice, give each level once.'),
        ({"levels": ["silk"]}, 'parameters.texture.levels is ["silk"]; it must be a list of two or more texts'),
        ({"levels": "silk"}, 'parameters.texture.levels is "silk"; it must be a list of two or more texts'),
        ({"levels": [1, 2]}, "parameters.texture.levels is [1, 2]; it must be a list of two or more texts"),
        ({"levels": ["a", " b"]}, "parameters.texture.levels has ' b', a level is a text without blanks around it"),
        ({"levels": ["10", "b"]}, 'parameters.texture.levels has "10", which reads as a number; name it otherwise'),
        ({"levels": ["a", "=b"]}, 'parameters.texture.levels is ["a", "=b"], which a spreadsheet would run'),
        ({"levels": ["a", "b"], "low": 0.0}, "parameters.texture.low is not used with levels, which have no order"),
        (
            {"levels": ["a", "b"], "scale": "log"},
            "parameters.texture.scale is not used with levels, which have no order",
        ),
        ({"levels": ["a", "b"], "integer": True}, "parameters.texture.integer is not used with levels, which have no"),
        ({"levels": ["a", "b"], "unit": "N"}, "parameters.texture.unit is not used with levels, which have no order"),
        (
            {"levels": ["a", "b"], "correlation": 1.0},
            "parameters.texture.correlation is 1.0; it must be a number",
        ),
        ({"low": 0, "high": 1, "correlation": 0.5}, "parameters.texture.correlation is of levels, and there are none"),
        ({}, "parameters.texture.low is missing"),
    ],
)
def test_a_study_file_that_says_otherwise_is_refused(table, sentence):
    raw = SURFACES | {"parameters": SURFACES["parameters"] | {"texture": table}}
    with pytest.raises(InputError) as refused:
        Study.from_dict(raw)
    assert str(refused.value).startswith(sentence) and str(refused.value).count(". ") == 0


def test_levels_are_in_no_linear_constraint_and_have_no_length():
    for table, words in (
        ({"constraints": [{"terms": {"texture": 1.0, "hue": 1.0}, "most": 3.0}]}, "texture, whose levels are no"),
        ({"gp": SURFACES["gp"] | {"theta": [1.0, 2.0, 3.0]}}, "one number or 2, one per parameter without levels"),
    ):
        with pytest.raises(InputError, match=words):
            Study.from_dict(SURFACES | table)


@given(st.sampled_from([RBF, Matern32]), correlations, st.sampled_from([2, 5]))
@settings(deadline=None, max_examples=10)
def test_any_two_levels_have_the_stated_correlation(kind, correlation, count):
    kernel = kind((3.0, theta_of(kind, correlation)), 2.0, (0, count))
    x = jnp.array([[0.25, k / (count - 1)] for k in range(count)])
    covariance = np.asarray(jax.jit(gram)(kernel, x, x))
    expected = 2.0 * np.where(np.eye(count, dtype=bool), 1.0, correlation)
    np.testing.assert_allclose(covariance, expected, rtol=1e-12)
    places = embedded(kernel, np.asarray(x))
    away = np.sum((places[:, None] - places[None]) ** 2, axis=-1)
    np.testing.assert_allclose(away, np.where(np.eye(count, dtype=bool), 0.0, kernel.theta[1]), atol=1e-12)


def test_a_study_without_levels_has_the_kernel_it_had():
    numbers = {name: table for name, table in SURFACES["parameters"].items() if name != "texture"}
    kernel = Study.from_dict(SURFACES | {"parameters": numbers}).gp.kernel
    assert kernel.levels == () and kernel.theta.tolist() == [10.0, 8.0]
    assert surfaces().gp.kernel.levels == (0, 3, 0)
    np.testing.assert_allclose(surfaces().gp.kernel.theta, [10.0, np.log(2.0), 8.0])


def answers(n=18):
    """A table of answers by somebody who likes one texture best, with its names."""
    rng = np.random.default_rng(5)
    hue, light = rng.uniform(0, 360, n), rng.uniform(20, 80, n)
    texture = [("silk", "wood", "stone")[k] for k in rng.integers(3, size=n)]
    likes = np.exp(-(((hue - 120) / 90) ** 2) - ((light - 50) / 30) ** 2) + 0.6 * (np.array(texture) == "wood")
    table = pd.DataFrame({"participant": "A", "trial": np.arange(1, n + 1), "hue": hue, "texture": texture})
    given = np.array(["different", "similar", "close"])[np.digitize(likes, [0.4, 0.9])]
    return table.assign(light=light, response=given)


POINTS = [(hue, texture, 60.0) for hue, texture in itertools.product((30.0, 200.0), TEXTURES)]


def asked(study):
    """`POINTS` in the study's unit cube."""
    texture = study.space.parameters[1]
    return jnp.asarray(study.space.to_unit(np.array([(h, texture.number(name), light) for h, name, light in POINTS])))


@given(orders)
@settings(deadline=None, max_examples=6)
def test_levels_in_another_order_have_the_same_covariances(order):
    first, other = surfaces(), surfaces(order)
    given_, permuted = (np.asarray(gram(s.gp.kernel, asked(s), asked(s))) for s in (first, other))
    np.testing.assert_allclose(permuted, given_, rtol=1e-14)


@pytest.mark.deep  # it compiles a fit
@pytest.mark.parametrize("order", list(itertools.permutations(TEXTURES))[1:])
def test_levels_in_another_order_give_the_same_map_and_optimum(order):
    table, results = answers(), []
    for study in (surfaces(), surfaces(order)):
        aggregate = aggregate_cohort(study, cohort_of(table, study), alternatives=False)
        best = Rendering.at(study.space, aggregate.optimum.x).shown
        results.append(
            (best.pop("texture"), list(best.values()), [np.asarray(m) for m in aggregate.surface(asked(study))])
        )
    (texture, best, map_), (other_texture, other_best, other_map) = results
    assert texture == other_texture
    np.testing.assert_allclose(best, other_best, rtol=1e-4)
    np.testing.assert_allclose(map_, other_map, atol=1e-9)


@given(st.integers(0, 10**6))
@settings(deadline=None, max_examples=20)
def test_every_drawn_rendering_has_a_level_of_the_list(seed):
    space = surfaces().space
    for draw in (space.candidates, space.walls, space.latin_hypercube):
        physical = np.asarray(space.to_physical(draw(9, seed)))
        assert set(physical[:, 1]) <= {0.0, 1.0, 2.0}


def test_a_session_asks_for_levels_by_name_and_takes_them_so():
    first = Session.start(surfaces(), seed=2)
    assert first.ask()["texture"] in TEXTURES
    told = first.tell("close", at={"hue": 10.0, "texture": "stone", "light": 30.0})
    assert told.points.tolist() == [[10.0, 2.0, 30.0]] and any(f"texture {name}," in repr(first) for name in TEXTURES)
    with pytest.raises(InputError, match="texture is glass; it must be one of silk, wood, stone"):
        first.tell("close", at={"hue": 10.0, "texture": "glass", "light": 30.0})


@pytest.mark.deep  # it compiles a step
def test_a_session_finds_the_level():
    session = Session.start(surfaces(), seed=2)
    for _ in range(6):
        assert session.ask()["texture"] in TEXTURES
        session = session.tell("close" if session.ask()["texture"] == "wood" else "different")
    assert session.best()["texture"] == "wood"


@pytest.mark.parametrize("name", ["t.csv", "t.parquet"])
def test_tables_hold_the_names(tmp_path, name):
    table = answers()
    write_trials(table, tmp_path / name)
    read = read_trials(tmp_path / name, surfaces())
    assert [TEXTURES[int(k)] for k in read["texture"]] == table["texture"].tolist()
    np.testing.assert_array_equal(read["hue"], table["hue"])
    table.loc[4, "texture"] = "glass"
    write_trials(table, tmp_path / name)
    with pytest.raises(InputError, match=r'(:6|row 5): texture is "glass"; it must be one of silk, wood, stone\.$'):
        read_trials(tmp_path / name, surfaces())


def test_distances_take_all_other_levels_alike():
    x, y = np.array([[0.2, 0.0], [0.2, 0.5], [0.2, 1.0]]), np.array([0.5, 1.0])
    np.testing.assert_allclose(differences((0, 3), x, y), [[-0.3, 1.0], [-0.3, 1.0], [-0.3, 0.0]])
    np.testing.assert_allclose(differences((0, 3), jnp.asarray(x), jnp.asarray(y)[None]), differences((0, 3), x, y))
    np.testing.assert_allclose(nrmse(x, y, (0, 3)), np.sqrt([1.09 / 2, 1.09 / 2, 0.09 / 2]))
    np.testing.assert_allclose(middle_of((0, 3), np.array([[0.1, 1.0], [0.3, 0.0], [0.5, 1.0]])), [0.3, 1.0])


def test_the_centre_of_a_hill_has_a_level_that_is_likely():
    points = np.array([[h, t] for h in (0.1, 0.2, 0.3) for t in (0.0, 0.5, 1.0)])
    weight = np.where(points[:, 1] == 0.5, 0.0, np.where(points[:, 1] == 1.0, 0.2, 2 / 15))
    kernel = RBF((4.0, theta_of(RBF, 0.9)), 1.0, (0, 3))
    (hill,) = hills_of(points, -((points[:, 0] - 0.2) ** 2), np.ones(9), weight, kernel)
    np.testing.assert_allclose(hill.centre, [0.2, 1.0])


@pytest.mark.parametrize("recipe", list(RECIPES))
def test_recipes_begin_with_the_stated_correlation(recipe):
    study = that_learns(surfaces(), recipe)
    assert study.gp.kernel.levels == (0, 3, 0) and study.stated.numbers == {}
    np.testing.assert_allclose(study.gp.kernel.theta, [12.0, np.log(2.0), 12.0])


def test_a_new_study_has_levels():
    new = NewStudy("surfaces", tuple(map(parameter_of, ("hue=0:360:deg", "texture=silk, wood"))), by="person")
    study = Study.from_dict(tomllib.loads(study_text(new)))
    assert study.space.parameters[1].levels == ("silk", "wood") and set(study.file.stimulus.tolerance) == {"hue"}


def test_a_confirmed_level_is_not_nearly_another():
    with pytest.raises(InputError, match=r"stimulus\.tolerance\.texture is of levels, which have no tolerance"):
        surfaces(stimulus={"tolerance": {"texture": 1.0}})
    assert surfaces(stimulus={}).file.stimulus.off_by(surfaces().space.parameters[1], 1.0) == 0


def test_simulated_people_are_around_a_level():
    study = surfaces(simulation={"truth": {"hue": 90.0, "texture": "stone", "light": 40.0}, "spread": 0.2})
    crowd = people(study, population_of(study)[1], 500, 0)
    texture = np.asarray(crowd.optimum)[:, 1]
    assert np.mean(texture == 1.0) == pytest.approx(0.8, abs=0.06) and set(texture) == {0.0, 0.5, 1.0}
    with pytest.raises(InputError, match=r'truth\.texture is "glass"; it must be one of silk, wood, stone'):
        surfaces(simulation={"truth": {"hue": 90.0, "texture": "glass", "light": 40.0}})


def test_sets_hold_the_names(tmp_path):
    parameters, path = surfaces().space.parameters, tmp_path / "sets.csv"
    path.write_text("set_id,source,hue,texture,light\nbest,aggregate,10,stone,30\n")
    assert sets_frame(path, ("hue", "texture", "light"), parameters)["texture"].tolist() == [2.0]
    path.write_text("set_id,source,hue,texture,light\nbest,aggregate,10,glass,30\n")
    with pytest.raises(InputError, match=r'sets\.csv:2: texture is "glass"; it must be one of silk, wood, stone'):
        sets_frame(path, ("hue", "texture", "light"), parameters)


def test_renderings_of_other_files_are_named_or_placed():
    parameters, good = surfaces().space.parameters, {"hue": 1.0, "texture": "stone", "light": 30.0}
    assert check_values(good, parameters, "f", "the best") == check_values(good | {"texture": 2}, parameters, "f", "it")
    for wrong, words in (("glass", "it must be one of silk, wood, stone"), (0.5, "which is no level"), (3.0, "0 to 2")):
        with pytest.raises(InputError, match=words):
            check_values(good | {"texture": wrong}, parameters, "f", "the best")


def test_a_table_of_levels_that_was_read_and_shortened_is_checked_again(tmp_path):
    study = surfaces()
    write_trials(answers(), tmp_path / "t.csv")
    read = read_trials(tmp_path / "t.csv", study)
    whole, half = cohort_of(read, study), cohort_of(read[read["trial"] < 10], study)
    np.testing.assert_array_equal(half.physical[0, :9], whole.physical[0, :9])
    with pytest.raises(InputError, match=r'texture is "7\.0"; it must be one of silk, wood, stone'):
        cohort_of(read.assign(texture=7.0), study)
