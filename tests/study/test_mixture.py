"""A mixture: shares that add up to 100 %, in a study file, in tables, in sessions, and on pages."""

import json

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from commands import run

from hilbo import Session
from hilbo.errors import InputError
from hilbo.report.figures.maps import curve, grid_slice
from hilbo.search.box import Constraint
from hilbo.study.analysis.tolerance import slice_through
from hilbo.study.cohort import cohort_of, read_trials
from hilbo.study.config import Study
from hilbo.study.estimate.location import location_sentences
from hilbo.study.file.constraint_words import constraint_of
from hilbo.study.results.map_netcdf import on_grid
from hilbo.study.tables.validation import sets_of_study
from hilbo.study.template import NewStudy, parameter_of, study_text

FILE = """\
schema = 1
[study]
name = "lemonade"
responses = ["dislike", "neutral", "like"]
attribute = "liking"
[parameters.lemon]
low = 0
high = 100
unit = "%"
natural_ends = ["low"]
[parameters.sugar]
low = 0
high = 100
unit = "%"
natural_ends = ["low"]
[parameters.water]
low = 0
high = 100
unit = "%"
[[constraints]]
terms = {lemon = 1, sugar = 1, water = 1}
least = 100
most = 100
[gp]
theta = 8.0
variance = 1.0
thresholds = [-0.5, 0.5]
noise = 0.5
[selection]
trials = 8
space_filling = 4
[simulation]
truth = {lemon = 0, sugar = 30, water = 70}
spread = 0.1
"""


@pytest.fixture
def study(tmp_path):
    (tmp_path / "study.toml").write_text(FILE)
    return Study.load(tmp_path / "study.toml")


def test_a_row_that_violates_the_equality_is_refused_with_its_sum(study, tmp_path):
    head, good = "participant,trial,response,lemon,sugar,water\n", "A,1,like,33.3,33.3,33.3\n"
    (tmp_path / "t.csv").write_text(head + good)
    assert len(read_trials(tmp_path / "t.csv", study)) == 1
    (tmp_path / "t.csv").write_text(head + good + "A,2,like,30,30,30\n")
    with pytest.raises(InputError, match=r"t.csv:3: lemon \+ sugar \+ water is 90; it must be 100 in this study\."):
        read_trials(tmp_path / "t.csv", study)


def test_rows_within_the_tolerance_of_a_program_are_read(tmp_path):
    (tmp_path / "study.toml").write_text(FILE + "[stimulus]\ntolerance = {lemon = 4.0, sugar = 3.0}\n")
    (tmp_path / "t.csv").write_text("participant,trial,response,lemon,sugar,water\nA,1,like,24,23,60\n")
    assert len(read_trials(tmp_path / "t.csv", Study.load(tmp_path / "study.toml"))) == 1


def test_a_set_that_violates_the_equality_is_refused_with_its_name(study, tmp_path, capsys, monkeypatch):
    head = "set_id,source,lemon,sugar,water\nbest,aggregate,33.3,33.3,33.3\n"
    (tmp_path / "sets.csv").write_text(head + "mid,aggregate,10,60,30\n")
    assert list(sets_of_study(tmp_path / "sets.csv", study.file).index) == ["best", "mid"]
    (tmp_path / "sets.csv").write_text(head + "mid,aggregate,10,50,30\n")
    (tmp_path / "v.csv").write_text(
        "participant,trial,set_a,set_b,first,class_a,class_b,preferred\nA,1,best,mid,a,like,like,a\n"
    )
    files = "--study", tmp_path / "study.toml", "--sets", tmp_path / "sets.csv", "--out", tmp_path / "o"
    code, _, text = run(capsys, monkeypatch, "validate", tmp_path / "v.csv", *files)
    sentence = 'sets.csv: the set "mid": lemon + sugar + water is 90; it must be 100 in this study.'
    assert code == 2 and sentence in " ".join(text.split()) and not (tmp_path / "o").exists()


@pytest.mark.parametrize(("water", "accepted"), [(30.0, True), (30.05, True), (20.0, False)])
def test_a_presented_stimulus_satisfies_the_equality(study, water, accepted):
    session, at = Session.start(study, seed=0), {"lemon": 10.0, "sugar": 60.0, "water": water}
    if accepted:
        assert session.tell("like", at=at).points.tolist() == [[10.0, 60.0, water]]
        return
    with pytest.raises(InputError, match=r"Session: lemon \+ sugar \+ water is 90; it must be 100 in this study\."):
        session.tell("like", at=at)
    assert len(session.answers) == 0


def test_a_truth_that_violates_the_equality_is_refused(tmp_path, capsys, monkeypatch):
    (tmp_path / "study.toml").write_text(FILE.replace("water = 70", "water = 60"))
    code, _, text = run(capsys, monkeypatch, "simulate", "--study", tmp_path / "study.toml", "--out", tmp_path / "o")
    assert code == 2 and "simulation.truth: lemon + sugar + water is 90; it must be 100 in this study." in text


