"""From logs to tables and back: the same bits by every way, and nothing left of somebody who was deleted."""

import json
import os

import arviz
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from live import RAW, STUDY, Driver

from hilbo import Study
from hilbo.errors import InputError
from hilbo.session.export.netcdf import netcdf
from hilbo.session.export.psych_ds import psych_ds
from hilbo.session.export.tables import read_log_trials, read_sessions, sets_table, trials_table
from hilbo.session.log.event_log import EventLog
from hilbo.session.log.log_files import log_name
from hilbo.session.plan.participants import add_person, check_consent, read_people
from hilbo.session.withdrawal.withdrawal import delete_participant
from hilbo.study.cohort import cohort_of, read_trials
from hilbo.study.tables.validation import read_validation, sets_frame


def write(folder, person, kind, session, doings=(), **facts):
    import msgspec

    driver = Driver(kind)
    driver.header = msgspec.structs.replace(driver.header, participant=person, session=session, **facts)
    driver.state = type(driver.state).start(STUDY.file, driver.header)
    driver.step()
    for doing in doings:
        driver.do(*doing)
    driver.finish()
    folder.mkdir(exist_ok=True)
    with EventLog.create(folder / log_name(driver.header), STUDY.file, driver.header) as log:
        for event in driver.events:
            log.append(event)
    return driver.state


def test_flags_are_columns_and_empty_where_there_is_no_record(tmp_path):
    state = write(tmp_path / "logs", "P01", "optimisation", "1")
    answered = [trial for trial in state.trials if trial.values is not None]
    counts = [trial.telemetry for trial in answered]
    assert None in counts and {"samples": 8} in counts and {"samples": 8, "slewed": 1, "saturated": 2} in counts
    psych_ds([state], tmp_path / "out", STUDY.file)
    path = tmp_path / "out" / "data" / "study-plain_table-trials_data.csv"
    cells = pd.read_csv(path, dtype=str, keep_default_na=False)
    cell = {None: ("", ""), 1: ("", "8"), 3: ("saturated slewed", "8")}
    wanted = [cell[None if count is None else len(count)] for count in counts]
    assert list(zip(cells["flags"], cells["telemetry_samples"], strict=True)) == wanted
    leaves_out = Study.from_dict(RAW | {"study": RAW["study"] | {"exclude_flags": ["slewed"]}})
    kept = [t.number for t in answered if t.data["phase"] == "optimisation" and len(t.telemetry or {}) < 2]
    assert netcdf([state], tmp_path / "trials.nc", leaves_out.file)
    with xr.open_dataset(tmp_path / "trials.nc", group="constant_data", engine="h5netcdf") as constant:
        assert constant["trial"].values.tolist() == kept and 0 < len(kept) < 6
    leaves_out = Study.from_dict(RAW | {"study": RAW["study"] | {"exclude_flags": ["slewed"]}})
    kept = [t.number for t in answered if t.data["phase"] == "optimisation" and len(t.telemetry or {}) < 2]
    assert netcdf([state], tmp_path / "trials.nc", leaves_out.file)
    with xr.open_dataset(tmp_path / "trials.nc", group="constant_data", engine="h5netcdf") as constant:
        assert constant["trial"].values.tolist() == kept and 0 < len(kept) < 6
    sidecar = json.loads(path.with_suffix(".json").read_text())["variableMeasured"]
    words = {variable["name"]: variable["description"] for variable in sidecar}
    assert "saturated, slewed" in words["flags"] and "empty where none were recorded" in words["telemetry_samples"]


TROUBLE = [("answer", 1)] * 2 + [("go", 0), ("answer", 2), ("answer", 0), ("undo", 0), ("void old", 2), ("answer", 1)]


@pytest.fixture
def folder(tmp_path):
    logs = tmp_path / "logs"
    write(logs, "P01", "optimisation", "1")
    write(logs, "P02", "optimisation", "1", [*TROUBLE, ("again", 6), ("hold", 0)])
    write(logs, "P03", "validation", "2", [("answer", 1), ("void", 0)])
    return logs


