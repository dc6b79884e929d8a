"""Somebody withdraws: their part goes, what others said stays, what is left can be read, and all of it is said."""

import json
from pathlib import Path

import msgspec
import numpy as np
import pandas as pd
import pytest
from commands import run
from live import STUDY, Driver
from withdrawn_study import SETS, older_log

from hilbo.cli.terminal.console import results
from hilbo.errors import InputError
from hilbo.session.log.event_log import EventLog
from hilbo.session.log.records import Header
from hilbo.session.plan.participants import read_people
from hilbo.session.plan.plan import make_plan, planned_header, planned_part, reissue
from hilbo.session.withdrawal import withdrawal
from hilbo.session.withdrawal.changes import command_without
from hilbo.session.withdrawal.withdrawal import delete_participant
from hilbo.study.cohort import read_trials
from hilbo.study.disk.lock import locked_folder
from hilbo.study.file.plan_file import Block, Planned, PlanRow, hashed, plan_text, read_plan
from hilbo.study.results.listing import list_files, listed
from hilbo.study.tables.validation import read_validation, sets_frame


@pytest.fixture
def folder(tmp_path):
    """A study whose sets are called after people, as those of earlier versions were."""
    rows = [(p, t, "close", 0.1 * t, 0.5) for p in ("P01", "P02", "P03") for t in (1, 2)]
    trials = pd.DataFrame(rows, columns=["participant", "trial", "response", "u", "v"])
    trials.to_csv(tmp_path / "trials.csv", index=False)
    trials.to_parquet(tmp_path / "trials-copy.parquet", index=False)
    sets = [
        {"set_id": name, "source": name.replace("own-", "individual:").replace("best", "aggregate"), **values}
        for name, values in SETS.items()
    ]
    pd.DataFrame(sets).to_csv(tmp_path / "sets.csv", index=False)
    compared = [(p, 1, "best", "own-P02", "", "", "own-P02") for p in ("P02", "P03")]
    columns = ["participant", "trial", "set_a", "set_b", "class_a", "class_b", "preferred"]
    pd.DataFrame(compared, columns=columns).to_csv(tmp_path / "validation.csv", index=False)
    (tmp_path / "plan.json").write_text(plan_text(make_plan(STUDY.file, ["P01", "P02", "P03"], 0)))
    return tmp_path


def delete(capsys, monkeypatch, folder, person):
    code, _, err = run(capsys, monkeypatch, "participants", "delete", folder, person, "--yes")
    assert code == 0, err
    return err


def test_answers_of_others_about_their_set_stay_and_can_be_read(folder, capsys, monkeypatch):
    err = delete(capsys, monkeypatch, folder, "P02")
    left = read_validation(folder / "validation.csv", STUDY.responses)
    sets = sets_frame(folder / "sets.csv", ("u", "v"))
    assert left["participant"].tolist() == ["P03"] and set(left["set_b"]) <= set(sets.index)
    (kept,) = set(left["set_b"])
    assert left["preferred"].tolist() == [kept] and sets.at[kept, "u"] == 0.1
    assert kept.startswith("own-withdrawn-") and sets.at[kept, "source"] == kept.replace("own-", "individual:")
    for path in (folder / "trials.csv", folder / "trials-copy.parquet"):
        assert set(read_trials(path, STUDY)["participant"]) == {"P01", "P03"}
    for path in folder.rglob("*"):
        assert path.suffix == ".parquet" or "P02" not in path.read_text(), path
    for name in ("trials.csv", "trials-copy.parquet", "validation.csv", "sets.csv", "plan.json"):
        assert f"{name}: " in err


@pytest.mark.filterwarnings("ignore::hilbo.errors.InputRemark")
def test_tables_with_semicolons_stay_so(folder):
    tables = {name: pd.read_csv(folder / name) for name in ("trials.csv", "sets.csv", "validation.csv")}
    for name, table in tables.items():
        table.to_csv(folder / name, index=False, sep=";", decimal=",")
    delete_participant(folder, "P02")
    left = read_trials(folder / "trials.csv", STUDY)
    assert left["u"].tolist() == tables["trials.csv"].query("participant != 'P02'")["u"].tolist()
    assert read_validation(folder / "validation.csv", STUDY.responses)["participant"].tolist() == ["P03"]
    assert sets_frame(folder / "sets.csv", ("u", "v"))["u"].tolist() == tables["sets.csv"]["u"].tolist()
    for name, table in tables.items():
        assert (folder / name).read_text().splitlines()[0] == ";".join(table.columns)


