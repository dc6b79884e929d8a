"""Somebody withdraws from a folder with links, closed folders and packed files: all is done or listed."""

import bz2
import gzip
import lzma
import os
import zipfile
from pathlib import Path

import numpy as np
import pytest
from commands import run

from hilbo.errors import InputError
from hilbo.session.withdrawal import withdrawal
from hilbo.session.withdrawal.withdrawal import Withdrawal, delete_participant
from hilbo.study.disk.lock import JOURNAL
from hilbo.study.results.listing import list_files

TABLE = "participant,trial\nP01,1\nP02,1\n"
WITHOUT = "participant,trial\nP02,1\n"


@pytest.fixture
def study(tmp_path):
    """A folder with a table; what is beside it is not below it."""
    (folder := tmp_path / "study").mkdir()
    (folder / "trials.csv").write_text(TABLE)
    (tmp_path / "real").mkdir()
    (tmp_path / "real" / "more.csv").write_text(TABLE)
    return folder


def test_a_table_with_a_link_to_it_counts_once_from_within_the_folder_too(study, monkeypatch):
    (study / "a.csv").symlink_to("trials.csv")
    monkeypatch.chdir(study)
    assert delete_participant(".", "P01").removed == {"trials.csv": 1}
    assert (study / "a.csv").is_symlink() and (study / "trials.csv").read_text() == WITHOUT


def test_links_that_lead_out_are_listed_and_stay(study):
    links = {"logs": "../real", "more.csv": "../real/more.csv", "gone": "../not-mounted", "up": "..", "loop": "loop"}
    for name, target in links.items():
        (study / name).symlink_to(target)
    done = delete_participant(study, "P01")
    assert set(done.removed) == {str(study / "trials.csv")}
    assert set(done.left) == {str(study / name) for name in links}
    assert str(study.parent / "real") in done.left[str(study / "logs")]
    assert all((study / name).is_symlink() for name in links)
    assert (study.parent / "real" / "more.csv").read_text() == TABLE


@pytest.mark.parametrize("store", ["store", ".git/annex"])
def test_a_linked_file_is_changed_in_its_own_place(study, store):
    (study / store).mkdir(parents=True)
    for name, key in (("list.csv", "x1"), (".P01-1.keys", "x2")):
        (study / store / key).write_text(TABLE)
        (study / name).symlink_to(Path(store) / key)
    done = delete_participant(study, "P01")
    assert (study / "list.csv").is_symlink() and (study / store / "x1").read_text() == WITHOUT
    assert not (study / store / "x2").exists() and not (study / ".P01-1.keys").is_symlink()
    assert {str(study / name) for name in ("list.csv", ".P01-1.keys", "trials.csv")} == set(done.removed)


def test_two_names_of_one_file_are_one_file(study):
    (study / "a.csv").symlink_to("trials.csv")
    (study / ".P01-2.keys").write_text("{}")
    (study / "keys").symlink_to(".P01-2.keys")
    (study / "again").symlink_to(".")
    done = delete_participant(study, "P01")
    assert (study / "a.csv").is_symlink() and (study / "trials.csv").read_text() == WITHOUT
    assert set(done.removed) == {str(study / name) for name in ("trials.csv", ".P01-2.keys", "keys")}
    assert not done.left and not (study / "keys").is_symlink()


def test_a_folder_that_cannot_be_opened_is_listed(study, monkeypatch):
    (study / "locked").mkdir()
    real = os.scandir

    def scandir(path="."):
        if str(path).endswith("locked"):
            raise PermissionError(13, "Permission denied", str(path))
        return real(path)

    monkeypatch.setattr(os, "scandir", scandir)
    assert "Permission denied" in delete_participant(study, "P01").left[str(study / "locked")]


@pytest.mark.parametrize("name", ["no/where", "study/trials.csv"])
def test_what_is_no_folder_is_refused(study, name):
    with pytest.raises(InputError, match=r"cannot be opened .*; give the folder"):
        delete_participant(study.parent / name, "P01")


