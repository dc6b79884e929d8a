"""The core as a shared library: the same bits as the device's core, what it refuses, and what it does when calls come
late, never, twice or with a wrong time. All of it in simulated time."""

import math
import subprocess
import threading
from dataclasses import replace

import numpy as np
import pytest
from device_port import COMPILERS, FIRMWARE, program
from helpers_firmware import EXPONENTIALS
from host_runs import Recorded, float_bits, replayed
from simulated import needs_device, own_cache  # noqa: F401

from hilbo.device.failures import DeviceError
from hilbo.device.library import Fate, HostRenderer, K0_of
from hilbo.device.motor import MOTOR
from hilbo.device.reasons import HoldReason, State
from hilbo.errors import InputError

pytestmark = needs_device
NAN = math.nan
SOFT = {"K0": 0.1, "K1": 0.6, "B1": 0.5, "alpha": 0.3}
FULL = {"K0": 0.2, "K1": 0.5, "B1": 0.6, "alpha": 0.3, "exponentials": EXPONENTIALS}
TOO_STIFF = {"K0": 0.1, "K1": 30.0, "B1": 30.0, "alpha": 0.3}
CLOCK = 100
EXACT = replace(MOTOR, latency_us=0, delay_us=0)


def pressed(count=5000, seed=0):
    """Positions of a hand that comes, stays, trembles and goes."""
    t, rng = np.arange(count) * 1e-3, np.random.default_rng(seed)
    slow = np.sin(2 * np.pi * 0.7 * t) + 0.3 * np.sin(2 * np.pi * 2.3 * t) - 0.4
    return np.maximum(3 * slow + 0.002 * np.cumsum(rng.standard_normal(count)), -2.0)


def running(numbers=MOTOR, model=SOFT, at_mm=2.0, ticks=100):
    """A renderer in contact."""
    run = Recorded(numbers)
    run.go(**model)
    run.follow(np.linspace(-1, at_mm, 100))
    run.follow([at_mm] * ticks)
    assert run.state.state == State.RUNNING and run.state.force_N > 0.3
    return run


def held_for(run, cause):
    now = run.state
    return (now.state, now.cause) == (State.HOLD, cause)


@pytest.mark.parametrize("model", [SOFT, FULL], ids=["short", "full"])
@pytest.mark.parametrize("controller", [False, True])
def test_forces_have_the_bits_of_the_device(model, controller):
    numbers = replace(MOTOR, passivity_controller=controller)
    run = Recorded(numbers)
    run.go(**model)
    hand = pressed()
    forces = run.follow(hand[:2600])
    run.set(**SOFT | {"K1": 0.5})  # in contact or not: it is committed when its history is warm
    forces += run.follow(hand[2600:4900])
    run.order("stop")
    run.follow(hand[4900:])
    assert run.state.set == Fate.IN_FORCE and run.state.state == State.STOPPED
    ticks = [row.force_N for row in run.rows if row.kind == "tick"]
    assert float_bits(replayed(run.rows, numbers)) == float_bits(ticks)
    assert max(forces) > 1 and min(forces) == 0


@pytest.mark.parametrize("missed", [1, 4, 9, 10, 11, 30, 999, 10**8])
def test_a_gap_ramps_down_by_the_time_that_has_passed(missed):
    run = running()
    before = run.state.force_N
    force = run.tick(2.0, after_s=(missed + 1) * 1e-3)
    left = max(0.0, 1 - (missed + 1) / MOTOR.hold_ticks)
    assert force == pytest.approx(left * before, rel=1e-6) and (left or force == 0)
    assert held_for(run, HoldReason.OVERRUN) and run.state.missed == missed
    assert run.follow([2.0] * 20)[-1] == 0
    ticks = [row.force_N for row in run.rows if row.kind == "tick"]
    assert float_bits(replayed(run.rows, MOTOR)) == float_bits(ticks)


def test_after_a_gap_it_goes_on_when_told_and_out_of_contact():
    run = running()
    run.tick(2.0, after_s=1.0)
    run.order("clear")
    run.order("beat")
    run.tick(2.0)
    with pytest.raises(DeviceError, match="handle is in the material"):
        run.renderer.start(run.state.stops)
    run.follow(np.linspace(2, -1, 100))
    run.order("start")
    assert max(run.follow(np.linspace(-1, 2, 100))) > 0.3


