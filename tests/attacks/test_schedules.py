"""A short version of the attack in attacks/schedules.py; tests/session/test_withdrawal_kills.py has many schedules, in
one process."""

import shutil
import subprocess
import sys

import pytest
from simulated import ROOT


@pytest.mark.deep
@pytest.mark.release  # the study that it needs is compiled in a cache of its own: a minute
@pytest.mark.skipif(shutil.which("gcc") is None or sys.platform != "linux", reason="needs gcc and preloaded libraries")
def test_commands_that_are_killed_leave_a_whole_study():
    command = [sys.executable, str(ROOT / "attacks" / "schedules.py"), "--count", "6", "--seed", "7"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr + done.stdout
    assert "6  all is done" in done.stdout