@pytest.mark.parametrize("mark", [",", ";", "\t"])
def test_blanks_before_a_quoted_id_hide_nobody(tmp_path, mark):
    path = tmp_path / "trials.csv"
    path.write_text(f'trial{mark} participant\n1{mark} "P1"\n2{mark} P2\n')
    delete_participant(tmp_path, "P1")
    assert path.read_text() == f"trial{mark}participant\n2{mark}P2\n"


def test_a_set_that_nobody_else_compared_goes(folder, capsys, monkeypatch):
    delete(capsys, monkeypatch, folder, "P01")
    assert set(sets_frame(folder / "sets.csv", ("u", "v")).index) == {"best", "own-P02"}


def test_a_plan_keeps_its_order_and_says_which_it_replaces(folder, capsys, monkeypatch):
    before = read_plan(folder / "plan.json")
    delete(capsys, monkeypatch, folder, "P02")
    after = read_plan(folder / "plan.json")
    assert after.replaces == (before.hash,) != (after.hash,)
    assert planned_header(after, STUDY.file, "P03").seed == planned_header(before, STUDY.file, "P03").seed
    label = after.participants[1].participant
    fresh = reissue(after, label, "P30")
    assert planned_header(fresh, STUDY.file, "P30").seed == planned_header(before, STUDY.file, "P02").seed
    with pytest.raises(InputError, match="not in the plan"):
        planned_header(after, STUDY.file, "P02")


def results_of(monkeypatch, folder, people, *command):
    monkeypatch.setattr("sys.argv", ["hilbo", *command])
    with results(folder, force=False) as made:
        (made / "result.json").write_text(json.dumps({"participants": [{"participant": name} for name in people]}))
        (made / "map.png").write_bytes(b"\x89PNG")


def test_results_with_them_go_and_those_that_may_hold_them_and_are_made_again(folder, capsys, monkeypatch):
    results_of(monkeypatch, folder / "map", ["P01", "P02"], "aggregate", "trials.csv", "--names", "P01,P02")
    results_of(monkeypatch, folder / "others", ["P01", "P03"], "aggregate", "trials.csv")
    results_of(monkeypatch, folder / "compared", [], "validate", "validation.csv", "--study", "study.toml")
    err = delete(capsys, monkeypatch, folder, "P02")
    assert not (folder / "map").exists() and (folder / "others" / "map.png").exists()
    assert "make again: " in err and "hilbo aggregate trials.csv --names P01\n" in err
    assert not (folder / "compared").exists() and "hilbo validate validation.csv --study study.toml\n" in err


def test_tables_among_results_stay_and_are_reported_again(folder, capsys, monkeypatch):
    monkeypatch.setattr("sys.argv", ["hilbo", "demo"])
    with results(folder / "demo", force=False) as made:
        for name, person in (("videos", "V01"), ("foam", "P02")):
            (made / name).mkdir()
            (made / name / "result.json").write_text(json.dumps({"participants": [{"participant": person}]}))
            (made / name / "trials.csv").write_text(f"participant,trial\n{person},1\nX1,1\n")
            (made / name / "study.toml").write_text("")
    err = delete(capsys, monkeypatch, folder, "P02")
    for name in ("videos", "foam"):
        assert sorted(path.name for path in (folder / "demo" / name).iterdir()) == ["study.toml", "trials.csv"]
        assert f"make again: hilbo report {folder / 'demo' / name} --out " in err
    assert (folder / "demo" / "videos" / "trials.csv").read_text().count("V01") == 1