def test_jitter_within_the_delay_changes_no_force_and_beyond_it_holds():
    even, uneven = running(), running()
    rng = np.random.default_rng(0)
    late, wanted = 0.0, 2 + np.sin(0.01 * np.arange(1000))
    uneven.order("beat")
    for position in wanted:  # calls up to 0.9 ms after they are due
        shift, late = -late, rng.uniform(0, 0.0009)
        if uneven.state.ticks % 50 == 0:
            uneven.order("beat")
        uneven.tick(float(position), after_s=1e-3 + shift + late)
    even.follow(wanted)
    ticks = [[row.force_N for row in run.rows if row.kind == "tick"] for run in (even, uneven)]
    assert ticks[0] == ticks[1] and uneven.state.state == State.RUNNING
    assert 500 < uneven.state.latest_us <= 950 and uneven.state.missed == 0
    late_one = running()
    late_one.tick(2.0, after_s=1e-3 + 0.00096)  # and 50 us of latency
    assert held_for(late_one, HoldReason.OVERRUN) and late_one.state.missed == 0


@pytest.mark.parametrize("phase", [0.1, 0.3, 0.5, 0.7, 0.9])
def test_after_a_late_call_the_schedule_is_that_of_the_others(phase):
    run = running(replace(MOTOR, delay_us=200))
    run.tick(2.0, after_s=(3 + phase) * 1e-3)
    run.tick(2.0, after_s=(1 - phase) * 1e-3)
    run.follow(np.linspace(2, -1, 100))
    run.order("clear")
    run.order("start")
    run.follow([-1.0] * 1000)
    assert run.state.state == State.RUNNING and run.state.late_us < 10


@pytest.mark.parametrize("slower", [-1e-3, 0.0, 4e-4])
def test_a_clock_that_differs_a_little_is_followed(slower):
    run = running()
    for _ in range(100):
        run.order("beat")
        for _ in range(50):
            run.tick(2.0, after_s=1e-3 * (1 + slower))
    assert run.state.state == State.RUNNING and run.state.latest_us < 10


@pytest.mark.parametrize("slower", [0.002, 0.05, 0.5])
def test_a_loop_of_another_rate_is_a_hold(slower):
    run = running()
    for _ in range(1500):
        run.renderer.heartbeat()
        run.tick(2.0, after_s=1e-3 * (1 + slower))
    assert held_for(run, HoldReason.OVERRUN)


def test_a_faster_loop_ticks_at_the_rate_and_gets_the_last_force_between():
    run = running()
    before, forces = run.state.ticks, []
    for k in range(4000):
        if k % 100 == 0:
            run.order("beat")
        forces.append(run.tick(2.0 + 1e-4 * k, after_s=0.25e-3))
    now = run.state
    assert abs(now.ticks - before - 1000) <= 3 and now.early + now.ticks - before == 4000
    assert now.state == State.RUNNING and now.missed == 0 and len(set(forces)) <= 1003
    ticks = [row.force_N for row in run.rows if row.kind == "tick"]
    assert float_bits(replayed(run.rows, MOTOR)) == float_bits(ticks)


@pytest.mark.parametrize("wrong", ["again", "back", "nan", "inf", "slow"])
def test_a_wrong_time_is_no_force_and_an_estop(wrong):
    run = running()
    time_s = {"again": run.time_s, "back": run.time_s - 1, "nan": NAN, "inf": math.inf}.get(wrong)
    if time_s is None:  # as if microseconds were given for milliseconds
        forces = [run.tick(2.0, after_s=1e-6) for _ in range(120)]
        assert 0 in forces
    else:
        assert run.renderer.tick(2.0, NAN, time_s) == 0
    now = run.state
    assert (now.state, now.cause) == (State.ESTOP, CLOCK) and "times of the ticks" in run.renderer.why()
    run.tick(2.0)
    run.order("clear")
    run.follow(np.linspace(2, -1, 100))
    run.order("start")  # a new schedule has begun
    assert run.tick(-1.0) == 0 and run.state.state == State.RUNNING
    run.renderer.estop()
    assert run.state.cause == HoldReason.ESTOP


def test_a_position_that_is_no_number_is_bad_input():
    run = running()
    assert run.tick(NAN) > 0  # one is held
    assert run.state.input_held == 1
    for position in (math.inf, -math.inf, 1e300):
        run.tick(position)
    assert held_for(run, HoldReason.INPUT)
    ticks = [row.force_N for row in run.rows if row.kind == "tick"]
    assert float_bits(replayed(run.rows, MOTOR)) == float_bits(ticks)


