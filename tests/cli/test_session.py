"""hilbo plan, export, participants, and aggregate from logs, as a user types them."""

import json
import sys
from pathlib import Path

import msgspec
import pytest
from live import Driver

import hilbo as hilbo_package
from hilbo import Study
from hilbo.cli import doctor, main
from hilbo.errors import InputError
from hilbo.session.log.event_log import EventLog
from hilbo.session.log.log_files import log_name
from hilbo.session.plan.plan import make_plan, planned_header
from hilbo.study.file.plan_file import Block, plan_text, read_plan
from hilbo.study.folder import read_folder
from hilbo.study.tables.validation import read_validation, sets_frame

TOML = """\
schema = 1
[study]
name = "plain"
responses = ["different", "similar", "close"]
[parameters.u]
low = 0.0
high = 1.0
[parameters.v]
low = 0.0
high = 1.0
[gp]
theta = 10.0
variance = 1.0
thresholds = [-0.5, 0.5]
noise = 0.5
[selection]
space_filling = 2
trials = {trials}
"""


@pytest.fixture
def hilbo(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["hilbo", *map(str, arguments)])
        with pytest.raises(SystemExit) as stopped:
            main.main()
        captured = capsys.readouterr()
        return stopped.value.code or 0, captured.out, captured.err

    return run


def test_a_plan_is_written_once_and_can_be_reissued(hilbo, tmp_path):
    (tmp_path / "study.toml").write_text(TOML.format(trials=6))
    study = Study.load("study.toml")
    code, out, err = hilbo("plan", "study.toml", "--participants", 3, "--seed", 5, "--json")
    plan = json.loads(out)
    assert code == 0 and "complete blocks" in err and plan == json.loads((tmp_path / "plan.json").read_text())
    assert [row["participant"] for row in plan["participants"]] == ["P01", "P02", "P03"]
    before = read_plan("plan.json")
    assert planned_header(before, study.file, "P02").seed == plan["participants"][1]["header"]["seed"]
    code, _, err = hilbo("plan", "study.toml", "--participants", 3)
    assert code == 2 and "plan.json: exists already" in err
    assert hilbo("plan", "study.toml", "--reissue", "P02=P09")[0] == 0
    changed = json.loads((tmp_path / "plan.json").read_text())
    after = read_plan("plan.json")
    assert planned_header(after, study.file, "P09").seed == planned_header(before, study.file, "P02").seed
    for again, sentence in (
        ("P01", "write OLD=NEW"),
        ("P01=", 'participant is ""'),
        ("P01=P 10", 'participant is "P 10"'),
        ("P02=P10", "has been reissued to P09"),
    ):
        code, _, err = hilbo("plan", "study.toml", "--reissue", again)
        assert code == 2 and sentence in err
        assert json.loads((tmp_path / "plan.json").read_text()) == changed
    assert hilbo("plan", "study.toml", "--reissue", "P09=P10")[0] == 0


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ((), "give either --participants (how many) or --names"),
        (("--participants", 2, "--kind", "dance"), '--kind is "dance"'),
        (("--participants", 2, "--kind", "validation"), "give --from result.json"),
        (("--participants", 2, "--kind", "validation", "--from", "none.json"), "none.json: cannot be read"),
        (("--participants", 2, "--kind", "validation", "--from", "a", "--from", "b"), "once for each material (none"),
        (("--names", "P1,P1"), "each once"),
        (("--names", "P1", "--session", "x" * 65), "it must have 1 to 64 characters"),
        (("--names", "P1", "--session", "a\nb"), 'the session\'s label is "a?b"; it must have'),
        (("--names", "P1", "--material", "foam"), "materials.foam is not in the study"),
        (("--reissue", "P1=P2"), "plan.json: is not there; give the plan to change with --out"),
        (("--reissue", "P1"), '--reissue is "P1"; write OLD=NEW'),
        (("--names", "P01,P02,"), 'participant is ""; an id has'),
        (("--names", "P 1"), 'participant is "P 1"; an id has'),
        (("--participants", 2, "--seed", -1), "--seed"),
        (("--participants", 2, "--seed", 2**31), "--seed"),
    ],
)
def test_a_wrong_plan_is_one_sentence(hilbo, tmp_path, arguments, sentence):
    (tmp_path / "study.toml").write_text(TOML.format(trials=6))
    code, _, err = hilbo("plan", "study.toml", *arguments)
    assert code == 2 and sentence in err and not (tmp_path / "plan.json").exists()


