"""Another set while the finger presses: the force goes on without a jump, and becomes that of the new set."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers_firmware import CONFIG, Device, build, library

from hilbo import passivity, viscoelastic

STAGED, LENGTH = 1500, 4000
SLEW = 200.0  # N/s: 0.2 N a tick, several times what these motions ask for
STEP = np.float32(CONFIG["step"])


def passive_sets(count: int) -> np.ndarray:
    """K0, K1, B1, alpha (float32): a quarter to all of the largest passive K1 at 0.95 N.s/m."""
    rng = np.random.default_rng(8)
    B1, alpha = (jnp.asarray(rng.uniform(low, high, 4000)) for low, high in ((0.5, 30), (0.05, 0.8)))
    limit = np.asarray(passivity.largest_K1(B1, alpha, 0.949))
    K1 = np.minimum(limit, 32) * rng.uniform(0.25, 1, 4000)
    K0 = np.asarray(viscoelastic.K0_from_effective_stiffness(jnp.asarray(K1), B1, alpha))
    rows = np.column_stack([K0, K1, B1, alpha])
    return rows[(K1 >= 1) & (limit > 1)][:count].astype(np.float32)


def motions() -> dict[str, np.ndarray]:
    """Counts, all from off the surface."""
    t = np.arange(LENGTH) / 1000
    positions = {
        "ramp": 2.0 * t - 0.2,
        "ramp and hold": np.minimum(2.5 * t - 0.2, 5.0),
        "2 Hz sine": np.minimum(20 * t, 3.0) + 1.5 * np.sin(2 * np.pi * 2 * t),
        "long hold": np.minimum(20 * t - 0.2, 5.0),
    }
    return {name: np.round(x / STEP).astype(np.int32) for name, x in positions.items()}


@eqx.filter_jit
def alone(sets, x):
    """Forces of every set on every motion, from rest, and from the equilibrium where it is staged."""

    def force(row, x):
        model = viscoelastic.FOSLS(*row)
        late = model.simulate(x[STAGED:], start="equilibrium", unilateral=True)
        return model.simulate(x, unilateral=True), late

    return jax.vmap(lambda row: jax.vmap(lambda x: force(row, x))(x))(sets)


def switch(lib, counts, old, new) -> tuple[np.ndarray, np.ndarray, int]:
    """Forces and flags along the motion, and the tick of the flip."""
    device = Device(lib=lib, slew=SLEW)
    names = ("K0", "K1", "B1", "alpha")
    device.go(dict(zip(names, old.tolist(), strict=True)))
    parts = [device.run(counts[:STAGED])]
    staged = device.stage(dict(zip(names, new.tolist(), strict=True)), 2)
    flip = STAGED + device.status()["ticks_until_ready"]
    parts.append(device.run(counts[STAGED : flip - 1]))
    assert device.confirm("COMMIT", staged)[1]["reason"] == "NOT_READY"
    parts.append(device.run(counts[flip - 1 : flip]))
    assert device.confirm("COMMIT", staged)[0] == "ACK"
    parts.append(device.run(counts[flip:]))
    status = device.status()
    assert (status["active_id"], status["slewed"], status["holds"]) == (2, 0, 0)
    return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts]), flip


@pytest.mark.parametrize("count", [5, pytest.param(20, marks=pytest.mark.deep)])
def test_all_pairs_of_passive_sets_on_four_motions(count):
    """Step per tick at most the larger of the two sets' own plus the slew limit; then the new set, to 1e-4."""
    lib, sets, fades_of = library(build()), passive_sets(count), {}
    x = np.stack([np.maximum(counts, 0) for counts in motions().values()]) * STEP.astype(float)
    first, late = (np.asarray(part) for part in alone(jnp.asarray(sets, float), jnp.asarray(x)))
    largest = 1e-4 * np.max(np.abs(first))
    for number, (name, counts) in enumerate(motions().items()):
        for old, new in itertools.permutations(range(count), 2):
            forces, flags, flip = switch(lib, counts, sets[old], sets[new])
            own, other = first[old, number], np.r_[np.zeros(STAGED), late[new, number]]
            np.testing.assert_allclose(forces[: flip + 1], own[: flip + 1], rtol=0, atol=largest)
            steps = np.maximum(np.abs(np.diff(own)), np.abs(np.diff(other)))[flip - 1 :]
            assert np.all(np.abs(np.diff(forces[flip - 1 :])) <= steps + SLEW / 1000 + largest)
            fading = np.flatnonzero(flags & 32)
            assert fading.size == 0 or (fading[0] == flip and fading.size == fading[-1] - flip + 1)
            end = flip + fading.size
            np.testing.assert_allclose(forces[end:], other[end:], rtol=0, atol=largest)
            jump = abs(own[flip] - other[flip])
            assert fading.size <= 2 + jump / (SLEW / 1000 - np.max(np.abs(np.diff(other[flip:]))))
            fades_of.setdefault(name, []).append((fading.size, jump))
    for name, fades in fades_of.items():
        ticks, jumps = np.array(fades).T
        late = f"gone after {ticks.max():.0f} ticks, median {np.median(ticks):.0f}"
        print(f"{name}: differences up to {jumps.max():.2f} N, {late}")


