"""The README's study in nine commands and its Python, as written there, one after the other."""

import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT), "HILBO_KEEP_PROGRAMS": "1"}


def block_of(heading, language=""):
    """Text of the first code block below a heading."""
    return README.partition(f"## {heading}\n")[2].partition(f"```{language}\n")[2].partition("```")[0]


def commands():
    """The lines of the study, without the words behind #."""
    return [shlex.split(line.partition("#")[0]) for line in block_of("A study in nine commands").splitlines()]


@pytest.fixture
def folder(tmp_path):
    """A folder with the shipped data where the README has them; hilbo itself is not imported from it (-P)."""
    (tmp_path / "hilbo").symlink_to(ROOT / "hilbo")
    return tmp_path


def test_there_are_nine():
    assert len(commands()) == 9 and all(command[0] == "hilbo" for command in commands())


@pytest.mark.deep
def test_the_commands_run_in_their_order(folder):
    run = [sys.executable, "-P", "-c", "from hilbo.cli.main import main; main()"]
    for command in commands():
        made = subprocess.run([*run, *command[1:]], cwd=folder, env=ENVIRONMENT, capture_output=True, text=True)
        assert made.returncode == 0, f"{shlex.join(command)}: {made.stderr[-2000:]}"
    for name in ("results/report.html", "report/report.html", "check/report.html", "power/report.html", "plan.md"):
        assert (folder / name).stat().st_size > 1000


@pytest.mark.deep
def test_the_python_runs(folder):
    code = block_of("In Python", "python")
    ran = subprocess.run(
        [sys.executable, "-P", "-c", code],
        cwd=folder,
        env=ENVIRONMENT | {"MPLBACKEND": "agg"},
        capture_output=True,
        text=True,
    )
    assert ran.returncode == 0, ran.stderr
    assert "height_px" in ran.stdout and "converged=True" in ran.stdout
