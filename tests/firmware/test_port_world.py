"""The simulated world behind the ports: actuator, finger and material against closed forms and `viscoelastic`."""

import subprocess

import numpy as np
import pytest
from device_port import FOAM, program

from hilbo.viscoelastic import FOSLS

STEP = 0.0127  # mm, encoder
FREE = ("--finger", "none", "--start", "0")


def world(force_N, *options):
    """Counts, position (mm), velocity (mm/s) and sensed force (N) after each tick."""
    lines = "".join(f"{force:.17g}\n" for force in force_N)
    run = subprocess.run([program("hilbo-world"), *options], input=lines, capture_output=True, text=True, check=True)
    return np.array([line.split() for line in run.stdout.splitlines()], float).T


def test_a_free_actuator_follows_its_differential_equation():
    b, m, force = 0.95, 0.3, 0.01  # N.s/m, kg, N
    _, x, v, sensed = world(np.full(800, force), *FREE, "--coulomb", "0")
    t = 1e-3 * np.arange(1, 801)
    end = 1e3 * force / b  # mm/s
    np.testing.assert_allclose(v, end * -np.expm1(-b / m * t), rtol=2e-4)
    np.testing.assert_allclose(x, end * (t + m / b * np.expm1(-b / m * t)), rtol=2e-4, atol=1e-4)
    assert not sensed.any()


def test_friction_holds_below_its_force_and_takes_it_off_above():
    assert not world(np.full(100, 0.019), *FREE, "--coulomb", "0.02")[1].any()
    slow = world(np.full(300, 0.03), *FREE, "--coulomb", "0.02")[1]
    np.testing.assert_allclose(slow, world(np.full(300, 0.01), *FREE, "--coulomb", "0")[1], rtol=1e-12)
    stopping = world(np.r_[np.full(100, 0.1), np.zeros(2000)], *FREE, "--coulomb", "0.02")[2]
    assert stopping[99] > 20 and stopping[-1] == 0 and (stopping >= 0).all()


def test_the_encoder_rounds_and_the_stops_stop():
    counts, x, v, _ = world(np.r_[np.full(500, 5.0), np.full(800, -5.0)], *FREE)
    np.testing.assert_array_equal(counts, np.rint(x / STEP))
    assert (x.min(), x.max()) == (-5, 20)
    assert v[x == 20][1:-1].max() == 0


@pytest.mark.parametrize("taps", [101, *(pytest.param(taps, marks=pytest.mark.deep) for taps in (1, 25))])
def test_a_material_is_the_sampled_model_at_the_ticks(taps):
    force = np.r_[np.full(300, 3.0), np.full(300, 0.5), np.zeros(200), 2 + 2 * np.sin(np.arange(600) / 30)]
    options = ("--start", "-0.2", "--material", ",".join(map(str, (*FOAM, taps))))
    _, x, _, sensed = world(force, *options)
    # Where the handle has left the material, its surface goes on with no force on it: what presses is its own path.
    surface = np.maximum(x, 0)
    model = FOSLS(*FOAM, N=taps)
    K = float(model.instantaneous_stiffness())
    for n in np.flatnonzero(sensed == 0):
        free = surface[n] - float(model.simulate(np.r_[surface[: n + 1], np.zeros(x.size - n - 1)])[n]) / K
        surface[n] = max(surface[n], free)
    expected = np.asarray(model.simulate(surface))
    np.testing.assert_allclose(-sensed, np.maximum(expected, 0), rtol=0, atol=1e-9 * expected.max())
    assert (x > 0.5).any() and (x < 0).any()


def test_noise_belongs_to_the_sensor_and_to_the_seed():
    force = np.full(4000, 0.5)
    options = ("--material", "1,5,5,0.3,11")
    _, x, _, clean = world(force, *options)
    _, same_x, _, noisy = world(force, *options, "--noise", "0.1", "--seed", "3")
    np.testing.assert_array_equal(x, same_x)
    noise = noisy - clean
    assert abs(noise.mean()) < 4 * 0.1 / np.sqrt(4000)
    assert abs(noise.std() / 0.1 - 1) < 4 / np.sqrt(8000)
    np.testing.assert_array_equal(world(force, *options, "--noise", "0.1", "--seed", "3")[3], noisy)
    assert (world(force, *options, "--noise", "0.1", "--seed", "4")[3] != noisy).all()


@pytest.mark.parametrize("finger", ["ramp", "hold", "sine", "tap", "all"])
def test_a_finger_presses_and_is_never_jerky(finger):
    still = np.zeros(6000)
    _, x, v, sensed = world(still, "--finger", finger, "--seed", "1")
    np.testing.assert_array_equal(world(still, "--finger", finger, "--seed", "1")[1], x)
    assert (world(still, "--finger", finger, "--seed", "2")[1][1000:] != x[1000:]).any()
    assert 2 < x.max() < 10 and np.abs(v).max() < 400
    assert np.abs(np.diff(v)).max() < 30  # mm/s a tick: 30 m/s² would be 9 N
    away = x < 0
    assert away.any() and ((finger in ("hold", "sine")) == (not away[3000:].any()))
    np.testing.assert_allclose(np.diff(v, prepend=0) * 0.3 + 0.95 * v * 1e-3, sensed, atol=0.2)


def test_a_resting_finger_rests():
    _, x, v, sensed = world(np.zeros(500), "--finger", "rest")
    assert (x == -1).all() and not v.any() and not sensed.any()


@pytest.mark.parametrize(
    "options",
    [
        ("--seed",),
        ("--seed", "-1"),
        ("--seed", "1x"),
        ("--damping", "nan"),
        ("--damping", "-1"),
        ("--mass", "0"),
        ("--finger", "thumb"),
        ("--depth", "3,2"),
        ("--hand", "1,2"),
        ("--material", "1,2,3,0.5,0"),
        ("--material", "1,2,3,1,101"),
        ("--material", "1,2,3,0.5,2.5"),
        ("--material", "1,2,3,0.5,1e300"),
        ("--rate", "often"),
        ("--boot-id", "0"),
        ("--line-rate", "0"),
        ("--finger-print", "1"),
        ("left over",),
    ],
)
def test_an_option_without_sense_is_refused_in_one_sentence(options):
    run = subprocess.run([program("hilbo-device"), *options], capture_output=True, text=True, input="")
    assert run.returncode == 2 and run.stdout == ""
    assert run.stderr.count("\n") == 1 and options[0] in run.stderr