def test_participants_are_listed_and_deleted(hilbo, tmp_path):
    consent = ("--consent-time", "2026-05-04T10:00", "--protocol-number", "7")
    code, _, err = hilbo("participants", "add", "participants.csv", "P01", *consent)
    assert code == 0 and err == "participants.csv: participant P01 added, 1 in all\n"
    assert hilbo("participants", "add", "participants.csv", "P01", *consent)[0] == 2
    code, _, err = hilbo("participants", "delete", ".", "P01")
    assert code == 2 and "add --yes" in err and "P01" in (tmp_path / "participants.csv").read_text()
    assert hilbo("participants", "add", "new/logs/participants.csv", "P02", *consent)[0] == 0
    assert "P02" in (tmp_path / "new" / "logs" / "participants.csv").read_text()
    (tmp_path / "file").write_text("")
    code, _, err = hilbo("participants", "add", "file/participants.csv", "P01", *consent)
    assert code == 2 and err.startswith("hilbo: file/participants.csv: cannot be written")
    assert hilbo("participants", "delete", ".", "P01", "--yes")[0] == 0
    assert "P01" not in (tmp_path / "participants.csv").read_text()


def a_result(study, **changes):
    """result.json as `hilbo aggregate` has it, as far as a plan needs it."""
    people = [
        {"participant": f"P0{i}", "trials": 6, "optimum": {"parameters": {"u": 0.2, "v": 0.1 * i}}} for i in (1, 2)
    ]
    optimum = {"parameters": {"u": 0.3, "v": 0.6}, "mean": 1.0}
    hashes = {"study": study.file.hash, "meaning": study.file.meaning, "goal": study.goal_label}
    return {"optimum": optimum, "participants": people, **hashes, "seed": 0} | changes


def test_nobody_is_given_a_row_to_validate_a_map_that_they_are_in(hilbo, tmp_path):
    (tmp_path / "study.toml").write_text(TOML.format(trials=6))
    study = Study.load("study.toml")
    sets = {name: {"u": u, "v": 0.5} for name, u in (("best", 0.1), ("mid", 0.5), ("worst", 0.9))}
    plan = make_plan(study.file, ["V01", "V02"], 0, "validation", sets={"": sets}, source="aggregate")
    (tmp_path / "plan.json").write_text(plan_text(plan))
    (tmp_path / "result.json").write_text(json.dumps(a_result(study)))
    before = (tmp_path / "plan.json").read_bytes()
    for arguments, sentence in (
        (("V02=P01", "--from", "result.json"), '"P01" is in the map that is to be validated'),
        (("V02=P1", "--from", "result.json"), '"P1" is in the map that is to be validated, as "P01"'),
        (("V02=V03",), "add --from result.json, of which its sets are made, so that V03 can be looked for there"),
        (("V02=V03", "--from", "none.json"), "none.json: cannot be read"),
    ):
        code, _, err = hilbo("plan", "study.toml", "--reissue", *arguments)
        assert code == 2 and sentence in err and (tmp_path / "plan.json").read_bytes() == before
    assert hilbo("plan", "study.toml", "--reissue", "V02=V03", "--from", "result.json")[0] == 0
    assert planned_header(read_plan("plan.json"), study.file, "V03").participant == "V03"


def test_a_validation_of_two_materials_looks_for_somebody_new_in_both_maps(hilbo, tmp_path):
    text = TOML.format(trials=6) + "[materials.foam]\n[materials.gel]\n"
    (tmp_path / "study.toml").write_text(text)
    study = Study.load("study.toml")
    sets = {name: {"u": u, "v": 0.5} for name, u in (("best", 0.1), ("mid", 0.5), ("worst", 0.9))}
    both = dict.fromkeys(("foam", "gel"), sets)
    plan = make_plan(study.file, ["V01", "V02"], 0, "validation", sets=both, source="aggregate")
    (tmp_path / "plan.json").write_text(plan_text(plan))
    people = {"foam": ["P01"], "gel": ["P02"]}
    for name, ids in people.items():
        result = a_result(study.material(name), participants=[{"participant": one} for one in ids])
        (tmp_path / f"{name}.json").write_text(json.dumps(result))
    given = ("--from", "foam=foam.json", "--from", "gel=gel.json")
    for person in ("P01", "P02"):
        code, _, err = hilbo("plan", "study.toml", "--reissue", f"V02={person}", *given)
        assert code == 2 and f'"{person}" is in the map' in err
    assert hilbo("plan", "study.toml", "--reissue", "V02=V03", *given)[0] == 0


