"""A line whose delay grows, and loses nothing: force ends in time, no order acts late, and a board may start slowly.

Times are the device's own ticks, as a relay at its side of the line sees them; each test is real time of some seconds.
"""

import contextlib
import os
import threading
import time

import pytest
from simulated import needs_device, own_cache  # noqa: F401
from slow_line import SlowLine

from hilbo.device import messages
from hilbo.device.local.simulator import Simulator
from hilbo.device.messages import Estop, Start
from hilbo.device.reasons import SampleFlag
from hilbo.hardware_bridge import DeviceError, Renderer

pytestmark = [needs_device, pytest.mark.deep]  # 2 to 6 s each, of real time

A = {"K0": -3.18, "K1": 5.58, "B1": 7.88, "alpha": 0.176}
WATCHDOG, RAMP, HALF_A_SECOND = 250, 20, 500  # ticks


@pytest.fixture
def line():
    simulator = Simulator(finger="hold")
    with SlowLine(simulator.port) as line:
        yield line
    simulator.close()


def pressed(line, **options) -> Renderer:
    """A renderer on the line, with the finger in the material."""
    device = Renderer.open(line.where, **({"patience": 1.0} | options))
    device.send(**A)
    device.start()
    while not line.samples or line.samples[-1][1] < 0.5:
        time.sleep(0.01)
    return device


@pytest.mark.parametrize("delay", [0.0, 0.05, 0.2, 2.0])
def test_estop_acts_within_the_watchdog_whatever_the_delay(line, delay):
    with contextlib.suppress(DeviceError), pressed(line) as device:
        line.delay = delay
        asked = line.tick
        threading.Thread(target=device.link.shout, args=(Estop(),)).start()
        while line.tick < asked + WATCHDOG + RAMP + 100:
            time.sleep(0.01)
        late = [tick - asked for tick, force, _ in line.after(asked) if force > 0]
        assert (late or [0])[-1] <= HALF_A_SECOND  # 270, and what the relay's newest sample is old on a busy machine


def test_estop_ends_force_where_the_line_loses_every_estop(line):
    """Heartbeats end with the request, so that the device lets go by itself; 3,245 ticks were measured before."""
    with contextlib.suppress(DeviceError), pressed(line) as device:
        line.lose = messages.Estop
        asked = line.tick
        stopping = threading.Thread(target=unanswered, args=(device.estop,))
        stopping.start()
        while line.tick < asked + WATCHDOG + RAMP + 300:
            time.sleep(0.01)
        late = [tick - asked for tick, force, _ in line.after(asked) if force > 0]
        assert (late or [0])[-1] <= HALF_A_SECOND
        stopping.join()


def unanswered(ask):
    with pytest.raises(DeviceError):
        ask()


def test_a_delay_that_grows_ends_force_before_anybody_asks(line):
    with contextlib.suppress(DeviceError), pressed(line):
        begun = time.monotonic()
        while (passed := time.monotonic() - begun) < 3:
            line.delay = passed  # grows by a second a second, so that half of all that was sent is on its way
            time.sleep(0.01)
        assert line.samples[-1][1] == 0 and line.samples[-1][2] & SampleFlag.HOLD


def test_a_start_that_stays_unanswered_never_runs(line):
    """It was on its way for 0.8 s, gave up after 0.3 s, and then rendered: the host follows it with a STOP, and the
    device refuses what comes with old heartbeats."""
    device = Renderer.open(line.where, patience=0.1)
    device.send(**A)
    current = device.in_force()
    line.delay = 0.8
    with pytest.raises(DeviceError, match=r"no answer in 3 tries.*Heartbeats have ended"):
        start(device, current)
    time.sleep(2.5)
    assert not any(flags & SampleFlag.RUNNING for _, _, flags in line.samples)
    with contextlib.suppress(DeviceError):
        device.close()


def start(device, current):
    known = {"boot_id": device.device.boot_id, "stop": device.link.stops}
    device.link.request(Start(set_id=current.set_id, crc=current.crc, **known))


def test_a_board_that_is_deaf_for_two_seconds_after_its_port_opens(line):
    line.deaf_until = time.monotonic() + 2.0
    with Renderer.open(line.where, patience=0.2) as device:
        assert device.state() == 0


def test_a_port_that_comes_back_under_another_name(tmp_path):
    """A system names a board by its serial number in a link, which points elsewhere once it is plugged in again."""
    link = tmp_path / "by-id"
    first, second = Simulator(finger="none"), Simulator(finger="none")
    os.symlink(first.port, link)
    device = Renderer.open(str(link))
    before = device.device.boot_id
    first.close()
    while not device.link.lost:
        time.sleep(0.01)
    link.unlink()
    os.symlink(second.port, link)
    assert device.reconnect() is False and device.device.boot_id != before
    assert device.in_force() is None
    device.close()
    second.close()
