"""Hosts that are killed while somebody presses, against the firmware's own core. Only device ticks are asserted."""

import os
import random
import signal
import subprocess
import sys
import time

import pytest
from simulated import ENVIRONMENT, needs_device, own_cache  # noqa: F401

from attacks.killed_hosts import BOUND, Killing

pytestmark = needs_device


@pytest.mark.parametrize("times", [2, pytest.param(100, marks=[pytest.mark.deep, pytest.mark.release])])
def test_a_killed_host_is_zero_force_within_the_watchdog_and_its_ramp(times):
    killing, rng = Killing(), random.Random(times)
    try:
        for _ in range(times):
            killing.seen.append(killing.killed(rng, least_N=0.6))
            killing.take_over()
    finally:
        killing.close()
    assert max(killed.ticks for killed in killing.seen) < BOUND
    assert min(killed.before_N for killed in killing.seen) > 0.5


def test_the_simulated_device_ends_with_a_killed_python():
    code = (
        "import os\nfrom hilbo.hardware_bridge import Renderer\n"
        "d = Renderer.open('sim')\nprint(d.simulator._process.pid, flush=True)\nos.kill(os.getpid(), 9)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=ENVIRONMENT)
    assert run.returncode == -signal.SIGKILL, run.stderr
    pid = int(run.stdout)
    deadline = time.monotonic() + 20
    while alive(pid) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not alive(pid)


def alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True