def no_number(value):
    return {"optimum": {"parameters": {"u": value, "v": 0.6}}}


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        (no_number(float("nan")), "is no result.json"),
        (no_number(None), "has no number for u"),
        (no_number(1e308), "u of the optimum is 1e+308; it must be from 0 to 1"),
        (no_number(-3), "u of the optimum is -3; it must be from 0 to 1"),
        (no_number("x"), "u of the optimum is x; it must be a number from 0 to 1"),
        ({"participants": [{"participant": "P01", "optimum": None}]}, "have no individual optima"),
        ({"participants": [{"participant": "P01", "optimum": {"parameters": {"u": 9, "v": 0}}}]}, "optimum of P01"),
        ({"participants": [{"participant": "P01", "optimum": 7}]}, "is no result.json"),
        ({"participants": []}, "contains no participants"),
        ({"participants": [{"participant": "../P01"}]}, 'participant is "../P01"'),
        ({"seed": "x"}, "is no result.json"),
    ],
)
def test_a_plan_takes_no_result_that_is_none(hilbo, tmp_path, changes, sentence):
    (tmp_path / "study.toml").write_text(TOML.format(trials=6))
    study = Study.load("study.toml")
    given = ("--participants", 2, "--kind", "aggregate-best", "--from", "result.json")
    (tmp_path / "result.json").write_text(json.dumps(a_result(study)))
    assert hilbo("plan", "study.toml", *given, "--out", "good.json")[0] == 0
    (tmp_path / "result.json").write_text(json.dumps(a_result(study, **changes)))
    code, _, err = hilbo("plan", "study.toml", *given)
    assert code == 2 and err.startswith("hilbo: ") and err.count("\n") <= 2
    assert sentence in err and "Traceback" not in err and not (tmp_path / "plan.json").exists()


def test_a_result_that_was_changed_is_refused(hilbo, tmp_path):
    from hilbo.report.result_file import json_lines
    from hilbo.study.formats.json_file import sealed

    (tmp_path / "study.toml").write_text(TOML.format(trials=6))
    text = "".join(sealed(json_lines(a_result(Study.load("study.toml")))))
    given = ("--participants", 2, "--kind", "aggregate-best", "--from", "result.json")
    (tmp_path / "result.json").write_text(text)
    assert hilbo("plan", "study.toml", *given, "--out", "good.json")[0] == 0
    for changed in (text.replace("0.3", "0.4"), text.replace("P01", "P09"), text.replace("\n", "\r\n")):
        (tmp_path / "result.json").write_bytes(changed.encode())
        code, _, err = hilbo("plan", "study.toml", *given)
        assert code == 2 and "has been changed since hilbo wrote it" in err


def felt(point):
    apart = ((point["u"] - 0.3) ** 2 + (point["v"] - 0.6) ** 2) ** 0.5
    return "close" if apart < 0.2 else "similar" if apart < 0.4 else "different"


def validation_log(folder, study, answered=True):
    """A session of comparisons and nothing else."""
    folder.mkdir()
    driver = Driver("validation")
    blocks = driver.header.blocks[1:]
    driver.header = msgspec.structs.replace(driver.header, study=study.file.hash, blocks=blocks)
    driver.state = type(driver.state).start(study.file, driver.header)
    driver.step()
    if answered:
        driver.finish()
    with EventLog.create(folder / log_name(driver.header), study.file, driver.header) as log:
        for event in driver.events:
            log.append(event)


def logs_of(folder, study, people, trials, **facts):
    """Sessions whose renderings a fake chooser found, and whose answers follow one rule."""
    folder.mkdir()
    for person in people:
        driver = Driver()
        blocks = (Block("optimisation", trials),)
        seed = int(person[1:])
        driver.header = msgspec.structs.replace(
            driver.header, study=study.file.hash, participant=person, blocks=blocks, sets={}, seed=seed, **facts
        )
        driver.state = type(driver.state).start(study.file, driver.header)
        driver.values = lambda trial, number: {"class_a": felt(trial.renderings["a"])}
        driver.step()
        driver.finish()
        with EventLog.create(folder / log_name(driver.header), study.file, driver.header) as log:
            for event in driver.events:
                log.append(event)


