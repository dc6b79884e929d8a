"""`hilbo cache` shows and drops what is kept, and results are the same bits with and without it."""

import json
import os
import subprocess
import sys

import pytest
from commands import run

from hilbo.programs.entries import Entries, Entry


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
