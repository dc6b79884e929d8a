"""The core as a shared library: the same bits as the device's core, what it refuses, and what it does when calls come
late, never, twice or with a wrong time. All of it in simulated time."""

import math
import threading
from dataclasses import replace

import numpy as np
import pytest
from helpers_firmware import EXPONENTIALS
from host_runs import SOFT, Recorded, float_bits, held_for, replayed, running
from simulated import needs_device, own_cache  # noqa: F401

from hilbo.device.failures import DeviceError
from hilbo.device.local.library import Fate
from hilbo.device.local.motor import MOTOR
from hilbo.device.reasons import HoldReason, State

pytestmark = needs_device
NAN = math.nan
FULL = {"K0": 0.2, "K1": 0.5, "B1": 0.6, "alpha": 0.3, "exponentials": EXPONENTIALS}
CLOCK = 100
EXACT = replace(MOTOR, latency_us=0, delay_us=0)


def pressed(count=5000, seed=0):
    """Positions of a hand that comes, stays, trembles and goes."""
    t, rng = np.arange(count) * 1e-3, np.random.default_rng(seed)
    slow = np.sin(2 * np.pi * 0.7 * t) + 0.3 * np.sin(2 * np.pi * 2.3 * t) - 0.4
    return np.maximum(3 * slow + 0.002 * np.cumsum(rng.standard_normal(count)), -2.0)


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
