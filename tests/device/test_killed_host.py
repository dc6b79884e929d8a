"""Hosts that are killed while somebody presses, against the firmware's own core. Only device ticks are asserted."""

import os
import random
import signal
import subprocess
import sys
import threading
import time

import pytest
from simulated import ENVIRONMENT, needs_device, own_cache  # noqa: F401

from hilbo.device.link import Link
from hilbo.device.ports import open_port
from hilbo.device.simulator import Simulator
from hilbo.hardware_bridge import Renderer, State

pytestmark = needs_device

HOST = """
import sys, time
from hilbo.hardware_bridge import Renderer
sets = [dict(K0=-3.18, K1=5.58, B1=7.88, alpha=0.176), dict(K0=-2.89, K1=5.70, B1=5.89, alpha=0.203)]
with Renderer.open(sys.argv[1]) as device:
    device.link.patience = 30.0
    device.send(**sets[0])
    device.start()
    print("running", flush=True)
    for n in range(10**6):
        device.send(**sets[n % 2])
        device.samples(0.05)
        device.status()
"""


def killed(found, rng):
    """Device ticks from the death of a host at a random moment to force zero, and the force before."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    host = subprocess.Popen([sys.executable, "-c", HOST, found.port], **pipes, env=ENVIRONMENT)
    ready = threading.Thread(target=host.stdout.readline)
    ready.start()
    while ready.is_alive():
        keep_up(found)
    for _ in range(rng.randrange(150, 400)):  # the finger takes some time to press
        keep_up(found)
    host.kill()
    host.wait()
    assert host.stderr.read() == b""  # ends with the helper that sends heartbeats
    host.stdout.close()
    host.stderr.close()
    dead, before, _ = tick(found, 1)  # takes in what was still on its way
    for _ in range(1000):
        now, force, _ = tick(found, 1)
        if force == 0:
            break
    rest = [tick(found, 1)[1] for _ in range(300)]
    assert not any(rest)
    return now - dead, before


def tick(found, count):
    """So many ticks; the tick, the force (N) and the age of the last heartbeat after them."""
    _, now, force, age = found.ticks(count).split()
    return int(now), float(force), int(age)


def keep_up(found):
    """Five ticks, but none while the host's heartbeats are late: this computer is busy."""
    time.sleep(0.001)
    tick(found, 5 if tick(found, 0)[2] < 150 else 0)


def takes_over(found):
    """The next host finds the device in HOLD, clears it and renders."""

    def connect():
        return Link(open_port(found.port), patience=30.0, ticks=found.ticks)

    with Renderer(connect) as device:
        assert device.notes == [
            "The device is in HOLD: it heard no heartbeat from the host; clear it before the next start."
        ]
        assert device.in_force() is not None
        device.clear()
        device.start()
        assert device.state() == State.RUNNING


@pytest.mark.parametrize("times", [5, pytest.param(100, marks=pytest.mark.deep)])
def test_a_killed_host_is_zero_force_within_the_watchdog_and_its_ramp(times):
    rng, largest = random.Random(times), 0.0
    found = Simulator(rate="lockstep", finger="hold")
    for _ in range(times):
        ticks, before = killed(found, rng)
        assert ticks <= 250 + 20
        largest = max(largest, before)
        takes_over(found)
    assert largest > 0.5
    found.close()


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