def test_an_export_says_how_many_dry_runs_it_leaves_out(hilbo, tmp_path):
    (tmp_path / "study.toml").write_text(TOML.format(trials=3))
    study = Study.load("study.toml")
    logs_of(tmp_path / "logs", study, ["P01"], 3)
    logs_of(tmp_path / "dry", study, ["P09"], 3, dry_run=True)
    for path in (tmp_path / "dry").iterdir():
        path.rename(tmp_path / "logs" / path.name)
    code, _, err = hilbo("export", "logs", "--study", "study.toml", "--out", "tables")
    assert code == 0 and "hilbo: logs: 1 dry run is left out." in err
    assert not any("P09" in path.read_text() for path in (tmp_path / "tables").rglob("*.csv"))


def test_a_folder_of_comparisons_alone_is_exported(hilbo, tmp_path):
    (tmp_path / "study.toml").write_text(TOML.format(trials=3))
    study = Study.load("study.toml")
    validation_log(tmp_path / "logs", study)
    code, _, err = hilbo("export", "logs", "--study", "study.toml", "--out", "tables")
    assert code == 0, err
    data = tmp_path / "tables" / "data"
    assert len(read_validation(data / "study-plain_table-validation_data.csv", study.responses)) == 6
    assert set(sets_frame(data / "study-plain_table-sets_data.csv", ("u", "v")).index) == set("DEF")
    assert not (tmp_path / "tables" / "trials.nc").exists()
    validation_log(tmp_path / "begun", study, answered=False)
    code, _, err = hilbo("export", "begun", "--study", "study.toml", "--out", "none")
    assert code == 2 and "no responses that count" in err and not (tmp_path / "none").exists()


def test_a_report_reads_the_folder_of_an_export(hilbo, tmp_path):
    (tmp_path / "study.toml").write_text(TOML.format(trials=3))
    study = Study.load("study.toml")
    validation_log(tmp_path / "logs", study)
    logs_of(tmp_path / "more", study, ["P02"], 3)
    for path in (tmp_path / "more").iterdir():
        path.rename(tmp_path / "logs" / path.name)
    assert hilbo("plan", "study.toml", "--names", "P01,P02", "--out", "fixed.json")[0] == 0
    code, _, err = hilbo("export", "logs", "--study", "study.toml", "--plan", "fixed.json", "--out", "tables")
    assert code == 0, err
    (tmp_path / "tables" / "sets.csv").write_text("set_id,source,u,v\nmeasured,sysid,0.3,0.6\n")
    folder = read_folder(tmp_path / "tables")
    (material,) = folder.materials
    assert material.cohort.names == ("P02",) and len(material.validation) == 6
    assert set(folder.sets.index) == {*"DEF", "measured"} and material.reference.name == "system identification"
    assert any("P01" in sentence for sentence in folder.limits)  # the plan is looked at
    assert any(
        sentence.endswith("Sessions without a plan: P02 (session 1).") for sentence in folder.limits
    )  # not its comparisons
    (tmp_path / "tables" / "sets.csv").write_text("set_id,source,u,v\nD,sysid,0.3,0.6\n")
    with pytest.raises(InputError, match='the set "D" is in two sets tables; keep one'):
        read_folder(tmp_path / "tables")
    (tmp_path / "fixed.json").write_text("{}")
    code, _, err = hilbo("export", "logs", "--study", "study.toml", "--plan", "fixed.json", "--out", "again")
    assert code == 2 and "plan" in err and not (tmp_path / "again").exists()


def test_sessions_of_the_plan_that_is_exported_with_them_depart_from_nothing(hilbo, tmp_path):
    (tmp_path / "study.toml").write_text(TOML.format(trials=3))
    study = Study.load("study.toml")
    assert hilbo("plan", "study.toml", "--names", "P01", "--out", "fixed.json")[0] == 0
    plan = json.loads((tmp_path / "fixed.json").read_text())
    logs_of(tmp_path / "logs", study, ["P01"], 3, plan=plan["hash"])
    code, _, err = hilbo("export", "logs", "--study", "study.toml", "--plan", "fixed.json", "--out", "tables")
    assert code == 0, err
    (note,) = read_folder(tmp_path / "tables").notes
    assert note.endswith("all sessions followed it.")
    table = tmp_path / "tables" / "data" / "study-plain_table-sessions_data.csv"
    table.write_text(table.read_text().replace(plan["hash"], "0" * 16, 1))
    folder = read_folder(tmp_path / "tables")
    assert not folder.notes and any(f"P01 (session 1, plan {'0' * 16})" in sentence for sentence in folder.limits)
    table.write_text("participant,session\nP01,1\n")
    with pytest.raises(InputError, match=r'sessions_data\.csv:1: column "phases" is missing'):
        read_folder(tmp_path / "tables")