def test_from_above_the_limit_of_the_new_set_no_tick_rises_by_a_last_place():
    """The offset is a difference of rounded numbers, and its sum with the new force may be above the force before."""
    rng, lib = np.random.default_rng(0), library(build())
    springless = {"K0": 0.0, "K1": 1.5, "B1": 2.0, "alpha": 0.2}  # whose forces use all the bits of a float
    for limit in rng.uniform(0.5, 0.8, 100).astype(np.float32):
        device, deep = Device(lib=lib), int(rng.integers(100, 200))
        device.go(springless)
        device.run(np.linspace(0, deep, 200))
        staged = device.stage(springless | {"force_limit": float(limit)}, 2)
        still, _ = device.run(np.full(device.status()["ticks_until_ready"], deep))
        assert device.confirm("COMMIT", staged)[0] == "ACK"
        after, _ = device.run(deep + 5 * np.arange(1, 6))
        forces = np.r_[still[-1], after]
        assert np.all(forces[1:] <= np.maximum(forces[:-1], limit))


@pytest.mark.parametrize("pressed", [False, True], ids=["staged off the surface", "staged in contact"])
def test_out_of_contact_a_set_is_in_force_at_once_and_its_history_clear(pressed):
    device = Device()
    device.go({"K0": -3.18, "K1": 5.58, "B1": 7.88, "alpha": 0.176})
    new = {"K0": -2.5, "K1": 4.0, "B1": 6.0, "alpha": 0.2}
    device.run(np.linspace(0, 400, 100))
    staged = device.stage(new, 2) if pressed else None
    device.run(np.linspace(400, -10, 50))
    device.confirm("COMMIT", staged or device.stage(new, 2))
    fresh = Device()
    fresh.go(new)
    x = np.r_[np.full(3, -10), np.linspace(0, 400, 100)]
    forces, flags = device.run(x)
    np.testing.assert_array_equal(forces, fresh.run(x)[0])
    assert not np.any(flags & 32)


def test_a_set_committed_off_the_surface_and_felt_before_a_tick():
    """The finger lands on the very tick of the flip."""
    device = Device()
    device.go({"K0": -3.18, "K1": 5.58, "B1": 7.88, "alpha": 0.176})
    device.run(np.r_[np.linspace(0, 400, 300), np.linspace(390, 0, 40)])
    device.confirm("COMMIT", device.stage({"K0": -2.5, "K1": 4.0, "B1": 6.0, "alpha": 0.2}, 2))
    forces, _ = device.run([50, 50, 50])
    assert np.all(np.abs(np.diff(np.r_[0, forces])) <= 2.0)


def test_without_the_offset_the_force_would_jump():
    """At the flip the two models differ by more than the device lets through."""
    counts, (old, new) = motions()["2 Hz sine"], passive_sets(2)
    forces, _, flip = switch(library(build()), counts, old, new)
    x = np.maximum(counts, 0) * STEP.astype(float)
    sets = jnp.asarray(np.stack([old, new]), float)
    first, late = (np.asarray(part)[:, 0] for part in alone(sets, jnp.asarray(x[None])))
    assert abs(late[1, flip - STAGED] - first[0, flip - 1]) > 5 * abs(forces[flip] - forces[flip - 1])