def test_packed_files_are_known_by_how_they_begin(study):
    text = (TABLE * 50).encode()
    for name, pack in (("a.rds", gzip.compress), ("b.xx", lzma.compress), ("c", bz2.compress)):
        (study / name).write_bytes(pack(text))
    with zipfile.ZipFile(study / "d.jasp", "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("data", text)
    np.savez_compressed(study / "e.npz", answers=np.array(["P01"] * 9))
    (study / "f.sqlite").write_bytes(b"SQLite format 3\0 P02")
    (study / "g.txt").write_text("PK, BZh and 7z are letters.")
    (study / ".git").mkdir()
    left = delete_participant(study, "P01").left
    assert set(left) == {str(study / name) for name in ("a.rds", "b.xx", "c", "d.jasp", "e.npz", ".git")}
    assert "cannot be searched" in left[str(study / "a.rds")]


def test_a_folder_of_results_of_which_nothing_is_left_goes(tmp_path):
    (tmp_path / "maps" / "map" / "figures").mkdir(parents=True)
    (tmp_path / "maps" / "map" / "result.json").write_text('{"participants": [{"participant": "P01"}]}')
    (tmp_path / "maps" / "map" / "figures" / "map.svg").write_text("")
    list_files(tmp_path / "maps" / "map", "hilbo aggregate trials.csv")
    assert delete_participant(tmp_path / "maps", "P01").commands and not list((tmp_path / "maps").iterdir())


def test_where_nothing_is_found_what_was_not_searched_is_named(study, capsys, monkeypatch):
    (study / "logs").symlink_to("../real")
    (study / "trials.csv").unlink()
    code, _, err = run(capsys, monkeypatch, "participants", "delete", study, "P01", "--yes")
    assert code == 2 and f"{study / 'logs'}: LEFT; is a link to {study.parent / 'real'}" in err


def refusing(monkeypatch, owner, name, place):
    """Let the system refuse one function one file."""
    real = getattr(owner, name)

    def refused(path, *arguments, **options):
        if place in [Path(str(given)).name for given in (path, *arguments[:1])]:
            raise PermissionError(13, "Permission denied", str(path))
        return real(path, *arguments, **options)

    monkeypatch.setattr(owner, name, refused)


def test_what_cannot_be_read_is_listed_and_the_rest_is_done(study, capsys, monkeypatch):
    (study / ".#plan.json").symlink_to("me@there.123:456")
    (study / "others.json").write_text("{}")
    refusing(monkeypatch, Path, "open", "others.json")
    refusing(monkeypatch, Path, "read_bytes", "others.json")
    code, _, err = run(capsys, monkeypatch, "participants", "delete", study, "P01", "--yes")
    lines = {line.partition(": ")[0]: line for line in err.splitlines()}
    assert code == 0 and set(lines) == {str(study / name) for name in (".#plan.json", "others.json", "trials.csv")}
    assert "LEFT; is a link to what cannot be opened" in lines[str(study / ".#plan.json")]
    assert "LEFT; cannot be read (Permission denied)" in lines[str(study / "others.json")]


def test_what_cannot_be_changed_is_listed_and_the_rest_is_done(study, monkeypatch):
    (study / ".P01-1.keys").write_text("{}")
    (study / "fixed.csv").write_text(TABLE)
    (study / "map").mkdir()
    for name in ("result.json", "report.html"):
        (study / "map" / name).write_text('{"participants": [{"participant": "P01"}]}')
    list_files(study / "map", "hilbo aggregate trials.csv")
    refusing(monkeypatch, Path, "unlink", ".P01-1.keys")
    refusing(monkeypatch, Path, "unlink", "report.html")
    refusing(monkeypatch, os, "replace", "fixed.csv")
    done = Withdrawal("P01")
    with pytest.raises(InputError, match=r"could not be changed \(3 in all\); mend that and give the command again"):
        delete_participant(study, "P01", done)
    assert set(done.removed) == {str(study / name) for name in ("trials.csv", "map/result.json")} and done.commands
    assert set(done.left) == {str(study / name) for name in (".P01-1.keys", "fixed.csv", "map/report.html")}
    assert all("could not be changed (Permission denied)" in why for why in done.left.values())
    assert (study / "fixed.csv").read_text() == TABLE
    assert sorted(path.name for path in study.iterdir()) == [".P01-1.keys", JOURNAL, "fixed.csv", "map", "trials.csv"]
    monkeypatch.undo()
    again = delete_participant(study, "P01")
    assert set(again.removed) == {*done.removed, *done.left} and not again.left and again.commands == done.commands
    assert sorted(path.name for path in study.iterdir()) == ["fixed.csv", "trials.csv"]


def test_a_withdrawal_that_an_error_ends_says_what_it_did(study, capsys, monkeypatch):
    def broken(*_):
        raise RuntimeError("of a library")

    monkeypatch.setattr(withdrawal, "list_again", broken)
    (study / "map").mkdir()
    (study / "map" / "result.json").write_text('{"participants": [{"participant": "P01"}]}')
    list_files(study / "map", "hilbo aggregate trials.csv")
    code, _, err = run(capsys, monkeypatch, "participants", "delete", study, "P01", "--yes")
    assert code == 1 and f"{study / 'trials.csv'}: 1 removed\n" in err and "of a library" in err
