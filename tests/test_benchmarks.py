"""Benchmarks of a minute or two still run: what they call changes, and nothing else calls it as they do."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SMALLEST = {
    "coverage_statistics": ["--studies", "5", "--people", "4"],
    "exponentials": ["--degree", "4", "--states", "4"],
    "identification": ["time"],
    "learning": ["--people", "4"],
    "mechanics": ["--rounds", "1"],
    "preset_paper": ["--seeds", "1"],
}


@pytest.mark.deep
@pytest.mark.release
@pytest.mark.parametrize("name", SMALLEST)
def test_a_benchmark_runs(name):
    command = [sys.executable, ROOT / "benchmarks" / f"{name}.py", *SMALLEST[name]]
    done = subprocess.run(command, cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
