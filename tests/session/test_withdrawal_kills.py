"""Withdrawals that are killed and given again, that come at once, and that meet other commands."""

import functools
import random
import shutil
import threading

import pytest
from broken_disk import Process, changes, patched_disk
from withdrawn_study import PEOPLE, Schedule, contents, faults, make_study, naming, older_log

from hilbo.errors import InputError
from hilbo.session.withdrawal.withdrawal import delete_participant
from hilbo.study.disk.lock import LOCK, locked_folder
from hilbo.study.disk.new_folder import new_folder


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder, logs = tmp_path_factory.mktemp("whole"), tmp_path_factory.mktemp("logs")
    make_study(folder, [older_log(logs, name, "sysid") for name in ("P01", "P02", "P04")])
    return folder


@pytest.fixture(autouse=True)
def no_waiting(monkeypatch):
    monkeypatch.setattr("os.fsync", lambda file: None)


def killed_and_given_again(whole, folder, last):
    """What a withdrawal that was killed says when it is given again, and its files."""
    shutil.copytree(whole, folder)
    with patched_disk():
        assert not Process(lambda: delete_participant(folder, "P02"), last).run()
    killed = naming(folder, "P02")
    if not killed:
        return None, contents(folder)
    done = delete_participant(folder, "P02")
    assert faults(folder, {"P02"}, {*PEOPLE} - {"P02"}) == []
    return done, contents(folder, done.label)


def compare_with_unbroken(whole, tmp_path, choose):
    shutil.copytree(whole, tmp_path / "copy")
    unbroken = delete_participant(tmp_path / "copy", "P02")
    assert faults(tmp_path / "copy", {"P02"}, {*PEOPLE} - {"P02"}) == []
    wanted = contents(tmp_path / "copy", unbroken.label)
    shutil.rmtree(tmp_path / "copy")
    shutil.copytree(whole, tmp_path / "copy")
    count = changes(lambda: delete_participant(tmp_path / "copy", "P02"))
    assert count > 40
    for last in choose(range(count - 1)):  # the last one removes the lock
        shutil.rmtree(tmp_path / "copy")
        done, files = killed_and_given_again(whole, tmp_path / "copy", last)
        if done is not None:
            assert files == wanted
            for field in ("removed", "renamed", "left", "commands"):
                assert getattr(done, field) == getattr(unbroken, field), (last, field)


def test_a_withdrawal_that_is_killed_and_given_again_ends_as_an_unbroken_one(whole, tmp_path):
    compare_with_unbroken(whole, tmp_path, lambda every: random.Random(0).sample(every, 8))


@pytest.mark.deep
def test_a_withdrawal_may_be_killed_at_every_change_of_the_disk(whole, tmp_path):
    compare_with_unbroken(whole, tmp_path, lambda every: every)


def test_another_withdrawal_waits_until_an_interrupted_one_is_done(whole, tmp_path):
    shutil.copytree(whole, tmp_path / "copy")
    with patched_disk():
        Process(lambda: delete_participant(tmp_path / "copy", "P02"), 25).run()
    with pytest.raises(InputError, match=r"of another participant was interrupted here; .* P02 --yes"):
        delete_participant(tmp_path / "copy", "P01")
    with pytest.raises(InputError, match="a withdrawal was interrupted there"):
        delete_participant(tmp_path / "copy" / "logs", "P02")
    delete_participant(tmp_path / "copy", "P02")
    delete_participant(tmp_path / "copy", "P01")
    assert faults(tmp_path / "copy", {"P01", "P02"}, {"P03", "P04"}) == []


def test_of_several_who_withdraw_at_once_nobody_is_back(tmp_path):
    names = [f"P{i}" for i in range(1, 9)]
    (tmp_path / "trials.csv").write_text("participant,trial\n" + "".join(f"{name},1\n" for name in names))
    threads = [threading.Thread(target=delete_participant, args=(tmp_path, name)) for name in names[:7]]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (tmp_path / "trials.csv").read_text() == "participant,trial\nP8,1\n"
    assert [path.name for path in tmp_path.iterdir()] == ["trials.csv"]