def test_an_exported_folder_can_be_replaced_afterwards(folder, capsys, monkeypatch):
    monkeypatch.setattr("sys.argv", ["hilbo", "export"])
    with results(folder / "tables", force=False) as made:
        (made / "dataset_description.json").write_text("{}")
        (made / "t_data.csv").write_text("participant,trial\nP01,1\nP02,1\n")
        (made / "trials.nc").write_bytes(b"\x89HDF\r\n\x1a\nP02")
    err = delete(capsys, monkeypatch, folder, "P02")
    assert "trials.nc: 1 removed" in err and "trials.nc: LEFT" not in err and "hilbo export --force\n" in err
    assert (folder / "tables" / "t_data.csv").read_text() == "participant,trial\nP01,1\n"
    with results(folder / "tables", force=True) as made:
        (made / "new.csv").write_text("")


def test_keys_of_their_sessions_go_and_those_of_longer_ids_stay(folder):
    """P02_3 is somebody else, and so is P02-4, whose logs are here."""
    for person in ("P02", "P02_3", "P02-4"):
        older_log(folder, person)
    gone = [".P02_3.keys", ".P02_1.keys", ".P02_1.keys.part", ".P02-1.keys"]
    stay = [".P02_3_3.keys", ".P02-4_3.keys", ".P02-4-3.keys", ".P020_3.keys", ".P01_3.keys"]
    for name in (*gone, *stay):
        (folder / name).write_text("{}")
    delete_participant(folder, "P02")
    assert sorted(path.name for path in folder.glob(".*.keys*")) == sorted(stay)


def test_logs_of_others_are_listed_and_stay_as_they_are(folder, capsys, monkeypatch):
    theirs, others = older_log(folder, "P02"), older_log(folder, "P03")
    (folder / "P02_3.0000.rescued.jsonl").write_bytes(theirs.read_bytes())
    (folder / "copy of a log").write_bytes(theirs.read_bytes())
    content = others.read_bytes()
    (folder / "P09_1.session.jsonl").write_bytes(b"damaged\n")
    (folder / "map.nc").write_bytes(b"damaged")
    (folder / "trials-2.parquet").write_bytes(b"damaged")
    (folder / "letter.txt").write_text("P02 would like to know.")
    (folder / "other.txt").write_text("P020 and xP02 and P02-b are other people.")
    err = delete(capsys, monkeypatch, folder, "P02")
    assert not list(folder.glob("*P02_3*")) and not (folder / "copy of a log").exists()
    assert not theirs.exists() and others.read_bytes() == content
    listed = {line.split(": ")[0] for line in err.splitlines() if ": LEFT; " in line}
    damaged = {"P09_1.session.jsonl", "map.nc", "trials-2.parquet"}
    assert listed == {str(folder / name) for name in damaged | {"P03_3.session.jsonl", "letter.txt"}}


def test_a_plan_of_today_leaves_no_id_with_others():
    own = {f"individual:P0{i}": {"u": 0.1 * i, "v": 0.5} for i in (1, 2, 3)}
    plan = make_plan(STUDY.file, ["J01"], 0, "aggregate-best", sets={"": {"aggregate": SETS["best"]} | own})
    header = planned_header(plan, STUDY.file, "J01")
    assert "P02" not in json.dumps([header.sets, [[t.a, t.b] for b in header.blocks for t in b.trials]])
    own_u = sorted(values["u"] for name, values in header.sets.items() if name.startswith("individual:"))
    np.testing.assert_allclose(own_u, [0.1, 0.2, 0.3])


def test_an_id_that_is_a_number_changes_names_alone(tmp_path):
    plan = make_plan(STUDY.file, ["1", "2", "3"], 0)
    (tmp_path / "plan.json").write_text(plan_text(plan))
    done = delete_participant(tmp_path, "1")
    after = read_plan(tmp_path / "plan.json")
    assert after.participants[1:] == plan.participants[1:]
    first, was = after.participants[0].header, plan.participants[0].header
    assert first == msgspec.structs.replace(was, participant=done.label)
    assert planned_header(after, STUDY.file, "2").session == "1"


