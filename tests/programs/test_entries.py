"""Entries are whole, this user's, and not too many; whatever else lies in the folder is made again with a remark."""

import os
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from hilbo.programs.entries import Entries, Entry

ENTRY = Entry("words", b"structure", b"program" * 100)
POSIX = pytest.mark.skipif(sys.platform == "win32", reason="Windows has other rights")


@pytest.fixture
def remarks():
    return []


@pytest.fixture
def entries(tmp_path, remarks):
    kept = Entries(tmp_path / "programs", remarks.append)
    kept.write(ENTRY)
    return kept


@pytest.fixture
def path(entries):
    (only,) = entries.sizes()
    return only


def test_what_was_written_is_read(entries, remarks):
    assert entries.read("words") == ENTRY and entries.read("other words") is None
    assert remarks == []


@POSIX
def test_the_folder_is_this_users_alone(entries, path):
    assert entries.folder.stat().st_mode & 0o777 == 0o700 and path.stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize("place", range(0, 900, 37))
def test_a_changed_byte_is_seen(entries, path, remarks, place):
    content = bytearray(path.read_bytes())
    content[place % len(content)] ^= 1
    path.write_bytes(content)
    assert entries.read("words") is None and "damaged" in remarks[0]


@pytest.mark.parametrize("length", [0, 1, 31, 32, 33, 100, 700])
def test_a_cut_entry_is_seen(entries, path, remarks, length):
    path.write_bytes(path.read_bytes()[:length])
    assert entries.read("words") is None and "damaged" in remarks[0]


def test_an_entry_under_another_name_is_not_taken(entries, path, remarks):
    entries.write(Entry("other words", b"", b""))
    other = next(each for each in entries.sizes() if each != path)
    os.replace(other, path)
    assert entries.read("words") is None and "damaged" in remarks[0]


@POSIX
@pytest.mark.parametrize("which", ["folder", "entry"])
@pytest.mark.parametrize("rights", [0o777, 0o720, 0o702])
def test_what_others_may_write_is_not_used(entries, path, remarks, which, rights):
    (entries.folder if which == "folder" else path).chmod(rights)
    assert entries.read("words") is None
    assert "another user" in remarks[0]


@POSIX
def test_a_link_to_an_entry_is_not_used(entries, path, remarks, tmp_path):
    os.replace(path, tmp_path / "elsewhere")
    path.symlink_to(tmp_path / "elsewhere")
    assert entries.read("words") is None and "another user" in remarks[0]


@POSIX
def test_another_users_entry_is_not_used(entries, remarks, monkeypatch):
    monkeypatch.setattr(os, "geteuid", lambda: 12345)
    assert entries.read("words") is None and "another user" in remarks[0]
    entries.write(Entry("new", b"", b""))
    assert "nothing is kept" in remarks[1] and len(entries.sizes()) == 1


def test_what_was_used_longest_ago_is_dropped(tmp_path, remarks):
    kept = Entries(tmp_path, remarks.append, size=3000)
    tmp_path.chmod(0o700)
    for number in range(10):
        kept.write(Entry(f"number {number}", b"", bytes(900)))
        for path in kept.sizes():
            os.utime(path, ns=(0, path.stat().st_mtime_ns - 10**9))
        if number:
            assert kept.read("number 0") is not None  # it is used again and again
    assert sum(kept.sizes().values()) <= 3000
    assert [kept.read(f"number {n}") is not None for n in (0, 5, 9)] == [True, False, True]


def test_a_folder_that_cannot_be_made_is_one_remark(tmp_path, remarks):
    (tmp_path / "file").write_text("")
    Entries(tmp_path / "file", remarks.append).write(ENTRY)
    assert len(remarks) == 1


def test_many_writers_and_readers_at_once(entries, remarks):
    def use(number):
        entries.write(ENTRY)
        return entries.read("words") == ENTRY

    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(use, range(200)))
    assert remarks == [] and len(list(entries.folder.iterdir())) == 1


def test_what_a_killed_or_failed_write_left_goes(entries, remarks, monkeypatch):
    for name, age in (("old.part", 7200), ("new.part", 0)):
        (entries.folder / name).write_bytes(b"half")
        os.utime(entries.folder / name, (time.time() - age,) * 2)
    entries.write(ENTRY)
    assert sorted(path.suffix for path in entries.folder.iterdir()) == [".part", ".program"]
    monkeypatch.setattr(os, "replace", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    entries.write(ENTRY)
    assert len(list(entries.folder.glob("*.part"))) == 1 and "No space left" in remarks[0]
    entries.clear()
    assert list(entries.folder.iterdir()) == []


def test_all_are_dropped_at_once(entries):
    entries.clear()
    assert entries.sizes() == {} and entries.read("words") is None