@pytest.mark.parametrize("velocity", [1001.0, -1001.0, math.inf])
def test_a_velocity_that_is_given_counts(velocity):
    run = running()
    assert run.tick(2.0, velocity=999.0) > 0 and run.state.state == State.RUNNING
    before = run.state.force_N
    force = run.tick(2.0, velocity=velocity)
    assert held_for(run, HoldReason.VELOCITY) and force == pytest.approx(0.9 * before)
    assert run.follow([2.0] * 9)[-1] == 0 and run.state.holds == 1


def test_positions_that_are_too_fast_hold_where_no_velocity_is_given():
    run = running(at_mm=4.0)
    run.tick(2.5)
    assert held_for(run, HoldReason.VELOCITY)


def test_without_heartbeats_it_holds():
    run = running()
    run.order("beat")
    for _ in range(MOTOR.watchdog_ticks - 1):
        run.tick(2.0)
    assert run.state.state == State.RUNNING
    run.tick(2.0)
    assert held_for(run, HoldReason.WATCHDOG)


def test_estop_of_another_thread_is_zero_at_the_next_call():
    run = running()
    thread = threading.Thread(target=run.renderer.estop)
    thread.start()
    thread.join()
    assert run.renderer.tick(2.0, NAN, run.time_s + 1e-4) == 0  # a call before the tick is due, too
    run.time_s += 1e-4
    assert run.tick(2.0) == 0 and run.state.cause == HoldReason.ESTOP
    stops = run.state.stops
    run.renderer.estop()
    with pytest.raises(DeviceError, match="There has been a stop since"):
        run.renderer.clear(stops)


def test_start_is_refused_until_the_newest_set_is_in_force():
    run = Recorded(MOTOR)
    run.order("beat")
    run.tick(-1.0)
    with pytest.raises(DeviceError, match="There is no set in force"):
        run.renderer.start(run.state.stops)
    run.set(**SOFT)
    with pytest.raises(DeviceError, match="needs up to 128 more ticks"):
        run.renderer.start(run.state.stops)
    run.follow([-1.0] * 130)
    with pytest.raises(InputError, match=r"needs 1\d.* N.s/m of damping and the device has 0.95"):
        run.renderer.set(**TOO_STIFF)
    with pytest.raises(DeviceError, match="newest set was refused"):
        run.renderer.start(run.state.stops)
    run.set(**SOFT)
    run.follow([-1.0] * 130)
    with pytest.raises(DeviceError, match="There has been a stop since"):
        run.renderer.start(run.state.stops - 1)
    for _ in range(260):
        run.tick(-1.0)
    with pytest.raises(DeviceError, match="no heartbeat for too long"):
        run.renderer.start(run.state.stops)


def test_a_set_that_the_delay_makes_active_is_refused_when_it_has_been_checked():
    run = Recorded(replace(MOTOR, damping_N_s_per_m=0.5))
    run.set(K0=0.0, K1=0.55, B1=0.5, alpha=0.3)
    run.follow([-1.0] * 130)
    assert run.state.set == Fate.REFUSED and "N.s/m of damping and the device has 0.5" in run.renderer.sentence()
    without = Recorded(replace(EXACT, damping_N_s_per_m=0.5))
    without.go(K0=0.0, K1=0.55, B1=0.5, alpha=0.3)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"K0": 65.0}, "K0 is 65 N/mm, beyond the device's limit of 64"),
        ({"K1": 1e-4}, "K1 is 0.0001 N/mm, beyond the device's limit of 0.001"),
        ({"B1": 100.0}, "B1 is 100 N.s.alpha/mm, beyond the device's limit of 64"),
        ({"alpha": 0.999}, "alpha is 0.999, beyond the device's limit of 0.995"),
        ({"alpha": NAN}, "not finite"),
        ({"K0": 1e300}, "not finite"),
        ({"N": 100}, "N is even"),
        ({"N": 257}, "has length 257, the device takes 1 to 255"),
        ({"N": 0}, "has length 0, the device takes 1 to 255"),
        ({"N": 10**6}, "has length 65535, the device takes 1 to 255"),
        ({"K0": -5.0}, r"static stiffness H\(1\) is -4\.\d+ N/mm"),
        ({"force_limit": 21.0}, "force limit is 21 N; the device allows above 0 and up to 20"),
        ({"exponentials": EXPONENTIALS[:5]}, "exponentials of full memory are out of range or order"),
        ({"exponentials": EXPONENTIALS * 2}, "a set has at most 12"),
    ],
)
def test_sets_are_refused_in_a_sentence(changed, words):
    with HostRenderer(MOTOR) as renderer, pytest.raises(InputError, match=words):
        renderer.set(**SOFT | changed)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"simulated": False, "delay_us": 0, "latency_us": 0}, "above 0 on a device that is not simulated"),
        ({"latency_us": 1001}, "at most one period|at least latency_us"),
        ({"delay_us": 1001}, "at most one period"),
        ({"tick_rate_Hz": 99}, "tick_rate_Hz must be 100 to 10000"),
        ({"tick_rate_Hz": 70_000}, "tick_rate_Hz must be 100 to 10000"),
        ({"damping_N_s_per_m": NAN}, "damping must be 0.001 to 1000"),
        ({"force_limit_N": 101.0}, "force limit at most 100 N"),
        ({"position_high_mm": 33.0}, "within 32767 steps"),
        ({"continuous_force_N": 21.0}, "continuous_force_N must be above 0"),
        ({"K1_N_per_mm": (0.0, 1.0)}, "Each parameter range"),
        ({"watchdog_ticks": -1}, "must be at least 0"),
    ],
)
def test_numbers_of_a_device_are_refused_in_a_sentence(changed, words):
    with pytest.raises(InputError, match=words):
        HostRenderer(replace(MOTOR, **changed))