@pytest.mark.parametrize(
    ("listed", "written"), [("007", "7"), ("01", "1.0"), ("P07", "p7"), ("7", "\uff17"), ("P1", "P 1")]
)
def test_an_id_that_was_spelled_otherwise_is_listed(tmp_path, listed, written):
    (tmp_path / "participants.csv").write_text(f"participant,consent_time,protocol_number\n{listed},2026-01-05,1\n")
    (tmp_path / "trials.csv").write_text(f"participant,trial\n{written},12\nQ9,7\n")
    (tmp_path / "result.txt").write_text("107, 7.05 and xp7 are nobody; 1.05 too.")
    done = delete_participant(tmp_path, listed)
    assert set(done.removed) == {str(tmp_path / "participants.csv")} and set(done.left) == {
        str(tmp_path / "trials.csv")
    }
    assert (
        written in (tmp_path / "trials.csv").read_text()
        and "which may be them" in done.left[str(tmp_path / "trials.csv")]
    )


def test_nothing_is_both_removed_and_left(whole, tmp_path):
    shutil.copytree(whole, tmp_path / "copy")
    shutil.copy(whole / "map" / "map.nc", tmp_path / "copy" / "warm.nc")
    done = delete_participant(tmp_path / "copy", "P02")
    assert not set(done.removed) & set(done.left) and str(tmp_path / "copy" / "map" / "map.nc") in done.removed
    assert set(done.left) == {str(tmp_path / "copy" / "warm.nc")}


def test_what_killed_commands_left_goes_too(whole, tmp_path):
    shutil.copytree(whole, tmp_path / "copy")
    (tmp_path / "copy" / "logs" / ".hilbo-0123.part").write_text("P02")
    (tmp_path / "copy" / "logs" / ".map-01234567.part").mkdir()
    (tmp_path / "copy" / "logs" / ".map-01234567.part" / "result.json").write_text("P02")
    (tmp_path / "copy" / "map" / LOCK).touch()  # of a folder with nothing in it that several commands rewrite
    delete_participant(tmp_path / "copy", "P02")
    assert faults(tmp_path / "copy", {"P02"}, {*PEOPLE} - {"P02"}) == []
    assert not [*(tmp_path / "copy").rglob(LOCK)]


def test_results_that_are_being_made_are_waited_for_and_none_begin_meanwhile(whole, tmp_path, monkeypatch):
    monkeypatch.setattr("hilbo.study.disk.new_folder.locked_folder", functools.partial(locked_folder, patience=0.05))
    folder = tmp_path / "copy"
    shutil.copytree(whole, folder)
    with new_folder(folder / "new" / "map", lambda: None) as made:
        (made / "result.json").write_text("P02")
        with pytest.raises(InputError, match="results are being made there"):
            delete_participant(folder, "P02")
        assert faults(folder, set(), set(PEOPLE)) == [f"{made.name} stays", ".hilbo.lock stays"]
    with patched_disk():
        Process(lambda: delete_participant(folder, "P02"), 25).run()
    with pytest.raises(InputError, match="a withdrawal was interrupted"), new_folder(folder / "map2", lambda: None):
        pass


def run_schedule(whole, folder, seed):
    shutil.copytree(whole, folder)
    assert Schedule(folder, random.Random(seed)).run() == [], seed


@pytest.mark.parametrize("seed", range(4))
def test_whoever_withdraws_is_nowhere_and_nobody_else_is_missing(whole, tmp_path, seed):
    run_schedule(whole, tmp_path / "copy", seed)


@pytest.mark.deep
def test_of_many_schedules_too(whole, tmp_path):
    for seed in range(4, 400):
        run_schedule(whole, tmp_path / f"{seed}", seed)
