"""Key results: the paper's numbers about a study, each against a second computation, and their table on the page."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from studies import paper_counts, plain

from hilbo import Study
from hilbo.errors import InputError
from hilbo.report.study import key_numbers as module
from hilbo.report.study.key_numbers import key_numbers, key_numbers_table, key_numbers_words
from hilbo.report.study.sessions import described, session_rows
from hilbo.report.validation import validate
from hilbo.study.analysis.analysis import Analysis
from hilbo.study.folder import Reference, _reference
from hilbo.study.tables.sessions import SessionRow, read_session_table

OWN = np.array([[0.1, 0.5], [0.9, 0.5], [0.5, 0.8], [0.3, 0.5]])
OTHERS = {"population_error": 4.0, "individual_error": "24 (13 to 41)", "preferred": 72.75}


@pytest.fixture
def analysed(monkeypatch):
    """An analysis of four people, as far as key results need it, with numbers of another study beside."""
    monkeypatch.setattr(module, "moved_by_evidence", lambda analysis: 0.028)
    study = plain()
    tables = {"schema": 1, **study.file.tables, "report": {"compare_with": OTHERS}}
    q, mask = np.tile([0, 2, 2, 1], (4, 1)), np.ones((4, 4), bool)
    mask[3, 1:] = False
    cohort = SimpleNamespace(trials=SimpleNamespace(q=q, mask=mask), counts=lambda: mask.sum(axis=1))
    x = SimpleNamespace(x=np.array([0.5, 0.45]))
    aggregate = SimpleNamespace(optimum=x, individuals=SimpleNamespace(x=OWN), mean_of_optima=OWN.mean(axis=0))
    population = SimpleNamespace(study=Study.from_dict(tables), aggregate=aggregate, cohort=cohort)
    return Analysis(population, *[None] * (len(Analysis._fields) - 1))


def test_key_results_agree_with_a_second_computation(analysed):
    place = np.array([0.4, 0.5])
    reference = Reference(place, "system identification", place - [0.05, 0.2], place + np.array([0.2, 0.1]))
    validated = validate(paper_counts(np.random.default_rng(4), ties=20))
    rows = {row.key: row for row in key_numbers(analysed, validated, reference)}
    assert rows["population_error"].value == pytest.approx(100 * np.sqrt((0.1**2 + 0.05**2) / 2))
    box = np.stack(np.meshgrid(*(np.linspace(a, b, 301) for a, b in zip(reference.low, reference.high, strict=True))))
    away = np.sqrt(((box - np.array([0.5, 0.45])[:, None, None]) ** 2).mean(axis=0))
    assert rows["population_error"][3:5] == pytest.approx((100 * away.min(), 100 * away.max()), abs=0.1)
    own = 100 * np.sqrt(((OWN - place) ** 2).mean(axis=1))
    assert rows["individual_error"][2:5] == pytest.approx((np.median(own), *np.quantile(own, [0.25, 0.75])))
    mean = 100 * np.sqrt(((OWN.mean(axis=0) - place) ** 2).mean())
    assert rows["mean_of_optima_error"].value == pytest.approx(mean)
    assert rows["hyperparameter_shift"].value == pytest.approx(2.8)
    assert rows["goal_answers"][2:5] == pytest.approx((1.5, 1.5 - 1.0, 1.5 + 1.0))  # 2, 2, 2 and 0
    assert rows["preferred"].value == pytest.approx(76.6, abs=0.05)
    assert rows["preferred"].low < 76.6 < rows["preferred"].high
    counts = validated.tables.confusion
    for role, label in (("best", "close"), ("mid", "similar"), ("worst", "different")):
        row = counts.iloc[("best", "mid", "worst").index(role)]
        assert rows[f"{role}_called"].value == pytest.approx(100 * row[label] / row.sum())


def test_the_page_puts_what_the_study_names_beside(analysed):
    table = key_numbers_table(analysed, key_numbers(analysed, None, Reference(np.array([0.4, 0.5]), "the truth")))
    words = {row[0]: row[1:] for row in key_numbers_words(table)}
    assert words["Population optimum: error to the truth (NRMSE) (%)"] == ["7.9", "4"]
    own = next(value for name, value in words.items() if name.startswith("Individual"))
    assert "(quartiles: " in own[0] and own[1] == "24 (13 to 41)"
    assert words['Responses "close" of 4 per participant, mean'] == ["1.5 ± 1.0", ""]
    assert words["Preferred (%)"] == ["–", "72.75"]  # without a validation
    alone = key_numbers_words(table.assign(compared_with=""))
    assert all(len(row) == 2 for row in alone)


@pytest.mark.parametrize(
    ("others", "sentence"),
    [
        ({"populaton_error": 4}, "report.compare_with.populaton_error is not a key of a study file"),
        ({"population_error": [4]}, "report.compare_with is .* must be a table of numbers or texts"),
        ({"population_error": "=1+1"}, "population_error"),
        ({"preferred": float("nan")}, "report.compare_with"),
    ],
)
def test_wrong_numbers_beside_are_refused(others, sentence):
    with pytest.raises(InputError, match=sentence):
        Study.from_dict({"schema": 1, **plain().file.tables, "report": {"compare_with": others}})


def test_a_reference_has_the_interval_of_its_identification():
    study = plain()
    row = {"source": "sysid"}
    for p in study.space.parameters:
        row |= {p.name: p.low + 0.5 * (p.high - p.low), f"{p.name}_low": p.low, f"{p.name}_high": p.high}
    whole = _reference(study, "", pd.DataFrame([row]), None)
    assert whole.name == "system identification" and whole.x == pytest.approx([0.5, 0.5])
    assert whole.low == pytest.approx([0.0, 0.0]) and whole.high == pytest.approx([1.0, 1.0])
    first = study.space.names[0]
    half_open = _reference(study, "", pd.DataFrame([row | {f"{first}_high": np.nan}]), None)
    assert half_open.low is not None and half_open.high is None
    with pytest.raises(InputError, match=f"{first}_low on the wrong side of its {first}"):
        _reference(study, "", pd.DataFrame([row | {f"{first}_low": row[f"{first}_high"]}]), None)


def test_sessions_are_counted_by_their_phases():
    held = [
        SessionRow(name, "1", "warm-up, optimisation", "", 0.0, end, "s", "")
        for name, end in (("A", 600.0), ("B", 720.0))
    ]
    held.append(SessionRow("A", "2", "validation", "", None, None, "s", ""))
    assert session_rows(held) == [
        ["warm-up, optimisation", "2", "2", "11 (10 to 12)"],
        ["validation", "1", "1", "–"],
    ]


def test_people_are_described_without_a_row_of_anybody():
    people = {
        "P01": {"age": "20", "handedness": "right"},
        "P02": {"age": "30", "handedness": "left"},
        "P03": {"age": "", "handedness": "right"},
        "P99": {"age": "80", "handedness": "both"},
    }
    about = described(people, ["P01", "P02", "P03", "V01"])
    ages, hands = "age 25.0 ± 7.1 years (20 to 30; known of 2)", "handedness: right 2, left 1 (known of 3)"
    assert about["words"] == f"4 participants: {ages}; {hands}."
    assert about["mean_age"] == 25.0 and "P01" not in str(about)
    assert described({}, ["P01"])["words"] == "1 participant; their ages and handedness are not known."


@pytest.mark.parametrize("time", ["noon", "nan", "-inf"])
def test_a_table_of_sessions_with_a_time_that_is_no_number_is_refused(tmp_path, time):
    (tmp_path / "data").mkdir()
    path = tmp_path / "data" / "study-x_table-sessions_data.csv"
    path.write_text(f"{','.join(SessionRow._fields)}\nA,1,optimisation,,{time},5,s,\n")
    with pytest.raises(InputError, match=f'began_at is "{time}"; it must be a number of seconds'):
        read_session_table(tmp_path)
