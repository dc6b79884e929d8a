"""Files and folders appear whole or not at all, for their owner alone, whoever is killed, and whatever lies there."""

import errno
import os
import threading
from pathlib import Path

import pytest
from broken_disk import Process, changes, patched_disk

from hilbo.cli.terminal.console import results
from hilbo.cli.terminal.new_file import write_new
from hilbo.errors import InputError
from hilbo.study.disk.lock import JOURNAL, LOCK, held, locked_folder
from hilbo.study.disk.new_file import new_file, remove_unfinished, rewrite_file, write_file


@pytest.fixture(autouse=True)
def no_waiting(monkeypatch):
    """What reaches the platter cannot be seen from here."""
    monkeypatch.setattr(os, "fsync", lambda file: None)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def mode(path: Path) -> int:
    return path.stat().st_mode & 0o777


@pytest.mark.parametrize("replace", [False, True])
def test_a_file_is_whole_after_a_kill_at_any_change_of_the_disk(tmp_path, replace):
    def write():
        write_file(tmp_path / "plan.json", "new", replace=replace)

    old = "old" if replace else None
    rewrite = (tmp_path / "plan.json").write_text if replace else lambda _: (tmp_path / "plan.json").unlink(True)
    rewrite("old")
    for last in range(changes(write)):
        rewrite("old")
        with patched_disk():
            assert not Process(write, last).run()
        there = (tmp_path / "plan.json").read_text() if (tmp_path / "plan.json").exists() else None
        assert there in (old, "new")
        if there == old:
            write()
        else:
            write_file(tmp_path / "other", "", replace=True)
        assert not [name for name in names(tmp_path) if name.endswith(".part")]


@pytest.mark.parametrize("links", [True, False])
def test_of_twenty_who_write_a_file_at_once_one_does(tmp_path, monkeypatch, links):
    def no_links(*_):
        raise OSError(errno.EPERM, "Operation not permitted")

    if not links:
        monkeypatch.setattr(os, "link", no_links)
    outcomes, refusals, begin = [], [], threading.Barrier(20)

    def write(number):
        begin.wait()
        try:
            write_new(tmp_path / "study.toml", f"{number}", force=False)
            outcomes.append(number)
        except InputError as error:
            refusals.append(str(error))

    threads = [threading.Thread(target=write, args=(number,)) for number in range(20)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(outcomes) == 1 and all("exists already" in sentence for sentence in refusals)
    assert (tmp_path / "study.toml").read_text() == f"{outcomes[0]}"
    assert names(tmp_path) == ["study.toml"]


@pytest.mark.skipif(os.name == "nt", reason="Windows deletes no open file")
def test_leftovers_are_deleted_under_their_lock(tmp_path, monkeypatch):
    """A writer that has created its file and not yet locked it must not lose it after it has."""
    (tmp_path / ".hilbo-0.part").write_text("")
    unlink, locked = Path.unlink, []

    def watched(path, **options):
        locked.append(held(path, 0) is None)
        unlink(path, **options)

    monkeypatch.setattr(Path, "unlink", watched)
    remove_unfinished(tmp_path)
    assert locked == [True] and not names(tmp_path)


def test_planted_links_are_not_followed(tmp_path):
    (tmp_path / "other").write_text("precious")
    (tmp_path / "study").mkdir()
    for name in ("s.toml", LOCK, ".s.toml.part"):
        (tmp_path / "study" / name).symlink_to("../other")
    write_new(tmp_path / "study" / "s.toml", "new", force=True)
    with pytest.raises(InputError, match="cannot be opened for a lock"), locked_folder(tmp_path / "study"):
        pass
    assert (tmp_path / "other").read_text() == "precious" and mode(tmp_path / "other") == mode_of_new(tmp_path)
    assert not (tmp_path / "study" / "s.toml").is_symlink()


def mode_of_new(folder: Path) -> int:
    (folder / "new").write_text("")
    return mode(folder / "new")


@pytest.mark.parametrize("mask", [0o000, 0o022, 0o077])
def test_what_is_written_is_its_owners_alone(tmp_path, mask):
    before = os.umask(mask)
    try:
        write_file(tmp_path / "plan.json", "", replace=False)
        with results(tmp_path / "deep" / "out", False) as folder:
            (folder / "figures").mkdir()
            (folder / "figures" / "map.csv").write_text("")
        with locked_folder(tmp_path):
            assert mode(tmp_path / LOCK) == 0o600
    finally:
        os.umask(before)
    for path in tmp_path.rglob("*"):
        assert mode(path) == (0o700 if path.is_dir() else 0o600), path


def test_a_file_that_is_rewritten_keeps_its_rights(tmp_path):
    (tmp_path / "list.csv").write_text("")
    os.chmod(tmp_path / "list.csv", 0o664)
    rewrite_file(tmp_path / "list.csv", "new")
    assert mode(tmp_path / "list.csv") == 0o664 and (tmp_path / "list.csv").read_text() == "new"


def test_a_failure_leaves_no_file(tmp_path):
    with pytest.raises(ZeroDivisionError), new_file(tmp_path / "a", replace=True) as path:
        path.write_text(f"{1 / 0}")
    assert names(tmp_path) == []


@pytest.mark.parametrize("force", [False, True])
def test_results_are_whole_after_a_kill_at_any_change_of_the_disk(tmp_path, force):
    def make(text):
        with results(tmp_path / "out", force) as folder:
            (folder / "tables").mkdir()
            (folder / "result.json").write_text(text)

    if force:
        make("0")
    count = changes(lambda: make("0"))
    assert count > 10
    for last in range(count):
        if not force and (tmp_path / "out").exists():
            (tmp_path / "out").rename(tmp_path / f"out-{last}")
        with patched_disk():
            assert not Process(lambda text=f"{last}": make(text), last).run()
        if force or not (tmp_path / "out").exists():
            make("again")
            assert (tmp_path / "out" / "result.json").read_text() == "again"
        else:
            with results(tmp_path / "other", True):
                pass
        assert not [name for name in names(tmp_path) if name.startswith(".")]


def test_a_folder_is_locked_by_one_and_the_lock_goes(tmp_path):
    with locked_folder(tmp_path):
        with pytest.raises(InputError, match="is being changed by another hilbo"), locked_folder(tmp_path, 0.02):
            pass
        with locked_folder(tmp_path.parent, 0.02):
            pass
    assert names(tmp_path) == []


def test_no_folder_below_an_interrupted_withdrawal_is_locked(tmp_path):
    (tmp_path / JOURNAL).write_text("{}")
    (tmp_path / "below").mkdir()
    for folder in (tmp_path, tmp_path / "below"):  # at once, although there is patience
        with pytest.raises(InputError, match="was interrupted there; give its command"), locked_folder(folder, 1e6):
            pass
    with locked_folder(tmp_path, 0.02, in_withdrawal=True):
        with pytest.raises(InputError, match="a withdrawal is going on there; wait"), locked_folder(folder, 0.02):
            pass
        assert names(tmp_path) == [JOURNAL, LOCK, "below"]
    assert names(tmp_path) == [JOURNAL, "below"]
