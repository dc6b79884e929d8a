"""The recursion of `hilbo try`'s page (static/try.js, run by node) against the firmware's core and `viscoelastic`."""

import ctypes
import json
import shutil
import subprocess
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from helpers_firmware import build, library
from scipy.stats import qmc

from hilbo import viscoelastic
from hilbo.app.server import tried
from hilbo.app.server.tried import FIXED, NAMES, STATES
from hilbo.mechanics.exponentials import TABLE, exponentials

PAGE = Path(tried.__file__).parents[1] / "static" / "try.js"
pytestmark = pytest.mark.skipif(shutil.which("node") is None, reason="needs node")

BOUND = 1e-6  # of the largest displacement
_RUN = """
const { sets, forces, fixed } = JSON.parse(require("fs").readFileSync(0, "utf8"));
require("vm").runInThisContext(require("fs").readFileSync(process.argv[1], "utf8") + "; globalThis.Made = Block");
const blocks = sets.map((set) => new Made(set, fixed));
console.log(JSON.stringify(blocks.map((block, i) => forces[i].map((force) => block.step(force)))));
"""


def displacements(sets, forces) -> np.ndarray:
    """What the page's blocks do, from rest: (m, n) mm, of sets (m, 3) under forces (m, n) N."""
    given = {
        "sets": [dict(zip(NAMES, row, strict=True)) for row in np.asarray(sets, float).tolist()],
        "forces": np.asarray(forces, float).tolist(),
        "fixed": FIXED | {"table": TABLE[STATES]},
    }
    done = subprocess.run(
        ["node", "-e", _RUN, str(PAGE)], input=json.dumps(given), capture_output=True, text=True, check=True
    )
    return np.array(json.loads(done.stdout))


def sets_of(count: int) -> np.ndarray:
    """K1, B1, alpha of float32 over what the study searches, and beyond; corners first."""
    corners = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1).T
    unit = np.vstack([corners, qmc.Sobol(3, rng=3).random_base2(6)])[:count]
    low, high = np.array([(0.3, 0.1, 0.05), (32, 32, 0.95)])
    return (low * (high / low) ** unit).astype(np.float32)


def largest_error(computed, expected) -> float:
    """Of each row's largest displacement."""
    return float(np.max(np.max(np.abs(computed - expected), axis=1) / np.max(np.abs(expected), axis=1)))


def against_reference(sets, force) -> float:
    exact = [
        np.asarray(viscoelastic.FOSLS(FIXED["K0"], *map(float, row), memory="full").simulate_force(jnp.asarray(force)))
        for row in sets
    ]
    return largest_error(displacements(sets, [force] * len(sets)), np.array(exact))


def core_forces(row, x: np.ndarray) -> np.ndarray:
    """Of the firmware's core at positions (n,), float32, with the exponentials that its host sends."""
    weight, loss = (np.asarray(part, np.float32) for part in exponentials(jnp.asarray(float(row[2])), STATES))
    forces = np.full(x.size, np.nan, np.float32)
    accepted = library(build()).shim_render(
        (ctypes.c_double * 7)(1, STATES, round(1 / FIXED["T"]), np.float32(FIXED["K0"]), *map(float, row)),
        *(part.ctypes.data_as(ctypes.c_void_p) for part in (weight, loss, x)),
        ctypes.c_size_t(x.size), forces.ctypes.data_as(ctypes.c_void_p),
    )  # fmt: skip
    assert accepted
    return forces


def presses(count: int, n: int) -> np.ndarray:
    """Positions (count, n) of presses, holds and releases, mm, float32."""
    rng = np.random.default_rng(2)
    goals = np.repeat(rng.uniform(0, 8, (count, n // 500 + 1)), 500, axis=1)[:, :n]
    smooth = np.hanning(160) / np.hanning(160).sum()
    return np.array([np.convolve(row, smooth, "full")[:n] for row in goals]).astype(np.float32)


def against_the_core(sets, n: int) -> float:
    x = presses(len(sets), n)
    forces = np.array([core_forces(row, pressed) for row, pressed in zip(sets, x, strict=True)])
    return largest_error(displacements(sets, forces), x)


def test_creep_and_recovery_are_the_references():
    force = np.concatenate([np.full(1500, 3.0), np.full(1500, 0.0)])
    assert against_reference(sets_of(3), force) <= BOUND


def test_positions_are_those_that_gave_the_core_its_forces():
    assert against_the_core(sets_of(9)[5:], 3000) <= BOUND


@pytest.mark.deep
def test_all_sets_over_a_longer_time(record_property):
    sets = sets_of(72)
    creep, core = (
        against_reference(sets, np.concatenate([np.full(6000, 3.0), np.full(6000, 0.0)])),
        against_the_core(sets, 12_000),
    )
    for name, error in (("creep and recovery", creep), ("the core's presses", core)):
        record_property(name, error)
        print(f"{name}: {error:.1e} of the largest displacement")
    assert max(creep, core) <= BOUND
