"""Every notebook runs from top to bottom as a user would run it, and none is forgotten."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted(ROOT.glob("notebooks/*.py"))
LONG = ("report",)  # three materials: minutes


def test_there_are_notebooks():
    assert len(NOTEBOOKS) >= 2


@pytest.mark.deep
@pytest.mark.parametrize(
    "path",
    [pytest.param(path, id=path.stem, marks=[pytest.mark.release] if path.stem in LONG else []) for path in NOTEBOOKS],
)
def test_notebook_runs(path, tmp_path):
    """In an empty folder: a notebook finds what it needs wherever it is opened."""
    env = os.environ | {"HILBO_NOTEBOOK_TRIALS": "7"}
    command = [sys.executable, "-W", "ignore::DeprecationWarning", str(path)]
    done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    assert done.stdout
