"""A log whose file is deleted, moved, replaced or edited while its session runs: nothing acknowledged is lost."""

import os
import random
import shutil

import pytest
from live import STUDY, Driver

from hilbo.errors import InputError
from hilbo.session.export.tables import read_sessions
from hilbo.session.log import actions as live
from hilbo.session.log.event_log import EventLog, LogError, LogLostError, read_log
from hilbo.session.log.log_files import log_name, log_paths


@pytest.fixture(scope="module")
def driven():
    driver = Driver()
    driver.step()
    for number in range(9):
        driver.do("go" if driver.state.screen == "ready" else "answer", number)
    return driver


def deleted(path):
    path.unlink()


def moved(path):
    path.rename(path.with_name("elsewhere.txt"))


def replaced(path):
    """As an editor saves."""
    other = path.with_name("save")
    shutil.copy(path, other)
    os.replace(other, path)


def moved_and_copied_back(path):
    other = path.with_name("moved")
    path.rename(other)
    shutil.copy(other, path)


def truncated(path):
    os.truncate(path, path.stat().st_size // 2)


def lengthened(path):
    with open(path, "ab") as file:
        file.write(b"\n")


def folder_renamed(path):
    path.parent.rename(path.parent.with_name("renamed"))


FAULTS = (deleted, moved, replaced, moved_and_copied_back, truncated, lengthened, folder_renamed)


def acknowledged(log, events):
    """Append events until one is refused; what was acknowledged, and the refusal."""
    done = []
    for event in events:
        try:
            log.append(event)
        except LogLostError as error:
            return done, error
        done.append(event)
    return done, None


def copies(folder):
    return sorted(folder.glob("*.rescued.jsonl"))


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("seed", range(3))
def test_everything_acknowledged_is_in_the_copy_and_nothing_more_is_acknowledged(tmp_path, driven, fault, seed):
    path = tmp_path / "logs" / log_name(driven.header)
    with EventLog.create(path, STUDY.file, driven.header) as log:
        at = random.Random(seed).randrange(1, len(driven.events))
        before, _ = acknowledged(log, driven.events[:at])
        fault(path)
        after, error = acknowledged(log, driven.events[at:])
        assert before == driven.events[:at] and after == [] and log.state.seq == at
        (copy,) = copies(path.parent)
        answers = sum(trial.status == "answered" for trial in log.state.trials)
        assert f"Acknowledged so far: {answers} answer" in str(error) and f"in {copy}; end this server" in str(error)
        assert read_log(copy, STUDY.file)[1] == before and copy.stat().st_mode & 0o777 == 0o600
        with pytest.raises(LogLostError):
            log.check()
    assert copies(path.parent) == [copy]  # written once


def test_a_fault_between_the_write_and_the_acknowledgement_is_seen(tmp_path, driven, monkeypatch):
    path = tmp_path / log_name(driven.header)
    sync = os.fsync

    def fsync(file):
        sync(file)
        if len(log._lines) == 4 and path.exists():
            replaced(path)

    with EventLog.create(path, STUDY.file, driven.header) as log:
        monkeypatch.setattr(os, "fsync", fsync)
        done, error = acknowledged(log, driven.events)
    assert len(done) == 3 and "was replaced by another file" in str(error)
    assert read_log(*copies(tmp_path), STUDY.file)[1] == done


def test_a_copy_that_cannot_be_written_names_what_is_at_stake_and_is_tried_again(tmp_path, driven):
    path = tmp_path / "logs" / log_name(driven.header)
    with EventLog.create(path, STUDY.file, driven.header) as log:
        done, _ = acknowledged(log, driven.events[:-1])
        folder_renamed(path)
        path.parent.write_text("in the way of the folder")
        with pytest.raises(LogLostError, match=r"answers, which could not be copied .* make the folder writable"):
            log.append(driven.events[-1])
        path.parent.unlink()
        with pytest.raises(LogLostError, match=r"Acknowledged so far: .* in .*rescued\.jsonl"):
            log.check()
    assert read_log(*copies(path.parent), STUDY.file)[1] == done


def test_a_log_that_is_cut_while_the_disk_is_full_does_not_grow_again(tmp_path, driven, monkeypatch):
    """Taking a half-written line back must not fill what another program cut off with zeros."""
    path = tmp_path / log_name(driven.header)
    write = os.write

    def full(file, data):
        if file == log._file:
            truncated(path)
            raise OSError(28, "No space left on device")
        return write(file, data)

    with EventLog.create(path, STUDY.file, driven.header) as log:
        done, _ = acknowledged(log, driven.events[:5])
        with monkeypatch.context() as patch:
            patch.setattr(os, "write", full)
            with pytest.raises(LogError):
                log.append(driven.events[5])
        assert acknowledged(log, driven.events[5:])[0] == []
    assert read_log(*copies(tmp_path), STUDY.file)[1] == done


def test_a_second_server_resumes_a_copied_log_and_the_first_stops(tmp_path, driven):
    path = tmp_path / log_name(driven.header)
    with EventLog.create(path, STUDY.file, driven.header) as first:
        acknowledged(first, driven.events[:-1])
        moved_and_copied_back(path)
        with EventLog.resume(path, STUDY.file) as second:
            second.append(driven.events[-1])
            with pytest.raises(LogLostError):
                first.append(driven.events[-1])
    assert read_log(path, STUDY.file)[1] == driven.events


def test_logs_under_other_names_are_named_and_files_of_macos_are_not_read(tmp_path, driven):
    path = tmp_path / log_name(driven.header)
    with EventLog.create(path, STUDY.file, driven.header) as log:
        acknowledged(log, driven.events)
        deleted(path)
        with pytest.raises(LogLostError):
            log.append(live.note(log.state, "lost", 1e9))
    (copy,) = copies(tmp_path)
    for name in (path.name, "P 1 (1).jsonl", "P1.session.jsonl.txt"):
        shutil.copy(copy, tmp_path / name)
    (tmp_path / f"._{path.name}").write_bytes(b"\0\5\x16\7")
    (tmp_path / "notes.txt").write_text("of the day")
    said = []
    assert log_paths(tmp_path, said.append) == [path]
    assert [sentence.split(": ")[0] for sentence in said] == sorted(
        str(tmp_path / name) for name in ("P 1 (1).jsonl", "P1.session.jsonl.txt", copy.name)
    )
    assert sum("under another name" in sentence for sentence in said) == 2
    said.clear()
    assert len(read_sessions(tmp_path, STUDY.file, said.append)) == 1 and len(said) == 3


def test_a_folder_that_is_not_there_holds_no_logs(tmp_path):
    with pytest.raises(InputError, match="contains no session logs"):
        read_sessions(tmp_path / "nowhere", STUDY.file)
