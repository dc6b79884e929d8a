"""What `hilbo doctor` says of a folder for logs, and of a study of one trial."""

import pytest

from hilbo.cli import doctor
from hilbo.cli.live import _verdict
from hilbo.study.config import Study
from hilbo.study.template import NewStudy, parameter_of, study_text


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "afile").write_text("")
    (tmp_path / "gone").symlink_to("drive")
    return tmp_path


@pytest.mark.parametrize("name", [".", "nope", "nope/deeper/logs"])
def test_folders_that_a_session_makes_are_no_fault(folder, name):
    check = doctor._disk(folder / name)
    assert check.level == "good" and check.words.startswith(f"{folder}")
    assert sorted(path.name for path in folder.iterdir()) == ["afile", "gone"]


@pytest.mark.parametrize("name", ["afile", "afile/logs", "gone"])
def test_what_no_session_can_write_to_is_a_fault(folder, name):
    check = doctor._disk(folder / name)
    assert check.level == "bad" and check.words.startswith(f"{folder / name.partition('/')[0]}: ") and check.fix


@pytest.mark.parametrize(
    ("levels", "line"),
    [
        (["good", "note", "good"], "READY: 3 checks, none failed, 1 with a note."),
        (["good", "bad", "bad"], "NOT READY: 2 of 3 checks failed."),
    ],
)
def test_the_last_line_says_whether_a_session_can_begin(levels, line):
    assert _verdict(levels) == line


def test_a_study_of_one_trial_has_no_step_to_measure(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(study_text(NewStudy("x", (parameter_of("a=0:2"),), trials=1)))
    study = Study.load(path)
    assert study.file.selection.trials == 1
    assert "none to measure" in doctor._step(study).words
