"""Ids by one rule wherever they come in, and text that a spreadsheet would run refused there."""

import json
import sys

import pandas as pd
import pytest
from live import RAW, STUDY, Driver

from hilbo import Study
from hilbo.cli import main
from hilbo.errors import InputError
from hilbo.session.log import actions
from hilbo.session.log.records import RefusedError
from hilbo.session.plan.participants import add_person, read_people
from hilbo.session.plan.plan import make_plan
from hilbo.study.cohort import read_trials
from hilbo.study.formats.cell_text import is_id
from hilbo.study.tables.parameter_sets import read_sets
from hilbo.study.tables.validation import read_validation

FORMULAS = ("=1+1", "@SUM(A1)", "+cmd", "-cmd|' /C calc'!A1", "\t=1+1", "=HYPERLINK(A1)", " =1+1")
IN_ANOTHER_COUNTRY = ("a;=1+1", "a,@SUM(A1)", "a\t+cmd", 'a;"=1+1"', ";-cmd", "a;b;=1+1", "a\n=1+1")
PLAIN = ("-3", "+1.5e-3", "-", "a=1", "P01", "3 - 4", "1,-2", "a; b, - c", "a;-")
NO_IDS = (".", "..", "-x", "P 1", "../P1", "a/b", "é", "x" * 65, "=1+1", "NUL", "con.1", "Lpt1", "P01.")


def trials(path, **changes):
    row = {"participant": "P01", "trial": 1, "response": "close", "u": 0.5, "v": 0.5, "session": "1", "notes": "good"}
    pd.DataFrame([row | changes]).to_csv(path, index=False)
    return path


def compared(path, **changes):
    row = {"participant": "P01", "trial": 1, "set_a": "best", "set_b": "mid", "class_a": "", "class_b": ""}
    pd.DataFrame([row | {"preferred": "a", "notes": ""} | changes]).to_csv(path, index=False)
    return path


def sets(path, **changes):
    row = {"set_id": "best", "source": "aggregate", "u": 0.5, "v": 0.5, "notes": ""}
    pd.DataFrame([row | changes]).to_csv(path, index=False)
    return path


def people(path, **changes):
    row = {"participant": "P01", "consent_time": "2026-05-04T10:00", "protocol_number": "7", "notes": ""}
    pd.DataFrame([row | changes]).to_csv(path, index=False)
    return path


def added(path):
    (row,) = pd.read_csv(path, dtype=str, keep_default_na=False).to_dict("records")
    return add_person(path.with_name(f"new-{len(list(path.parent.iterdir()))}.csv"), row)


READ = {
    "trials": (trials, lambda path: read_trials(path, STUDY)),
    "validation": (compared, lambda path: read_validation(path, STUDY.responses)),
    "sets": (sets, lambda path: read_sets(path, ("source", "u", "v"))),
    "people": (people, read_people),
    "added": (people, added),
}
TEXTS = [
    *(("trials", column) for column in ("session", "notes")),
    *(("validation", column) for column in ("set_a", "notes")),
    *(("sets", column) for column in ("set_id", "notes")),
    *((table, column) for table in ("people", "added") for column in ("protocol_number", "notes")),
]


@pytest.mark.parametrize(("table", "column"), TEXTS)
def test_text_that_a_spreadsheet_would_run_is_refused(tmp_path, table, column):
    make, read = READ[table]
    for text in PLAIN:
        read(make(tmp_path / "good.csv", **{column: text}))
    for text in (*FORMULAS, *IN_ANOTHER_COUNTRY):
        path = make(tmp_path / "bad.csv", **{column: text})
        content = path.read_bytes()
        with pytest.raises(InputError, match="spreadsheet would run"):
            read(path)
        assert path.read_bytes() == content
    with pytest.raises(InputError, match="the name of a column"):
        read(make(tmp_path / "head.csv", **{"=1+1": "x"}))


@pytest.mark.parametrize(
    "person", ["x" * 64, "5f0c6d4e-9a1b-4c3d-8e7f-0123456789ab", "null", "com", "COM10", "P.1", "A"]
)
def test_these_are_ids(person):
    assert is_id(person)


@pytest.mark.parametrize("table", ["trials", "validation", "people", "added"])
@pytest.mark.parametrize("person", NO_IDS)
def test_an_id_is_one_everywhere(tmp_path, table, person):
    make, read = READ[table]
    with pytest.raises(InputError, match=r"participant is "):
        read(make(tmp_path / "bad.csv", participant=person))
    with pytest.raises(InputError, match=r"participant is "):
        read_sets(sets(tmp_path / "sets.csv", source=f"individual:{person}"), ("source", "u", "v"))
    with pytest.raises(InputError, match=r"participant is "):
        make_plan(STUDY.file, [person])
    with pytest.raises(InputError, match=r"participant is "):
        add_person(tmp_path / "new.csv", {"participant": person})


@pytest.mark.parametrize(
    "change",
    [
        {"study": RAW["study"] | {"name": "=1+1"}},
        {"study": RAW["study"] | {"responses": ["no", "=1+1"]}},
        {"parameters": {"=u": RAW["parameters"]["u"]}},
        {"parameters": {"u": RAW["parameters"]["u"] | {"unit": "@x"}}},
        {"materials": {"+foam": {}}},
    ],
)
def test_a_study_file_names_nothing_so(change):
    with pytest.raises(InputError, match="spreadsheet would run"):
        Study.from_dict(RAW | change)
    Study.from_dict(RAW | {"study": RAW["study"] | {"responses": ["-1", "0", "+1"]}})


def test_words_of_a_session_are_refused_where_they_are_said():
    driver = Driver()
    driver.step()
    driver.do("answer", 1)
    state = driver.state
    for act in (actions.undo, actions.abort, actions.note):
        words = {"at": 1.0, ("text" if act is actions.note else "reason"): "=1+1"}
        with pytest.raises(RefusedError, match="contains a formula for spreadsheets"):
            act(state, **words)
    with pytest.raises(RefusedError, match="contains a formula for spreadsheets"):
        actions.void(state, 1, "@SUM(A1)", 1.0)
    assert actions.note(state, "3 = 3", 1.0).data["text"] == "3 = 3"


def test_an_error_of_the_system_is_a_sentence(tmp_path, monkeypatch, capsys):
    (tmp_path / "study.toml").write_text("")
    monkeypatch.setattr(sys, "argv", ["hilbo", "plan", str(tmp_path / "study.toml"), "--participants", "2"])

    def full(*_):
        raise OSError(28, "No space left on device", "/tmp/here")

    monkeypatch.setattr("pathlib.Path.read_bytes", full)
    monkeypatch.setattr("hilbo.study.file.reading.StudyFile.load", staticmethod(full))
    with pytest.raises(SystemExit) as stopped:
        main.main()
    err = capsys.readouterr().err
    assert stopped.value.code == 1 and err.startswith("hilbo: /tmp/here: could not be read or written (No space left")
    assert "OSError" not in err and json.dumps(err).count("\\n") == 1