def test_names_of_sets_in_a_plan_change_with_the_trials_that_show_them(tmp_path):
    block = Block("aggregate-best", 1, (Planned("aggregate", "individual:P02"),))
    sets = {"aggregate": SETS["best"], "individual:P02": SETS["own-P02"], "individual:P020": SETS["own-P01"]}
    rows = []
    for order, person in enumerate(["P01", "P02"]):
        header = Header(study=STUDY.file.hash, participant=person, session="3", seed=order, blocks=(block,), sets=sets)
        rows.append(PlanRow(person, order, planned_part(header)))
    plan = msgspec.structs.replace(make_plan(STUDY.file, ["P01"]), phase="aggregate-best", participants=tuple(rows))
    (tmp_path / "plan.json").write_text(plan_text(hashed(plan)))
    done = delete_participant(tmp_path, "P02")
    header = planned_header(read_plan(tmp_path / "plan.json"), STUDY.file, "P01")
    assert list(header.sets) == ["aggregate", f"individual:{done.label}", "individual:P020"]


@pytest.mark.parametrize("person", ["a", "1"])
def test_sides_and_parts_of_cells_stay(tmp_path, person):
    head = "participant,trial,set_a,set_b,first,preferred\n"
    kept = "b,1,best,set 1,a,b\nc,1,best,set 1,b,a\n"
    sets = "set_id,source,u,v\nbest,aggregate,.5,.5\nset 1,aggregate,.1,.1\na,aggregate,.1,.1\n"
    (tmp_path / "validation.csv").write_text(f"{head}{person},1,best,set 1,a,b\n{kept}")
    (tmp_path / "sets.csv").write_text(sets)
    done = delete_participant(tmp_path, person)
    assert (tmp_path / "validation.csv").read_text() == head + kept and not done.renamed
    assert (tmp_path / "sets.csv").read_text() == sets


def test_coded_sets_that_their_rows_alone_name_go(tmp_path):
    rows = ["P01,1,s00000001 best,s00000001 mid,,,s00000001 mid", "P02,1,s00000002 best,s00000002 mid,,,s00000002 best"]
    (tmp_path / "validation.csv").write_text(
        "\n".join(["participant,trial,set_a,set_b,class_a,class_b,preferred", *rows]) + "\n"
    )
    names = [f"s0000000{i} {role}" for i in (1, 2) for role in ("best", "mid", "worst")] + ["individual:s0000000a"]
    lines = [f"{name},individual:{name.split()[0].removeprefix('individual:')},.1,.2" for name in names]
    (tmp_path / "sets.csv").write_text("\n".join(["set_id,source,u,v", *lines]) + "\n")
    done = delete_participant(tmp_path, "P02")
    assert list(sets_frame(tmp_path / "sets.csv", ("u", "v")).index) == [*names[:3], names[-1]]
    assert "under codes" in done.left[str(tmp_path)] and str(tmp_path / "sets.csv") in done.left[str(tmp_path)]


def test_what_somebody_put_among_results_stays_and_they_are_made_again_over_it(folder, monkeypatch):
    results_of(monkeypatch, folder / "compared", [], "validate", "validation.csv")
    (folder / "compared" / "notes.txt").write_text("mine")
    (command,) = delete_participant(folder, "P02").commands
    assert command.endswith("hilbo validate validation.csv --force")
    assert [path.name for path in (folder / "compared").iterdir()] == ["notes.txt"]


def test_results_without_a_command_go(folder, capsys, monkeypatch):
    (folder / "older").mkdir()
    (folder / "older" / "result.json").write_text("{}")
    list_files(folder / "older")
    assert delete_participant(folder, "P02").commands == [f"{folder / 'older'}: by the hilbo command that made it"]
    assert not (folder / "older").exists()


COMMANDS = {
    "hilbo aggregate t.csv --participants=P02,P01": "hilbo aggregate t.csv --participants=P01",
    "hilbo aggregate t.csv --participants P01,P02": "hilbo aggregate t.csv --participants P01",
    "hilbo aggregate t.csv --participants P02": "",
    "hilbo aggregate t.csv --participants=P02": "",
    "hilbo aggregate t.csv --seed 1": "hilbo aggregate t.csv --seed 1",
}


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_is_written_back_without_them(folder, monkeypatch, command):
    assert command_without(command, "P02") == COMMANDS[command]
    assert command_without("hilbo power --participants 6,12 --trials 12", "12").count("12") == 2
    monkeypatch.setattr("sys.argv", command.split())
    with results(folder / "tables", force=False) as made:
        (made / "trials.csv").write_text("participant,trial\nP01,1\nP02,1\n")
    delete_participant(folder, "P02")
    assert listed(folder / "tables").command == COMMANDS[command]