def test_logs_and_exported_table_give_the_same_bits(folder, tmp_path):
    sessions = read_sessions(folder, STUDY.file)
    out = tmp_path / "out"
    psych_ds(sessions, out, STUDY.file)
    path = out / "data" / "study-plain_table-trials_data.csv"
    notes = []
    direct, exported = (
        read_log_trials(folder, STUDY.file, note=notes.append).rows.reset_index(drop=True),
        read_trials(path, STUDY, note=notes.append).reset_index(drop=True),
    )
    of_logs, of_table = (note.partition(": ") for note in notes)
    assert (of_logs[0], of_table[0]) == (str(folder), str(path)) and of_logs[2] == of_table[2]
    assert of_logs[2].endswith("not fitted; P03 has no other answer in it.")  # who validated, after a warm-up
    pd.testing.assert_frame_equal(direct, exported, check_exact=True)
    assert direct["participant"].value_counts().to_dict() == {"P01": 6, "P02": 6}
    for state in sessions[:2]:
        chosen = [t.renderings["a"]["u"] for t in state.answers(1)]
        here = direct[direct["participant"] == state.header.participant]
        assert here["u"].tolist() == chosen
        assert here["response"].tolist() == [t.values["class_a"] for t in state.answers(1)]
    one, two = cohort_of(direct, STUDY), cohort_of(exported, STUDY)
    for a, b in zip(
        (one.trials.x, one.trials.q, one.physical), (two.trials.x, two.trials.q, two.physical), strict=True
    ):
        np.testing.assert_array_equal(a, b)
    table = trials_table(sessions)
    assert set(table["phase"]) == {"warm-up", "optimisation", "repeat"} and table["voided"].sum() >= 2


def test_the_psych_ds_folder_describes_every_column(folder, tmp_path):
    written = psych_ds(read_sessions(folder, STUDY.file), tmp_path / "out", STUDY.file)
    description = json.loads((tmp_path / "out" / "dataset_description.json").read_text())
    measured = {variable["name"] for variable in description["variableMeasured"]}
    tables = [path for path in written if path.suffix == ".csv"]
    assert len(tables) == 5
    for path in tables:
        table = pd.read_csv(path)
        assert set(table.columns) <= measured
        sidecar = json.loads(path.with_suffix(".json").read_text())
        assert [variable["name"] for variable in sidecar["variableMeasured"]] == list(table.columns)
    data = tmp_path / "out" / "data"
    comparisons = read_validation(data / "study-plain_table-validation_data.csv", STUDY.responses)
    assert len(comparisons) == 6 and set(comparisons["participant"]) == {"P03"}
    sets = sets_frame(data / "study-plain_table-sets_data.csv", ("u", "v"))
    assert set(sets.index) == set("DEF") and sets.loc["D", "u"] == 0.123456789 + 0.3


def test_netcdf_is_read_by_xarray_and_arviz(folder, tmp_path):
    path = tmp_path / "trials.nc"
    netcdf(read_sessions(folder, STUDY.file), path, STUDY.file)
    tree = xr.open_datatree(path, engine="h5netcdf").load()
    assert tree["observed_data"]["category"].sizes == {"obs_id": 12}  # without the repetition, which is never fitted
    data = arviz.from_netcdf(str(path))
    table = read_log_trials(folder, STUDY.file).rows
    assert set(data.constant_data["phase"].values) == {"optimisation"}
    assert sorted(data.constant_data["u"].values) == sorted(table["u"])
    assert data.observed_data["category"].values.sum() == table["category"].sum()
    tree.close()


def test_one_participant_is_deleted_from_everything(folder, tmp_path):
    psych_ds(read_sessions(folder, STUDY.file), tmp_path / "out", STUDY.file)
    netcdf(read_sessions(folder, STUDY.file), tmp_path / "out" / "trials.nc", STUDY.file)
    people = tmp_path / "participants.csv"
    for person in ("P01", "P02", "P03"):
        add_person(people, {"participant": person, "consent_time": "2026-05-04T10:00", "protocol_number": "7"})
    gone = delete_participant(tmp_path, "P02")
    assert len(gone.removed) == 5 and not gone.renamed  # list, three tables, log
    assert set(gone.left) == {str(tmp_path / "out" / "trials.nc")}
    assert set(read_people(people)) == {"P01", "P03"}
    for path in tmp_path.rglob("*"):
        if path.suffix in (".csv", ".jsonl"):
            assert "P02" not in path.read_text()
    assert set(read_log_trials(folder, STUDY.file).rows["participant"]) == {"P01"}
    with pytest.raises(InputError, match='nothing of participant "P02"'):
        delete_participant(tmp_path, "P02")
    with (
        EventLog.resume(next(folder.glob("P01*")), STUDY.file),
        pytest.raises(InputError, match="end the session first"),
    ):
        delete_participant(tmp_path, "P01")


