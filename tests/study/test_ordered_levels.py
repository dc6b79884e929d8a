"""Ordered levels: their kernel, their positions, what a study file may say of them, and where their names appear."""

import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from commands import run
from hypothesis import given, settings
from hypothesis import strategies as st

from hilbo import Session
from hilbo.errors import InputError
from hilbo.kernels import RBF, gram
from hilbo.search.apart import levels_of
from hilbo.search.box import Parameter
from hilbo.search.levels import index_at, position_of
from hilbo.study.config import Study
from hilbo.study.estimate.location import location_sentences
from hilbo.study.template import parameter_of

NAMES = ["low", "medium", "high"]
RAW = {
    "schema": 1,
    "study": {"name": "drinks", "responses": ["no", "maybe", "yes"]},
    "parameters": {"sugar": {"levels": NAMES, "ordered": True}, "lemon": {"low": 0.0, "high": 10.0, "unit": "%"}},
    "gp": {"theta": [1.5, 8.0], "variance": 1.0, "thresholds": [-0.5, 0.5], "noise": 0.5},
    "selection": {"trials": 6, "space_filling": 3},
}


def drinks(**sugar):
    """The study, with other keys of its ordered levels."""
    return Study.from_dict(RAW | {"parameters": RAW["parameters"] | {"sugar": RAW["parameters"]["sugar"] | sugar}})


def test_low_and_high_are_less_alike_than_low_and_medium():
    kernel = drinks().gp.kernel
    x = jnp.array([[0.0, 0.3], [0.5, 0.3], [1.0, 0.3]])
    low, medium, high = np.asarray(gram(kernel, x, x))[0]
    assert (low, medium) == (1.0, pytest.approx(np.exp(-1.5 / 4))) and high == pytest.approx(np.exp(-1.5))
    assert levels_of(drinks().space.parameters) == () and kernel.levels == ()


def test_two_ordered_levels_are_two_unordered_ones_of_the_same_theta():
    theta = -math.log(0.3)
    ordered = RBF((theta, 8.0), 1.0, levels_of(drinks(levels=["none", "some"]).space.parameters))
    unordered = RBF((theta, 8.0), 1.0, (2, 0))
    x = jnp.array([[0.0, 0.1], [1.0, 0.7], [1.0, 0.1]])
    np.testing.assert_array_equal(gram(ordered, x, x), gram(unordered, x, x))


rising = st.lists(st.floats(-1e3, 1e3), min_size=2, max_size=6, unique=True).map(sorted)


@given(rising, st.booleans())
@settings(deadline=None, max_examples=10)
def test_every_level_is_found_again_at_its_position(at, single):
    if min(np.diff(at)) < 1e-2:
        return
    index = np.arange(len(at), dtype=np.float32 if single else np.float64)
    unit = position_of(at, index)
    assert unit.dtype == index.dtype and unit[0] == 0 and unit[-1] == 1
    np.testing.assert_allclose(unit, (np.array(at) - at[0]) / (at[-1] - at[0]), atol=1e-6 if single else 1e-12)
    np.testing.assert_array_equal(index_at(at, unit), index)
    traced = jax.jit(lambda index: index_at(at, position_of(at, index)))(jnp.asarray(index))
    np.testing.assert_array_equal(traced, index)


