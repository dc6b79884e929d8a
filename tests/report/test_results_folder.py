"""A results folder is whole or absent, and only what hilbo wrote itself is ever replaced."""

import pytest

from hilbo.cli.terminal.console import results
from hilbo.errors import InputError


def write(out, force=False, text="1", name="result.json"):
    with results(out, force) as folder:
        (folder / "tables").mkdir()
        (folder / "tables" / "people.csv").write_text(text)
        (folder / name).write_text(text)


def test_a_folder_is_replaced_by_force_only(tmp_path):
    out = tmp_path / "out"
    write(out)
    with pytest.raises(InputError, match="exists already"):
        write(out)
    write(out, force=True, text="2", name="other.json")
    assert (out / "tables" / "people.csv").read_text() == "2" and not (out / "result.json").exists()


@pytest.mark.parametrize("place", ["notes.txt", "tables/notes.txt", "tables/people.csv"])
def test_what_is_not_hilbos_stays(tmp_path, place):
    out = tmp_path / "out"
    write(out)
    (out / place).write_text("mine")
    words = "has been changed" if place.endswith("csv") else "is not a result"
    with pytest.raises(InputError, match=words):
        write(out, force=True)
    assert (out / place).read_text() == "mine"


@pytest.mark.parametrize("list_of_files", [None, "rubbish", "[1]"])
def test_a_folder_without_hilbos_list_is_somebody_elses(tmp_path, list_of_files):
    out = tmp_path / "out"
    write(out)
    (out / ".hilbo.json").unlink()
    if list_of_files is not None:
        (out / ".hilbo.json").write_text(list_of_files)
    with pytest.raises(InputError, match="is not a result"):
        write(out, force=True)


def test_a_failure_leaves_what_was_there(tmp_path):
    out = tmp_path / "out"
    write(out)
    with pytest.raises(ZeroDivisionError), results(out, force=True) as folder:
        (folder / "half.csv").write_text(f"{1 / 0}")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out"]
    assert (out / "result.json").read_text() == "1"


def test_an_empty_folder_is_filled(tmp_path):
    (tmp_path / "out").mkdir()
    write(tmp_path / "out")
    assert (tmp_path / "out" / "result.json").exists()
