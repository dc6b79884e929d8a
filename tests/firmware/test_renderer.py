"""The device's renderer against float64 `viscoelastic`, over a minute of motion as an encoder sees it."""

import ctypes
import functools
import shutil

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers_firmware import CORE, EXPONENTIALS, build, library
from scipy.stats import qmc

from hilbo import viscoelastic
from hilbo.mechanics.exponentials import exponentials

STEP = np.float32(0.0127)
SHORT_BOUND, FULL_BOUND = 2e-5, 2e-6  # of the largest force


def motion(seconds: float = 60.0, seed: int = 1) -> np.ndarray:
    """Counts of presses, holds, tremor and releases, 0 to 8 mm with a fifth of the time off the surface."""
    rng = np.random.default_rng(seed)
    n = int(1000 * seconds)
    t = np.arange(n) / 1000
    goals = np.repeat(rng.uniform(-2, 8, n // 400 + 1), 400)[:n]
    smooth = np.convolve(goals, np.hanning(120) / np.hanning(120).sum(), "same")
    x = smooth + 0.3 * np.sin(2 * np.pi * 2 * t) + 0.05 * np.sin(2 * np.pi * 9 * t) + rng.normal(0, 0.01, n)
    return np.round(x / STEP).astype(np.int32)


def draw_sets(count: int, full: bool) -> np.ndarray:
    """K0, K1, B1, alpha of float32 over the whole search box, its corners first; static stiffness 0.44 N/mm."""
    corners = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1).T
    unit = np.vstack([corners, qmc.Sobol(3, rng=3).random_base2(8)])[:count]
    low, high = np.array([(1, 0.001, 0.01), (32, 32, 0.99)])
    K1, B1, alpha = (low + (high - low) * unit).T
    K0 = np.full(count, 0.44) if full else viscoelastic.K0_from_effective_stiffness(K1, B1, alpha)
    return np.column_stack([K0, K1, B1, alpha]).astype(np.float32)


@functools.cache
def _reference(memory: str):
    def forces(sets, x):
        model = lambda row: viscoelastic.FOSLS(*row, memory=memory)  # noqa: E731
        return jax.vmap(lambda row: model(row).simulate(x))(sets)

    return eqx.filter_jit(forces)


def render(lib: ctypes.CDLL, row, x, states=None) -> np.ndarray:
    """Forces of the C renderer at float32 positions, from rest; N = 101, or these exponentials."""
    weight, loss = (np.zeros(12, np.float32),) * 2 if states is None else (np.float32(part) for part in states)
    numbers = [0, 101, 1000, *row] if states is None else [1, len(weight), 1000, *row]
    forces = np.full(x.size, np.nan, np.float32)
    accepted = lib.shim_render(
        (ctypes.c_double * 7)(*map(float, numbers)),
        *(part.ctypes.data_as(ctypes.c_void_p) for part in (weight, loss, x)),
        ctypes.c_size_t(x.size), forces.ctypes.data_as(ctypes.c_void_p),
    )  # fmt: skip
    assert accepted, "the exponentials were refused"
    return forces


def states_of(alpha, states: int):
    return exponentials(jnp.asarray(float(alpha)), states)


def largest_error(count: int, memory: str, x: np.ndarray | None = None) -> float:
    """Of the largest force, over the sets."""
    lib = library(build())
    x = np.maximum(motion(), 0).astype(np.float32) * STEP if x is None else x
    sets, worst = draw_sets(count, memory == "full"), 0.0
    for first in range(0, count, 4):
        some = sets[first : first + 4]
        exact = np.asarray(_reference(memory)(jnp.asarray(some, float), jnp.asarray(x, float)))
        for row, expected in zip(some, exact, strict=True):
            forces = render(lib, row, x, states_of(row[3], 10) if memory == "full" else None)
            worst = max(worst, np.max(np.abs(forces - expected)) / np.max(np.abs(expected)))
    return worst


@pytest.mark.parametrize(("memory", "bound"), [("short", SHORT_BOUND), ("full", FULL_BOUND)])
def test_a_minute_of_motion_at_the_corners_of_the_box(memory, bound):
    assert largest_error(12, memory) <= bound


@pytest.mark.parametrize(("memory", "bound"), [("short", SHORT_BOUND), ("full", FULL_BOUND)])
def test_a_minute_of_holding_still(memory, bound):
    """Where what a tick adds is far below the last place of what there is."""
    x = np.full(60_000, 5, np.float32)
    x[:100] = np.linspace(0, 5, 100)
    assert largest_error(36, memory, x) <= bound


@pytest.mark.deep
@pytest.mark.parametrize(("memory", "bound"), [("short", SHORT_BOUND), ("full", FULL_BOUND)])
def test_a_minute_of_motion_at_two_hundred_sets(memory, bound, record_property):
    error = largest_error(200, memory)
    record_property("largest error of the largest force", float(error))
    print(f"{memory} memory: {error:.2e} of the largest force")
    assert error <= bound


@pytest.mark.parametrize("states", [None, 12, pytest.param(8, marks=pytest.mark.deep)])
def test_skipping_without_contact_changes_no_bit(tmp_path, states):
    """Long enough off the surface for a history of taps to end; the exponentials end only where they are cleared."""
    source = (CORE / "hb_renderer.c").read_text()
    skip = "x_mm == 0.0F && renderer->quiet == renderer->set.length"
    assert source.count(skip) == 1
    for path in CORE.iterdir():
        (tmp_path / path.name).write_text(path.read_text().replace(skip, "x_mm < 0.0F"))
    x = np.maximum(motion(12.0), 0).astype(np.float32) * STEP
    x[:500] = x[3000:9000] = 0
    row = np.float32([-3.18, 5.58, 7.88, 0.176]) if states is None else np.float32([0.44, 1.0, 3.0, 0.3])
    given = None if states is None else states_of(row[3], states)
    skipped, unskipped = (render(library(build(core)), row, x, given) for core in (CORE, tmp_path))
    assert skipped.tobytes() == unskipped.tobytes()
    assert np.count_nonzero(skipped[8900:9000]) == (0 if states is None else 100)


@pytest.mark.parametrize("N", [1, 3, 25, 201, 255])
def test_every_length_of_short_memory(N):
    x = np.maximum(motion(3.0), 0).astype(np.float32) * STEP
    row = np.float32([0.5, 3.0, 4.0, 0.3])
    lib, forces = library(build()), np.empty(x.size, np.float32)
    lib.shim_render(
        (ctypes.c_double * 7)(0, N, 1000, *map(float, row)), None, None, x.ctypes.data_as(ctypes.c_void_p),
        ctypes.c_size_t(x.size), forces.ctypes.data_as(ctypes.c_void_p),
    )  # fmt: skip
    expected = np.asarray(viscoelastic.FOSLS(*row.astype(float), N=N).simulate(x.astype(float)))
    assert np.max(np.abs(forces - expected)) <= 1e-5 * np.max(np.abs(expected))


@pytest.mark.parametrize("alpha", [0.01, 0.05, 0.2, 0.5, 0.8, 0.95, 0.99])
@pytest.mark.parametrize("states", [8, 10, 12])
def test_the_exponentials_of_the_host_are_accepted(alpha, states):
    row = np.float32([0.44, 1.0, 3.0, alpha])
    render(library(build()), row, np.zeros(3, np.float32), states_of(row[3], states))


def test_the_exponentials_of_the_protocol_tests_are_the_hosts():
    np.testing.assert_allclose(np.transpose(EXPONENTIALS), np.stack(states_of(np.float32(0.3), 10)), rtol=1e-6)


@pytest.mark.deep
def test_every_compiler_and_optimisation_gives_the_same_bits():
    x = np.maximum(motion(2.0), 0).astype(np.float32) * STEP
    row, given = np.float32([0.44, 1.0, 3.0, 0.3]), states_of(np.float32(0.3), 10)
    renderings = set()
    for cc in filter(shutil.which, ("gcc", "clang")):
        for level in ("-O0", "-O2", "-O3"):
            lib = library(build(extra=(level,), cc=cc))
            renderings.add(render(lib, row, x).tobytes() + render(lib, row, x, given).tobytes())
    assert len(renderings) == 1