def test_two_renderers_know_nothing_of_each_other():
    first, second = running(), running(model=SOFT | {"K0": 0.2})
    assert first.state.force_N != second.state.force_N
    first.order("stop")
    assert (first.state.state, second.state.state) == (State.STOPPING, State.RUNNING)


def test_orders_of_other_threads_do_no_harm():
    run, ended = running(EXACT), threading.Event()

    def pester():
        while not ended.is_set():
            run.renderer.heartbeat()
            run.renderer.state()
            run.renderer.sentence()

    threads = [threading.Thread(target=pester) for _ in range(3)]
    for thread in threads:
        thread.start()
    forces = run.follow(2.0 + 1e-4 * np.arange(1000))
    ended.set()
    for thread in threads:
        thread.join()
    assert run.state.state == State.RUNNING and min(forces) > 0


@pytest.mark.parametrize(("N", "alpha"), [(1, 0.5), (25, 0.2), (101, 0.3), (255, 0.9)])
def test_k0_of_an_effective_stiffness(N, alpha):
    pot = 3.0 * 1e-3**-alpha * np.prod(1 - alpha / np.arange(1, N + 1))
    wanted = 0.44 - 5.0 * pot / (5.0 + pot)
    assert K0_of(K_eff=0.44, K1=5.0, B1=3.0, alpha=alpha, N=N) == pytest.approx(wanted, abs=1e-5)


NORMAL = """
#include "hilbo_renderer.h"
#include <cmath>
int main() {
  const double normal[3] = {0.0, 0.6, 0.8}, surface[3] = {1.0, 2.0, 3.0}, velocity[3] = {9.0, -6.0, -8.0};
  const double at[3] = {5.0, 2.0 - 0.6 * 2.5, 3.0 - 0.8 * 2.5};
  double force[3];
  hilbo_force_vector(2.0, normal, force);
  const bool right = std::fabs(hilbo_penetration_mm(at, surface, normal) - 2.5) < 1e-12 &&
                     std::fabs(hilbo_speed_mm_per_s(velocity, normal) - 10.0) < 1e-12 && force[0] == 0.0 &&
                     force[1] == 1.2 && force[2] == 1.6;
  const char *why = nullptr;
  hilbo_device_numbers numbers = hilbo_device_numbers();
  return right && hilbo_open(&numbers, &why) == nullptr && why[0] == 'T' ? 0 : 1;
}
"""


@pytest.mark.deep
@pytest.mark.parametrize("compiler", COMPILERS)
def test_the_header_is_c_plus_plus_and_the_geometry_right(compiler, tmp_path):
    library = program("libhilbo_renderer.so", compiler)
    (tmp_path / "normal.cpp").write_text(NORMAL)
    command = ["g++", "-std=c++11", "-Wall", "-Wextra", "-pedantic", "-Werror", f"-I{FIRMWARE}/port/library"]
    command += [str(tmp_path / "normal.cpp"), str(library), f"-Wl,-rpath,{library.parent}", "-o", str(tmp_path / "run")]
    subprocess.run(command, check=True)
    assert subprocess.run([str(tmp_path / "run")]).returncode == 0
    listed = subprocess.run(["nm", "-D", "--defined-only", str(library)], capture_output=True, text=True, check=True)
    assert all(line.split()[-1].startswith("hilbo_") for line in listed.stdout.splitlines())
