"""`hilbo cache` shows and drops what is kept, and results are the same bits with and without it."""

import json
import os
import stat
import subprocess
import sys

import pytest
from commands import run

from hilbo.cli.terminal.console import _compiled_programs
from hilbo.programs.entries import Entries, Entry
from hilbo.programs.private import private_folder


def test_it_shows_and_drops_what_is_kept(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    Entries(tmp_path / "hilbo" / "programs", print).write(Entry("words", b"", bytes(1000)))
    (tmp_path / "hilbo" / "jax").mkdir()
    (tmp_path / "hilbo" / "jax" / "one-cache").write_bytes(bytes(500))

    def said(*options):
        code, out, err = run(capsys, monkeypatch, "cache", *options)
        assert code == 0 and err == ""
        return out

    content = json.loads(said("--json"))
    assert content["traced"]["programs"] == 1 and content["compiled"] == {"programs": 1, "bytes": 500}
    assert "1 programs, 0.0 MB" in said()
    assert json.loads(said("--clear", "--json"))["compiled"]["programs"] == 0
    assert not list((tmp_path / "hilbo" / "programs").iterdir())


@pytest.mark.deep  # starts a process that imports JAX
@pytest.mark.skipif(os.name == "nt", reason="modes of POSIX")
def test_a_command_does_not_give_jax_a_folder_that_others_may_write(tmp_path):
    (tmp_path / "hilbo" / "jax").mkdir(parents=True)
    (tmp_path / "hilbo" / "jax").chmod(0o777)
    code = (
        "from hilbo.cli.terminal.console import start; start(); import jax; print(jax.config.jax_compilation_cache_dir)"
    )
    environment = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    environment["XDG_CACHE_HOME"] = str(tmp_path)
    done = subprocess.run(
        [sys.executable, "-P", "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout == "None\n" and "another user" in done.stderr


@pytest.mark.skipif(os.name == "nt", reason="modes of POSIX")
def test_programs_that_another_user_may_have_compiled_are_not_run(tmp_path, monkeypatch, capsys):
    """JAX's kept programs are machine code, as those of `programs` are."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = tmp_path / "hilbo" / "jax"
    assert _compiled_programs() == folder and stat.S_IMODE(folder.stat().st_mode) == 0o700
    (folder / "one-cache").write_bytes(b"")
    assert _compiled_programs() == folder and capsys.readouterr().err == ""
    for mode in (0o770, 0o702):
        folder.chmod(mode)
        assert _compiled_programs() is None
        assert "may be changed by, another user; it is not used, delete it" in capsys.readouterr().err
    folder.chmod(0o700)
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    assert _compiled_programs() is None
    monkeypatch.undo()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder.rename(tmp_path / "elsewhere")
    folder.symlink_to(tmp_path / "elsewhere")
    assert _compiled_programs() is None


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root gives files away")
def test_an_entry_that_another_user_left_in_a_private_folder_is_seen(tmp_path):
    (tmp_path / "mine-cache").write_bytes(b"")
    tmp_path.chmod(0o700)
    assert private_folder(tmp_path)
    (tmp_path / "planted-cache").write_bytes(b"")
    os.chown(tmp_path / "planted-cache", 65534, -1)
    assert not private_folder(tmp_path)


@pytest.mark.deep
@pytest.mark.release
@pytest.mark.parametrize(
    "command",
    [
        "aggregate hilbo/data/video_quality.csv --study hilbo/data/video_quality.toml --first 10",
        "identify hilbo/data/memory_foam_simulated.csv --damping 0.95",
    ],
)
def test_results_are_the_same_bits_traced_made_and_kept(command, tmp_path):
    """Compiles everything twice, so of the commands only these two."""
    contents = []
    for keep in (0, 1, 1):
        out = tmp_path / str(len(contents))
        subprocess.run(
            [sys.executable, "-c", "from hilbo.cli.main import main; main()", *command.split(), "--out", str(out)],
            check=True,
            env=os.environ | {"HILBO_KEEP_PROGRAMS": str(keep), "XDG_CACHE_HOME": str(tmp_path / "cache")},
        )
        contents.append((out / "result.json").read_bytes())
    assert contents[0] == contents[1] == contents[2]
    assert Entries(tmp_path / "cache" / "hilbo" / "programs", print).sizes()
