"""The core in closed loop with a simulated handle and random hands, through losses, late ticks, slews and switches."""

import subprocess

import numpy as np
import pytest
from helpers_firmware import CORE, FIRMWARE, build

SLEWED, LOSSES, LATE, SWITCHES, DELAYED = 1, 2, 4, 8, 16
SIM = FIRMWARE / "port" / "sim"
KIND, RUNS, TICKS, HOLDS, OUT_OF_CONTACT, MADE, ASKED, BEGUN, CUT, TOO_FAST = range(10)
MANY = [400, pytest.param(10_000, marks=pytest.mark.deep)]


def loops(runs: int, controls: bool) -> np.ndarray:
    """A row for each of the 32 kinds of run, as firmware/tests/loops.c says."""
    sources = [str(path) for path in sorted(SIM.glob("*.c"))]
    extra = ("-D_XOPEN_SOURCE=700", "-Wno-double-promotion", f"-I{SIM}", *sources)
    program = build(CORE, extra, drivers=("loops.c",))
    run = subprocess.run([program, str(runs), "0", str(int(controls))], capture_output=True, text=True, check=True)
    return np.array([line.split() for line in run.stdout.splitlines()], float)


@pytest.mark.parametrize("runs", MANY)
@pytest.mark.parametrize("controls", [False, True])
def test_no_force_in_free_air_and_no_energy_where_passivity_is_certified(runs, controls):
    rows = loops(runs, controls)
    kinds = rows[:, KIND].astype(int)
    assert rows[:, RUNS].sum() == runs and np.all(rows[:, TICKS] > 1000)
    assert np.all(rows[:, OUT_OF_CONTACT] == 0)
    assert rows[:, ASKED].sum() > 0 and not np.any(rows[:, BEGUN])
    plain = (kinds & ~DELAYED) == 0
    steady = (kinds & (SLEWED | SWITCHES)) == 0
    assert np.all(rows[plain, MADE] < 0.01) and not np.any(rows[plain, HOLDS])
    assert np.all(rows[steady, MADE] < 0.5)  # mJ: the periods that losses and late ticks make longer
    assert np.all(rows[steady, CUT] < 0.5)  # of a force that a set would pull with, and which is 0 instead
    if controls:
        assert np.all(rows[(kinds & SWITCHES) == 0, MADE] < 1.0) and np.all(rows[steady, CUT] < 0.01)
    for row in rows:
        words = "kind {:.0f}: {:.0f} runs, {:.0f} ticks, {:.0f} holds, {:.3g} N, {:.3g} mJ"
        print((words + ", {:.0f} STARTs in contact, {:.0f} touches begun so").format(*row))
