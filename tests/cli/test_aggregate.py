"""Whose answers, and which material's, `hilbo aggregate` takes from a table."""

import contextlib
from types import SimpleNamespace

import pandas as pd
import pytest
from studies import PLAIN, plain

from hilbo.cli.aggregate import _included, _whole, read_cohort
from hilbo.errors import InputError
from hilbo.study.cohort import cohort_of
from hilbo.study.config import Study
from hilbo.study.formats import csv_file
from hilbo.study.formats.csv_rows import open_csv

STUDY = """schema = 1
[study]
name = "two"
responses = ["no", "yes"]
[parameters.u]
low = 0.0
high = 2.0
[gp]
theta = 3.0
variance = 1.0
thresholds = [0.0]
noise = 0.5
[materials.gel.parameters.u]
high = 8.0
[materials.foam]
"""


@pytest.fixture
def read(tmp_path):
    """Reads a table of answers by the study."""
    (tmp_path / "study.toml").write_text(STUDY)

    def of(text):
        (tmp_path / "t.csv").write_text(text)
        return read_cohort(tmp_path / "t.csv", tmp_path / "study.toml", None, lambda *said: None)

    return of


def test_a_table_of_one_material_is_read_as_that_material(read):
    study, cohort, _ = read("participant,trial,response,u,material\nA,1,yes,4.0,gel\n")
    assert study.space.parameters[0].high == 8.0 and float(cohort.trials.x[0, 0, 0]) == 0.5


def test_a_table_of_two_materials_or_of_an_unknown_one_is_refused(read):
    with pytest.raises(InputError, match=r"contains 2 materials \(gel, foam\); choose one with --material"):
        read("participant,trial,response,u,material\nA,1,yes,1,gel\nA,1,no,1,foam\n")
    with pytest.raises(InputError, match=r"materials\.silk is not in the study, its materials: gel, foam"):
        read("participant,trial,response,u,material\nA,1,yes,1,silk\n")


def test_a_table_is_opened_once(read, monkeypatch):
    opened = []
    monkeypatch.setattr(csv_file, "open_csv", lambda path, needs: opened.append(path) or open_csv(path, needs))
    read("participant,trial,response,u,material\nA,1,yes,4.0,gel\n")
    assert len(opened) == 1


def test_a_table_of_no_material_says_so(read, capsys):
    study, *_ = read("participant,trial,response,u\nA,1,yes,1\n")
    assert study.space.parameters[0].high == 2.0
    assert "t.csv: names no material; it is read by" in capsys.readouterr().err


def test_whom_the_study_leaves_out_is_not_aggregated(capsys):
    study = Study.from_dict(PLAIN | {"study": PLAIN["study"] | {"exclude": "trials < 2"}})
    rows = {"participant": ["A", "B", "B", "B"], "trial": [1, 1, 2, 3], "response": "similar", "u": 0.5, "v": 15.0}
    cohort = cohort_of(pd.DataFrame(rows), study)
    say = SimpleNamespace(printed=[])
    kept, sentences = _included(study, cohort, say)
    assert kept.names == ("B",) and sentences == ['[study] exclude = "trials < 2" leaves out 1: A (trials is 1).']
    assert sentences[0] in capsys.readouterr().err
    assert say.printed == sentences and _included(plain(), cohort, say) == (cohort, [])


@pytest.mark.parametrize(
    ("people", "devices", "individuals", "whole"),
    [(1000, 1, True, True), (1001, 1, True, False), (24, 2, True, False), (24, 1, False, False)],
)
def test_what_costs_another_fit_of_everybody_is_left_out_for_many_people(people, devices, individuals, whole):
    assert _whole(people, devices, individuals, compare=False) is whole
    with contextlib.nullcontext() if whole else pytest.raises(InputError, match="--compare is for up to 1,000 people"):
        assert _whole(people, devices, individuals, compare=True)