def test_slices_and_curves_stay_in_the_mixture(study):
    def surface(x):
        return jnp.sum(x, axis=1), jnp.ones(len(x))

    here = grid_slice(study, surface, np.array([0.2, 0.3, 0.5]), None)
    shown = ~np.isnan(here.mean)
    assert 0.45 < shown.mean() < 0.55 and not shown[-1, -1] and shown[0, 0]
    np.testing.assert_allclose(here.mean[shown], 1.0)
    for name in ("lemon", "water"):
        points, feasible = slice_through(study, jnp.array([0.2, 0.3, 0.5]), name, jnp.linspace(0.0, 1.0, 11))
        kept = points[:, study.space.names.index(name)]
        np.testing.assert_allclose(kept, np.linspace(0.0, 1.0, 11))
        np.testing.assert_allclose(np.sum(points, axis=1), 1.0, atol=1e-14)
        np.testing.assert_array_equal(feasible, np.min(points, axis=1) >= 0)
    (point,), _ = slice_through(study, jnp.array([0.2, 0.3, 0.5]), "lemon", jnp.array([0.75]))
    assert study.space.broken(point) == "constraint"
    assert not on_grid(study.space)


def test_a_mixture_of_two_is_a_curve():
    two = Study.from_dict(
        {
            "schema": 1,
            "study": {"name": "two", "responses": ["no", "yes"]},
            "parameters": {n: {"low": 0.0, "high": high} for n, high in (("a", 10.0), ("b", 8.0))},
            "constraints": [{"terms": {"a": 1.0, "b": 1.0}, "least": 10.0, "most": 10.0}],
            "gp": {"theta": 3.0, "variance": 1.0, "thresholds": [0.0], "noise": 0.5},
        }
    )
    assert two.space.free == (1,) and two.space.names[two.space.dependent[0]] == "a"
    physical, mean, _ = curve(two, lambda x: (x[:, 0], jnp.ones(len(x))))
    np.testing.assert_allclose(mean, 1.0 - physical / 10.0)


def test_an_optimum_in_a_mixture_lies_on_no_constraint(study):
    sd, asked = jnp.asarray(0.3), jnp.asarray(0.25)
    assert location_sentences(study, jnp.array([0.2, 0.3, 0.5]), sd, asked) == []
    (sentence,) = location_sentences(study, jnp.array([0.0, 0.3, 0.7]), sd, asked)
    assert sentence == "The optimum is at the natural end of lemon (0 %)."


@pytest.mark.parametrize(("text", "end"), [("a + b = 1", 1.0), ("1 = a + b", 1.0), ("a + b - 3 = 2 a - b", -3.0)])
def test_an_equality_is_read_as_it_is_written(text, end):
    read = constraint_of(text, ["a", "b"])
    weights = {"a": -1.0, "b": 2.0} if end < 0 else {"a": 1.0, "b": 1.0}
    assert (dict(read.terms), read.least, read.most) == (weights, 3.0 if end < 0 else end, 3.0 if end < 0 else end)


def test_hilbo_init_writes_a_mixture():
    parameters = tuple(parameter_of(f"{name}=0:100:%") for name in ("lemon", "sugar", "water"))
    text = study_text(NewStudy("lemonade", parameters, constraints=("lemon + sugar + water = 100",)))
    assert "lemon + sugar + water = 100" in text and "least = 100.0" in text
    assert Constraint((("lemon", 1.0), ("sugar", 1.0)), 1.0, 1.0).words == "lemon + sugar = 1"
    for wrong in ("a = b = 1", "a == 1", "a + b = 1 <= 2"):
        with pytest.raises(InputError, match="write a sum of parameters and its bound"):
            constraint_of(wrong, ["a", "b"])


@pytest.mark.deep
def test_a_session_proposes_mixtures(study):
    session = Session.start(study, seed=2)
    for trial in range(8):
        values = session.ask()
        assert sum(values.values()) == pytest.approx(100.0, abs=1e-10) and min(values.values()) >= 0
        session = session.tell(("neutral", "like", "dislike")[trial % 3])
    assert sum(session.best().values()) == pytest.approx(100.0, abs=1e-10)


@pytest.mark.deep
def test_a_mixture_is_reported(study, tmp_path, capsys, monkeypatch):
    file, folder = tmp_path / "study.toml", tmp_path / "simulated"
    code, text, log = run(
        capsys, monkeypatch, "simulate", "--study", file, "--participants", 5, "--out", folder, "--seed", 4, "--json"
    )
    assert code == 0, log
    content = json.loads(text)
    assert sum(content["optimum"]["parameters"].values()) == pytest.approx(100.0, abs=1e-10)
    table = pd.read_csv(folder / "trials.csv")
    np.testing.assert_allclose(table[["lemon", "sugar", "water"]].sum(axis=1), 100.0, atol=1e-10)
    assert cohort_of(read_trials(folder / "trials.csv", study), study).counts().tolist() == [8] * 5
    page = " ".join((folder / "report.html").read_text().split())
    assert "The value of water follows from lemon + sugar + water = 100." in page and "cannot change alone" in page
    assert "on the study&#39;s constraint" not in page and "on the constraint" not in page