@pytest.mark.deep
def test_from_logs_to_a_validation_plan(hilbo, tmp_path):
    (tmp_path / "study.toml").write_text(TOML.format(trials=20))
    study = Study.load("study.toml")
    people = ["P01", "P02", "P03"]
    logs_of(tmp_path / "logs", study, people, 20)
    assert hilbo("export", "logs", "--study", "study.toml", "--out", "tables")[0] == 0
    table = "tables/data/study-plain_table-trials_data.csv"
    for source, out in (("logs", "a"), (table, "b")):
        code, _, err = hilbo("aggregate", source, "--study", "study.toml", "--out", out)
        assert code == 0, err
    assert (tmp_path / "a" / "result.json").read_bytes() == (tmp_path / "b" / "result.json").read_bytes()
    assert (tmp_path / "a" / "optima.csv").read_bytes() == (tmp_path / "b" / "optima.csv").read_bytes()
    given = ("--kind", "validation", "--from", "a/result.json", "--table")
    code, _, err = hilbo("plan", "study.toml", "--participants", 4, *given, "logs", "--out", "v.json")
    assert code == 0, err
    plan = json.loads((tmp_path / "v.json").read_text())
    sets = plan["participants"][0]["header"]["sets"]
    best = json.loads((tmp_path / "a" / "result.json").read_text())["optimum"]["parameters"]
    assert sets["best"] == pytest.approx(best, abs=1e-6)
    own = ("--names", "P01,P03", "--source", "individual", *given, table, "--out", "w.json")
    code, _, err = hilbo("plan", "study.toml", *own)
    assert code == 0, err
    sets = json.loads((tmp_path / "w.json").read_text())["participants"][1]["header"]["sets"]
    assert [name.partition(" ")[2] for name in sets if not name.startswith("warm-up")] == ["best", "mid", "worst"]
    assert not any("P0" in name for name in sets)  # a code is nobody's name
    code, _, err = hilbo("plan", "study.toml", "--names", "P01", *given, "logs", "--out", "x.json")
    assert code == 2 and "invite people who are not" in err
    code, _, err = hilbo("export", "logs", "--study", "study.toml", "--out", "tables", "--force")
    assert code == 0, err


def test_a_plan_of_one_material_or_of_all(hilbo, tmp_path):
    materials = "[materials.foam]\n[materials.soft]\n[materials.hard]\n"
    (tmp_path / "study.toml").write_text(TOML.format(trials=6) + materials)
    code, _, err = hilbo("plan", "study.toml", "--participants", 4, "--out", "all.json")
    assert code == 0 and "balance is exact at multiples of 6 participants" in err
    assert hilbo("plan", "study.toml", "--participants", 4, "--material", "soft", "--out", "one.json")[0] == 0
    for name, count in (("all", 3), ("one", 1)):
        plan = json.loads((tmp_path / f"{name}.json").read_text())
        assert [len(row["header"]["blocks"]) for row in plan["participants"]] == [1 + count] * 4
    given = ("--kind", "aggregate-best", "--from", "foam=a.json", "--from", "soft=b.json")
    code, _, err = hilbo("plan", "study.toml", "--participants", 4, *given)
    assert code == 2 and "once for each material (foam, soft, hard)" in err


@pytest.mark.deep
def test_a_plan_says_what_the_delay_of_the_device_leaves(hilbo, tmp_path):
    paper = (Path(hilbo_package.__file__).parent / "data" / "paper.toml").read_text()
    (tmp_path / "study.toml").write_text(paper.replace("T = 0.001", "delay = 0.000271\nT = 0.001"))
    code, _, err = hilbo("plan", "study.toml", "--participants", 2)
    assert code == 0 and "18.4 % of the box is passive at a delay of 271 µs, 24.0 % without" in err
    assert "at a delay of 271 µs" in doctor._feasible(Study.load("study.toml")).words