def test_keys_of_somebody_whose_id_begins_alike_stay(folder):
    write(folder, "P02-b", "optimisation", "1")
    for name in (".P02-1", ".P02-b-1"):
        (folder / f"{name}.keys").write_text("{}")
    delete_participant(folder, "P02")
    assert [path.name for path in folder.glob("*.keys")] == [".P02-b-1.keys"]


def test_a_deletion_on_a_full_disk_changes_nothing(folder, monkeypatch, tmp_path):
    people = tmp_path / "participants.csv"
    add_person(people, {"participant": "P02", "consent_time": "2026-05-04T10:00", "protocol_number": "7"})
    real = os.replace

    def full(source, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(InputError, match=r"cannot be written \(No space left on device\); nothing was changed"):
        delete_participant(tmp_path, "P02")
    assert list(folder.glob("P02*")) and sorted(tmp_path.iterdir()) == [folder, people]
    monkeypatch.setattr(os, "replace", real)
    assert str(people) in delete_participant(tmp_path, "P02").removed and not list(folder.glob("P02*"))


def test_dry_runs_are_nobodys_answers(folder, tmp_path):
    before, heard = read_log_trials(folder, STUDY.file).rows, []
    for session in ("1", "2"):
        write(folder, "test", "optimisation", session, dry_run=True)
    pd.testing.assert_frame_equal(read_log_trials(folder, STUDY.file, note=heard.append).rows, before)
    assert heard[0] == f"{folder}: 2 dry runs are left out." and len(heard) == 2  # the other is of who validated
    assert {state.header.participant for state in read_sessions(folder, STUDY.file)} == {"P01", "P02", "P03"}
    write(tmp_path / "dry", "test", "optimisation", "1", dry_run=True)
    with pytest.raises(InputError, match="contains only dry runs"):
        read_sessions(tmp_path / "dry", STUDY.file)


def test_a_log_that_lacks_its_last_newline_is_whole_and_one_cut_off_is_said(folder):
    heard = []
    before = read_log_trials(folder, STUDY.file, note=heard.append).rows  # P03 has no answer that counts
    path, same = folder / "P01_1.session.jsonl", list(heard)
    heard.clear()
    whole = path.read_bytes()
    path.write_bytes(whole[:-1])
    pd.testing.assert_frame_equal(read_log_trials(folder, STUDY.file, note=heard.append).rows, before)
    assert heard == same
    heard.clear()
    path.write_bytes(whole[:-9])
    read_log_trials(folder, STUDY.file, note=heard.append)
    sentence, _ = heard
    last = len(whole.splitlines())
    assert sentence.startswith(f"{path}:{last}: the last line is cut off, and is left out;")
    heard.clear()
    path.write_bytes(b"")  # a copy onto a full disk
    assert set(read_log_trials(folder, STUDY.file, note=heard.append).rows["participant"]) == {"P02"}
    sentence, _ = heard
    assert sentence.startswith(f"{path}: has no whole first line, and is left out;")


def test_two_logs_of_one_session_are_refused_with_both_names(folder):
    path = folder / "P01_1.session.jsonl"
    copy = folder / "P01_1 (copy).session.jsonl"
    copy.write_bytes(path.read_bytes())
    for read in (read_sessions, read_log_trials):
        with pytest.raises(InputError) as refused:
            read(folder, STUDY.file)
        text = str(refused.value)
        assert text.startswith(
            f'{folder}: "{copy.name}" and "{path.name}" are both logs of session 1 of participant P01'
        )
    copy.unlink()
    write(folder, "P01", "validation", "2")  # another session of theirs is none
    assert len(read_sessions(folder, STUDY.file)) == 4


def test_answers_of_hilbo_try_are_marked_and_not_read_beside_others(folder, tmp_path):
    write(folder, "try-1", "optimisation", "1", unblinded="try")
    table = trials_table(read_sessions(folder, STUDY.file))
    assert set(table.loc[table["unblinded"] == "try", "participant"]) == {"try-1"}
    assert set(table.loc[table["unblinded"].isna(), "participant"]) == {"P01", "P02", "P03"}
    with pytest.raises(InputError, match="is an unblinded response, as of hilbo try"):
        read_log_trials(folder, STUDY.file)
    write(tmp_path / "own", "try-1", "optimisation", "1", unblinded="try")
    assert set(read_log_trials(tmp_path / "own", STUDY.file).rows["participant"]) == {"try-1"}
    (folder / "try-1_1.session.jsonl").unlink()
    assert "unblinded" not in read_log_trials(folder, STUDY.file).rows


def test_folders_without_answers_are_refused(tmp_path):
    with pytest.raises(InputError, match="contains no session logs"):
        read_log_trials(tmp_path, STUDY.file)
    driver = Driver()
    EventLog.create(tmp_path / log_name(driver.header), STUDY.file, driver.header).close()
    with pytest.raises(InputError, match="have no responses yet"):
        read_log_trials(tmp_path, STUDY.file)
    assert not netcdf(read_sessions(tmp_path, STUDY.file), tmp_path / "x.nc", STUDY.file)
    assert not (tmp_path / "x.nc").exists()


def test_one_name_for_two_sets_is_refused(folder):
    import msgspec

    state = read_sessions(folder, STUDY.file)[2]
    other = msgspec.structs.replace(state.header, sets=state.header.sets | {"D": {"u": 0.5, "v": 0.5}})
    with pytest.raises(InputError, match='the set "D" of participant P03'):
        sets_table([state, type(state).start(STUDY.file, other)])


def test_consent_comes_before_the_first_trial(tmp_path):
    path = tmp_path / "participants.csv"
    row = {"participant": "P01", "consent_time": "", "protocol_number": "FENS-1", "age": "23", "handedness": "right"}
    people = add_person(path, row)
    with pytest.raises(InputError, match="has no consent_time"):
        check_consent(people, "P01")
    with pytest.raises(InputError, match="not in the list"):
        check_consent(people, "P02")
    people = add_person(path, row | {"participant": "P02", "consent_time": "2026-05-04T10:15"})
    assert check_consent(people, "P02", "FENS-1")["age"] == "23"
    with pytest.raises(InputError, match="agreed to protocol FENS-1, the study's is FENS-2"):
        check_consent(people, "P02", "FENS-2")
    for change, sentence in (
        ({"participant": "Ada Lovelace"}, "a person's name"),
        ({"age": "old"}, "whole number of years"),
        ({"handedness": "paw"}, "right, left, both"),
        ({"consent_time": "yesterday"}, "write it as 2026"),
        ({}, "is there already"),
    ):
        with pytest.raises(InputError, match=sentence):
            add_person(path, row | change)
    path.write_text("participant,age\nP01,3\n")
    with pytest.raises(InputError, match='1: column "consent_time" is missing'):
        read_people(path)
    path.write_text("participant,consent_time,protocol_number,note,note\nP1,2026-01-03T10:00,1,room 3,paid\n")
    with pytest.raises(InputError, match='1: column "note" is there twice'):
        add_person(path, row)
    assert "room 3" in path.read_text()


@pytest.mark.parametrize("mark", [",", ";"])
def test_a_list_of_people_keeps_what_stands_between_its_cells(tmp_path, mark):
    path = tmp_path / "participants.csv"
    head = mark.join(("participant", "consent_time", "protocol_number", "seat"))
    path.write_text(f"{head}\n" + mark.join(("P1", "2026-05-04T10:00", "7", "left")) + "\n")
    add_person(path, {"participant": "P2", "consent_time": "2026-05-04T11:00", "protocol_number": "7"})
    assert {name: row["seat"] for name, row in read_people(path).items()} == {"P1": "left", "P2": ""}
    assert all(line.count(mark) == 5 for line in path.read_text().splitlines())
    path.write_text(f"{head}\n" + mark.join(("P1", "2026-05-04T10:00", "7", "left", "more")) + "\n")
    with pytest.raises(InputError, match=r"participants.csv:2: has 5 cells, the header has 4; fix that line"):
        read_people(path)
