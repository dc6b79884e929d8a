"""The populations that `--preset` names, and those that study files state or leave to the defaults."""

import dataclasses
import tomllib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from commands import run

import hilbo
from hilbo.errors import InputError
from hilbo.simulation import simulate
from hilbo.simulation.presets import PRESETS, population_of, preset_of, with_truth
from hilbo.study.config import Study

THIRTY = [f"paper-{k:02d}" for k in range(1, 31)]


def test_there_are_thirty_and_what_came_before():
    assert set(PRESETS) == {"paper", "paper-individuals", *THIRTY}
    assert PRESETS["paper"] in [PRESETS[name] for name in THIRTY]


@pytest.mark.parametrize("name", ["paper-individuals", *THIRTY])
def test_each_is_a_population(name):
    p = PRESETS[name]
    assert set(p.truth) == {"K1", "B1", "alpha"} and len(p.spread) == len(p.tolerance) == 3
    assert all(0 < value < 1 for value in (*p.spread, *p.tolerance))
    assert p.criteria[0] > p.criteria[1] == 1.0
    assert 0 <= p.lapse < 0.2 and 0 < p.noise < 2 and 0 <= p.contrast <= 1


def test_an_unknown_name_is_one_sentence():
    with pytest.raises(InputError, match='--preset is "papr"; there are paper, paper-individuals, paper-01'):
        preset_of("papr")


VISUAL = """\
schema = 1
[study]
name = "visual"
responses = ["different", "similar", "close", "same"]
[parameters.hue]
low = 0
high = 360
[parameters.light]
low = 20
high = 80
[aggregation]
rule = "learnt-1"
"""
STATED = "[simulation]\ntruth = {hue = 90, light = 65}\nspread = [0.02, 0.03]\ncriteria = [4, 2, 1]\n"


def test_any_study_has_people():
    study = Study.from_dict(tomllib.loads(VISUAL))
    name, population = population_of(study)
    assert "no preset" in name and len(population.criteria) == 3 and not population.truth
    truths = [with_truth(study, population, seed).truth for seed in (0, 0, 1)]
    assert truths[0] == truths[1] != truths[2]
    people = simulate.people(study, with_truth(study, population, 0), 400, 1)
    near = study.space.to_unit(np.array([truths[0]["hue"], truths[0]["light"]]))
    assert np.all(np.abs(np.asarray(people.optimum).mean(axis=0) - near) < 0.15)


def test_a_study_may_state_its_people():
    study = Study.from_dict(tomllib.loads(VISUAL + STATED))
    name, population = population_of(study)
    assert "[simulation]" in name and population.spread == (0.02, 0.03) and population.tolerance == (0.2, 0.2)
    assert with_truth(study, population, 5).truth == {"hue": 90, "light": 65}


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("light = 65}", "lightness = 65}", "simulation.truth names hue, lightness; it must name hue, light."),
        ("hue = 90", "hue = 400", "simulation.truth.hue is 400.0; it must be a number from 0 to 360."),
        ("[0.02, 0.03]", "[0.02]", "simulation.spread has 1 numbers; it must be one number or 2, one per parameter."),
        (
            "[4, 2, 1]",
            "[2, 1]",
            "simulation.criteria is [2.0, 1.0]; it must have one number fewer than the 4 responses.",
        ),
        (
            "[4, 2, 1]",
            "[4, 4, 1]",
            "simulation.criteria is [4.0, 4.0, 1.0]; it must fall from each number to the next.",
        ),
        (
            "[0.02, 0.03]",
            "[0.02, 3]",
            "simulation.spread is [0.02, 3]; it must be a number above 0, up to 1, or a list",
        ),
        ("spread = [0.02, 0.03]", "lapse = 2", "simulation.lapse is 2; it must be a number from 0 to 1;"),
    ],
)
def test_people_that_do_not_fit_the_study_are_refused(old, new, sentence):
    with pytest.raises(InputError) as refused:
        Study.from_dict(tomllib.loads(VISUAL + STATED.replace(old, new)))
    assert str(refused.value).startswith(sentence)


def test_a_preset_of_other_parameters_is_refused():
    with pytest.raises(
        InputError, match=r"like K1 = 5.7, .*, and the study has hue from 0 to 360, .*; leave --preset out"
    ):
        population_of(Study.from_dict(tomllib.loads(VISUAL)), "paper")


def test_people_of_other_ranges_are_not_the_papers():
    raw = tomllib.loads((Path(hilbo.__file__).parent / "data" / "paper.toml").read_text())
    assert population_of(Study.from_dict(raw))[0] == "paper"
    raw["parameters"]["B1"] |= {"low": 0.15, "high": 2.0}
    narrow = Study.from_dict(raw)
    name, population = population_of(narrow)
    assert "no preset" in name and 0.15 <= with_truth(narrow, population, 0).truth["B1"] <= 2.0
    with pytest.raises(InputError, match=r"like .*B1 = 5.89.*B1 from 0.15 to 2.* leave --preset out"):
        population_of(narrow, "paper-03")


def test_people_who_like_nothing_that_may_be_rendered_are_refused():
    study = Study.from_dict(tomllib.loads(VISUAL))
    nowhere = dataclasses.replace(population_of(study)[1], truth={"hue": 5000.0, "light": 50.0})
    with pytest.raises(InputError, match="only 0 like a rendering of this study; move the truth"):
        simulate.people(study, nowhere, 2, 0)


def test_people_of_simulations_are_not_part_of_the_hash():
    plain, stated = (Study.from_dict(tomllib.loads(text)) for text in (VISUAL, VISUAL + STATED))
    assert plain.file.hash == stated.file.hash and stated.file.simulation is not None


@pytest.mark.deep  # whole commands: a study of 4 people, and power by two studies of as many
def test_any_study_is_simulated_and_has_power(tmp_path, capsys, monkeypatch):
    (tmp_path / "s.toml").write_text(VISUAL + "[selection]\nspace_filling = 3\ntrials = 6\n")
    code, _, err = run(
        capsys, monkeypatch, "simulate", "--study", tmp_path / "s.toml", "--participants", 4, "--out", tmp_path / "sim"
    )
    assert code == 0, err
    (row,) = pd.read_csv(tmp_path / "sim" / "truth.csv").query("source == 'population'").to_dict("records")
    assert 0 <= row["hue"] <= 360 and 20 <= row["light"] <= 80
    options = ("--participants", 4, "--trials", 6, "--studies", 2, "--jobs", 1)
    code, _, err = run(capsys, monkeypatch, "power", tmp_path / "s.toml", *options, "--out", tmp_path / "power")
    assert code == 0, err
