"""A short version of the attack in attacks/schedules.py; tests/session/test_withdrawal_kills.py has many schedules, in
one process."""

import random
import shutil
import subprocess
import sys

import pytest
from simulated import ROOT

from attacks.schedule_ground import PEOPLE
from attacks.schedules import Schedule


@pytest.fixture
def schedule(tmp_path):
    """A schedule before it is run, in which one person has withdrawn from lists and tables."""
    for folder in ("whole", "study", "cache", "tmp"):
        (tmp_path / folder).mkdir()
    made = Schedule(tmp_path, random.Random(0))
    made.commands, made.gone = [], {PEOPLE[0]}
    rows = [f"{name},1" for name in PEOPLE]
    for name in ("participants.csv", "trials.csv"):
        (tmp_path / "whole" / name).write_text("\n".join(["participant,trial", *rows]))
        (tmp_path / "study" / name).write_text("\n".join(["participant,trial", *rows[1:]]))
    return made


@pytest.mark.parametrize(
    ("file", "content", "fault"),
    [
        ("study/notes.txt", f"{PEOPLE[0]} was late", "notes.txt names one"),
        (f"cache/{PEOPLE[0]}.program", "", "program names one"),
        ("tmp/x", PEOPLE[0], "x names one"),
        ("tmp/y", "", "stays in the temporary folder"),
        ("study/trials.csv", "participant,trial\n", f"trials.csv has lost rows of {PEOPLE[1]}"),
        ("study/other.csv", "a,b\n1,2\n1\n", "other.csv has a row that is not whole"),
        ("study/result.json", '{"half": ', "result.json: "),
        ("study/.map-01234567.part/map.nc.txt", "", ".map-01234567.part stays"),
        ("study/.hilbo.lock", "", ".hilbo.lock stays"),
        ("study/.hilbo-withdrawal.json", "{}", ".hilbo-withdrawal.json stays"),
    ],
)
def test_what_must_not_be_left_is_found(schedule, file, content, fault):
    def found():
        return [*schedule._traces(), *schedule._lost_rows(), *schedule._damages()]

    assert found() == []
    path = schedule.root / file
    path.parent.mkdir(exist_ok=True)
    path.write_text(content)
    assert any(fault in said for said in found()), found()


@pytest.mark.deep
@pytest.mark.release  # the study that it needs is compiled in a cache of its own: a minute
@pytest.mark.skipif(shutil.which("gcc") is None or sys.platform != "linux", reason="needs gcc and preloaded libraries")
def test_commands_that_are_killed_leave_a_whole_study():
    command = [sys.executable, str(ROOT / "attacks" / "schedules.py"), "--count", "6", "--seed", "7"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr + done.stdout
    assert "6  all is done" in done.stdout