def test_figures_in_folders_below_a_result_go_with_it(folder, monkeypatch):
    monkeypatch.setattr("sys.argv", ["hilbo", "demo"])
    with results(folder / "demo", force=False) as made:
        for name, person in (("videos", "V01"), ("foam", "P02")):
            (made / name / "figures").mkdir(parents=True)
            (made / name / "result.json").write_text(json.dumps({"participants": [{"participant": person}]}))
            (made / name / "figures" / "map.png").write_bytes(b"\x89PNG")
        (made / "comparison.json").write_text("{}")
    delete_participant(folder, "P02")
    assert not (folder / "demo").exists()


def test_results_that_hold_a_number_do_not_name_somebody(folder, monkeypatch):
    results_of(monkeypatch, folder / "map", ["2"], "aggregate", "t.csv")
    (folder / "map" / "result.json").write_text('{"participants": [{"participant": "2", "trials": 1}], "seed": 1}')
    (folder / "t.csv").write_text("participant,trial\n1,1\n2,1\n")
    delete_participant(folder, "1")
    assert (folder / "map" / "map.png").exists()


def test_files_called_after_them_and_files_that_cannot_be_searched_are_listed(tmp_path):
    wanted = ["P02.txt", "P02.png", "notes-P02.md", "interview_P02.docx", "backup.zip", "list.xlsx", "letter.pdf"]
    for name in [*wanted, "P020.txt", "xP02.png", "picture.png", "notes.md"]:
        (tmp_path / name).write_bytes(b"x")
    (tmp_path / "utf16.csv").write_bytes("participant,trial\nP02,1\n".encode("utf-16"))
    (tmp_path / "latin.csv").write_bytes("participant;é\nP02;é\n".encode("latin1"))
    (tmp_path / "t.csv").write_text("participant\nP02\nP01\n")
    left = delete_participant(tmp_path, "P02").left
    assert {Path(name).name for name in left} == {*wanted, "utf16.csv", "latin.csv"}
    assert "cannot be searched" in left[str(tmp_path / "backup.zip")]


def test_a_number_is_an_id_where_ids_stand_alone(tmp_path):
    (tmp_path / "t.csv").write_text("participant,trial,u\n1,1,1\n2,1,1\n")
    (tmp_path / "device.csv").write_text("time,force\n1,1\n")
    (tmp_path / "subjects.csv").write_text("subject;age\n1;30\n")
    (tmp_path / "plan.json").write_text(plan_text(make_plan(STUDY.file, ["2", "3"], 0)))
    (tmp_path / "notes.md").write_text("1 of 2 motors was warm.")
    (tmp_path / "diary.md").write_text("Participant 1 came late.")
    driver = Driver()
    driver.step()
    with EventLog.create(tmp_path / "P01_1.session.jsonl", STUDY.file, driver.header) as log:
        log.append(driver.events[0])
    left = delete_participant(tmp_path, "1").left
    assert {Path(name).name for name in left} == {"subjects.csv", "diary.md"}


def test_a_list_that_somebody_is_added_to_is_waited_for(tmp_path, monkeypatch):
    path = tmp_path / "participants.csv"  # made by hand: nobody was added to it by hilbo
    path.write_text("participant,consent_time,protocol_number\nP01,2026-01-05,1\nP02,2026-01-05,1\n")
    monkeypatch.setattr(withdrawal, "_PATIENCE", 0.05)
    with locked_folder(tmp_path), pytest.raises(InputError, match="is being changed by another hilbo"):
        delete_participant(tmp_path, "P01")
    assert set(read_people(path)) == {"P01", "P02"}
    delete_participant(tmp_path, "P01")
    assert set(read_people(path)) == {"P02"}