def test_positions_change_the_distances_and_equal_ones_change_nothing():
    x = jnp.asarray(drinks(at=[0, 1, 4]).space.to_unit(np.array([[0.0, 5.0], [1.0, 5.0], [2.0, 5.0]])))
    np.testing.assert_allclose(x[:, 0], [0.0, 0.25, 1.0])
    assert np.asarray(drinks(at=[0, 1, 4]).space.to_physical(jnp.array([[0.62, 0.5], [0.63, 0.5]])))[:, 0].tolist() == [
        1,
        2,
    ]
    even = drinks(at=[3, 4, 5]).space.candidates(64, 0)
    np.testing.assert_array_equal(even, drinks().space.candidates(64, 0))
    unordered = {"levels": NAMES, "correlation": 0.4}
    raw = RAW | {"gp": RAW["gp"] | {"theta": 8.0}, "parameters": RAW["parameters"] | {"sugar": unordered}}
    assert drinks().file.meaning == drinks(at=[0, 1, 4]).file.meaning == Study.from_dict(raw).file.meaning


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        ({"at": [0, 1]}, "parameters.sugar.at is [0.0, 1.0]; it must have 3 numbers, one per level."),
        ({"at": [0, 2, 1]}, "parameters.sugar.at is [0.0, 2.0, 1.0]; it must rise from each number to the next."),
        ({"at": [0, 1, 4], "ordered": False}, "parameters.sugar.at is of ordered levels; add ordered = true"),
        ({"correlation": 0.4}, "parameters.sugar.correlation is of unordered levels; leave it out"),
        ({"unit": "g"}, "parameters.sugar.unit is not used with levels, which have no numbers"),
        (
            {"natural_ends": ["low"], "ordered": False},
            "parameters.sugar.natural_ends is of ordered levels; add ordered",
        ),
        ({"natural_ends": ["none"]}, 'parameters.sugar.natural_ends is ["none"]; it must be a list of "low", "high"'),
        ({"ordered": "yes"}, 'parameters.sugar.ordered is "yes"; it must be true or false'),
    ],
)
def test_a_study_file_that_says_otherwise_is_refused(table, sentence):
    with pytest.raises(InputError) as refused:
        drinks(**table)
    assert str(refused.value).startswith(sentence) and str(refused.value).count(". ") == 0


def test_an_order_is_refused_for_numbers_and_lengths_count_it():
    with pytest.raises(InputError, match=r"parameters\.lemon\.ordered is of levels, and there are none"):
        Study.from_dict(RAW | {"parameters": RAW["parameters"] | {"lemon": {"low": 0, "high": 1, "ordered": True}}})
    with pytest.raises(InputError, match="it must be one number or 2, one per parameter"):
        Study.from_dict(RAW | {"gp": RAW["gp"] | {"theta": [1.0]}})


def test_the_end_of_an_order_is_named_by_its_level():
    sd, asked = jnp.asarray(0.3), jnp.asarray(0.25)
    (sentence,) = location_sentences(drinks(), jnp.array([1.0, 0.5]), sd, asked)
    assert sentence.startswith("The optimum is at the highest sugar that was searched (high): values")
    (sentence,) = location_sentences(drinks(natural_ends=["low"]), jnp.array([0.0, 0.5]), sd, asked)
    assert sentence == "The optimum is at the natural end of sugar (low)."


@pytest.mark.deep
def test_a_session_proposes_levels_by_name():
    session = Session.start(drinks(at=[0, 1, 4]), seed=3)
    for response in ("no", "yes", "maybe", "yes", "no"):
        assert session.ask()["sugar"] in NAMES
        session = session.tell(response)


def test_hilbo_init_writes_an_order():
    assert parameter_of("sugar=low<medium<high") == Parameter.of_levels("sugar", tuple(NAMES), ordered=True)


@pytest.mark.deep
@pytest.mark.parametrize("rule", ["learnt-2", "bcm"])
def test_a_study_with_an_order_is_reported(tmp_path, capsys, monkeypatch, rule):
    study, folder = tmp_path / "study.toml", tmp_path / "simulated"
    numbers = "[gp]\ntheta = [1.5, 8.0]\nvariance = 1.0\nthresholds = [-0.5, 0.5]\nnoise = 0.5\n"
    study.write_text(
        'schema = 1\n[study]\nname = "drinks"\nresponses = ["no", "maybe", "yes"]\n'
        '[parameters.sugar]\nlevels = ["low", "medium", "high"]\nordered = true\nat = [0, 1, 4]\n'
        'natural_ends = ["low"]\n[parameters.lemon]\nlow = 0\nhigh = 10\nunit = "%"\n'
        f'[aggregation]\nrule = "{rule}"\n{numbers if rule == "bcm" else ""}[selection]\ntrials = 10\n'
        '[simulation]\nspread = 0.03\ntruth = {sugar = "low", lemon = 5.0}\n'
    )
    code, text, log = run(
        capsys, monkeypatch, "simulate", "--study", study, "--participants", 4, "--out", folder, "--seed", 1, "--json"
    )
    assert code == 0, log
    content = json.loads(text)
    assert set(pd.read_csv(folder / "trials.csv")["sugar"]) <= set(NAMES)
    assert content["optimum"]["parameters"]["sugar"] == "low"
    assert "The optimum is at the natural end of sugar (low)." in content["warnings"]
    page = " ".join((folder / "report.html").read_text().split())
    assert "the natural end of sugar (low)." in page and "low &lt; medium &lt; high" in page
