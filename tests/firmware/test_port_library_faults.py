"""A program of its own with the library and a simulated motor, in real time: late ticks, missed seconds and a kill. The
motor's force is zero soon after each, and what the library returned has the bits of the device's core."""

import os
import subprocess
import time

import numpy as np
import pytest
from device_port import program
from host_runs import Row, float_bits, replayed
from simulated import needs_device, own_cache  # noqa: F401

from hilbo.device.local.library import Fate
from hilbo.device.local.motor import MOTOR, SimulatedMotor
from hilbo.device.reasons import State

pytestmark = needs_device
SECONDS = float(os.environ.get("HILBO_HOST_PORT_SECONDS", "60"))
WITHIN_MS = 20.0
DRIVE = {"K0": 0.1, "K1": 0.6, "B1": 0.5, "alpha": 0.3, "force_limit": 15.0}


def read_log(file):
    """Rows as `replayed` takes them."""
    rows = []
    for kind, _, position, force, *counts in map(str.split, file.read_text().splitlines()):
        numbers = map(int, counts)
        rows.append(Row(kind, float(position), float(force), *numbers, parameters=DRIVE if kind == "set" else None))
    return rows


def zero_after(record, fault_ns):
    """ms from a fault's last command until the motor's force is zero, and by how much its own process was late then."""
    times, forces = record[:, 0], record[:, 1]
    first = int(np.searchsorted(times, fault_ns))
    zero = first + int(np.flatnonzero(forces[first:] == 0)[0])
    gaps = np.diff(times[first - 1 : zero + 1]) / 1e6
    return (times[zero] - fault_ns) / 1e6, float(np.sum(np.maximum(gaps - 1.0, 0)))


def driven(folder, seconds):
    """What hilbo-drive does until it kills itself, and what the motor recorded."""
    record = folder / "motor"
    with SimulatedMotor("all", record=record) as motor:
        command = [program("hilbo-drive"), motor.file, folder / "log", str(seconds)]
        done = subprocess.run(list(map(str, command)), capture_output=True, text=True)
        assert done.returncode == -9, done.stderr
        time.sleep(0.1)
    faults = [(kind, float(at)) for kind, at in map(str.split, done.stdout.splitlines())]
    return faults, np.loadtxt(record), read_log(folder / "log")


@pytest.mark.deep
@pytest.mark.release  # a minute of real time, which wants a processor of its own
def test_force_ends_within_20_ms_of_each_fault_and_has_the_bits_of_the_core(tmp_path):
    faults, record, rows = driven(tmp_path, SECONDS)
    found = {"jitter": [], "stall": [], "kill": []}
    for kind, at in faults:
        after, late = zero_after(record, at)
        assert after - late < WITHIN_MS, (kind, after, late)
        found[kind].append(after)
    ticks = [row for row in rows if row.kind == "tick"]
    late_us = [row.late_us for row in ticks]
    print(f"{len(ticks)} ticks, late by {np.percentile(late_us, 50):.0f} us (median), {max(late_us)} us (largest);")
    print(f"{sum(row.missed > 0 for row in ticks)} gaps, {len(faults)} of them on purpose")
    for kind, afters in found.items():
        words = f"{min(afters):.1f} to {max(afters):.1f} ms" if afters else "none"
        print(f"{kind}: {len(afters)}, force zero after {words}")
    assert all(found.values())
    resumed = [row for row in ticks if row.missed > 100]
    assert len(resumed) >= len(found["stall"]) - 1 > 0 and all(
        (row.force_N, row.state) == (0, State.HOLD) for row in resumed
    )
    assert any(row.fate == Fate.IN_FORCE for row in ticks) and max(row.force_N for row in ticks) > 0.5
    assert float_bits(replayed(rows, MOTOR)) == float_bits(row.force_N for row in ticks)


def test_the_motor_drops_to_zero_without_commands(tmp_path):
    with SimulatedMotor("none", record=tmp_path / "motor") as motor:
        end = time.monotonic() + 0.1
        while time.monotonic() < end:
            motor.command(1.0)
            time.sleep(0.001)
        motor.command(1.0)
        at = time.clock_gettime_ns(time.CLOCK_MONOTONIC)
        time.sleep(0.1)
        assert motor.felt_N == 0 and motor.sample()[0] < -1.0  # pushed out from where it began
    record = np.loadtxt(tmp_path / "motor")
    after, late = zero_after(record, at)
    assert after > 14 and after - late < WITHIN_MS and record[:, 1].max() == 1
