"""The safety chain, the states, and a restart at every step: what the hand can be made to feel, tick by tick."""

import numpy as np
import pytest
from helpers_firmware import CAUSES, Device, frame, pack, parameters

SET = {"K0": -3.18, "K1": 5.58, "B1": 7.88, "alpha": 0.176}
OTHER = {"K0": -2.5, "K1": 4.0, "B1": 6.0, "alpha": 0.2}
STEP, WATCHDOG, HOLD = 0.0127, 250, 20


@pytest.fixture
def pressed():
    """Running, with a force of about 2 N at 300 counts."""
    device = Device()
    device.go(SET)
    device.run(np.linspace(0, 300, 200))
    device.run([300] * 30)
    return device


def cause(device) -> str:
    return CAUSES[device.status()["hold_reason"]]


def assert_ramps_down(forces, start: float):
    """Evenly to 0 in 20 ticks, and there it stays."""
    ramp = np.float32(start) * np.arange(HOLD - 1, -1, -1) / HOLD
    np.testing.assert_allclose(forces[:HOLD], ramp, rtol=1e-6, atol=0)
    assert not np.any(forces[HOLD - 1 :])


# HOLD and ESTOP


def test_silence_of_the_host(pressed):
    pressed.beat()
    forces, flags = pressed.run([300] * 400, beating=False)
    last = np.flatnonzero(forces)[-1]
    assert last == WATCHDOG - 1 + HOLD - 2
    assert_ramps_down(forces[WATCHDOG - 1 :], forces[WATCHDOG - 2])
    assert pressed.state == "HOLD" and cause(pressed) == "WATCHDOG"
    assert not np.any(flags[: WATCHDOG - 1] & 0x40) and np.all(flags[WATCHDOG - 1 :] & 0x40)
    assert pressed.notices[-1]["state"] == 4 and pressed.notices[-1]["reason"] == 1


def test_hold_is_latched_and_cleared_only_at_zero_force(pressed):
    pressed.beat()
    pressed.run([300] * 255, beating=False)
    _, message = pressed.ask("CLEAR", boot_id=7)
    assert (message["reason"], message["ticks"]) == ("BUSY", HOLD - 6)
    pressed.beat()
    assert not np.any(pressed.run([300] * 100)[0][HOLD:]) and pressed.state == "HOLD"
    pressed.must("CLEAR", boot_id=7)
    assert pressed.state == "STOPPED" and not np.any(pressed.run([300] * 10)[0])


def test_heartbeats_every_fifty_ticks_keep_it_running(pressed):
    for _ in range(40):
        pressed.beat()
        pressed.run([300] * 50, beating=False)
    assert pressed.state == "RUNNING"


def test_one_lost_acknowledgement_does_not_trip_the_watchdog(pressed):
    """The host waits 100 ms, asks again, and beats on meanwhile."""
    data = frame("SET_PARAMS", 200, parameters(OTHER, 2))
    for attempt in range(2):
        pressed.feed(data)
        answer = pressed.drain()
        if attempt == 0:
            for _ in range(2):
                pressed.beat()
                pressed.run([300] * 50, beating=False)
    assert answer and pressed.state == "RUNNING"


def test_without_heartbeats_even_a_talking_host_is_silent(pressed):
    for _ in range(30):
        pressed.status()
        pressed.run([300] * 10, beating=False)
    assert pressed.state == "HOLD" and cause(pressed) == "WATCHDOG"


def test_estop_is_zero_at_the_next_tick_and_latched(pressed):
    assert pressed.tick(300) > 1
    pressed.must("ESTOP")
    assert pressed.tick(300) == 0
    assert pressed.flags >= {"estop", "contact"} and pressed.state == "ESTOP" and cause(pressed) == "ESTOP"
    pressed.beat()
    assert not np.any(pressed.run([300] * 300)[0])
    assert pressed.status()["estops"] == 1
    pressed.must("CLEAR", boot_id=7)
    assert pressed.state == "STOPPED"


def test_estop_in_the_middle_of_a_ramp(pressed):
    pressed.must("STOP")
    assert pressed.tick(300) > 0
    pressed.must("ESTOP")
    assert pressed.tick(300) == 0


def test_stop_ramps_down_and_starts_again(pressed):
    before = pressed.tick(300)
    pressed.must("STOP")
    forces, _ = pressed.run([300] * 40)
    assert_ramps_down(forces, before)
    assert pressed.state == "STOPPED"


@pytest.mark.parametrize(
    ("bad", "valid"),
    [([5000] * 3, True), ([-1600] * 3, True), ([300 + 158, 300 + 320, 300 + 480], True), ([300] * 3, False)],
    ids=["beyond the stroke", "before it", "implausible steps", "no number"],
)
def test_three_bad_positions_hold_and_fewer_are_bridged(pressed, bad, valid):
    for number in (1, 2):
        held = pressed.status()["input_held"]
        for counts in bad[:number]:
            pressed.tick(counts, valid=valid)
            assert "held" in pressed.flags
        pressed.beat()
        pressed.tick(300)
        status = pressed.status()
        assert (status["state"], status["input_held"]) == (1, held + number)
        assert status["position_mm"] == np.float32(300) * np.float32(STEP)
        pressed.run([300] * 40)
    before = pressed.tick(300)
    forces = [pressed.tick(counts, valid=valid) for counts in bad]
    assert pressed.state == "HOLD" and cause(pressed) == "INPUT"
    assert forces[2] == pytest.approx(forces[1] * 19 / 20, rel=1e-6) and abs(forces[0] - before) < 0.1


def test_a_large_but_plausible_step_over_a_gap(pressed):
    """0.9 mm in a tick is too much for the velocity limit only if it took one tick."""
    pressed.tick(300, valid=False)
    pressed.tick(370)
    pressed.tick(440, valid=False)
    pressed.tick(580, valid=False)
    pressed.tick(580)
    assert pressed.state == "RUNNING"


def test_after_a_lost_input_any_position_is_a_new_beginning(pressed):
    for _ in range(3):
        pressed.tick(0, valid=False)
    pressed.tick(4000)
    assert "held" not in pressed.flags and pressed.status()["position_mm"] == pytest.approx(50.8)


def test_too_fast(pressed):
    step = int(1000 / 1000 / STEP)  # 78 counts are 990.6 mm/s
    pressed.tick(300 + step)
    assert pressed.state == "RUNNING"
    pressed.beat()
    pressed.tick(300 + 2 * step + 1)
    assert pressed.state == "HOLD" and cause(pressed) == "VELOCITY"


def test_too_fast_is_no_matter_while_stopped():
    device = Device()
    device.run(np.arange(0, 4000, 120))
    assert device.state == "STOPPED" and device.status()["holds"] == 0


def test_an_overrun(pressed):
    pressed.tick(300, overrun=True)
    assert pressed.state == "HOLD" and cause(pressed) == "OVERRUN"
    assert (pressed.status()["overruns"], pressed.status()["holds"]) == (1, 1)


def test_saturation_is_at_the_smaller_limit_and_flagged():
    for set_limit, device_limit in ((1.5, 40.0), (30.0, 1.5)):
        device = Device(force_limit=device_limit)
        device.go(SET | {"force_limit": min(set_limit, device_limit)})
        forces, flags = device.run(np.linspace(0, 600, 400))
        assert forces.max() == np.float32(1.5)
        np.testing.assert_array_equal((flags & 4) > 0, forces == np.float32(1.5))
        assert device.status()["saturated"] == np.count_nonzero(flags & 4) > 50


def test_the_slew_limit_is_kept_and_flagged():
    device = Device(slew=100.0)
    device.go(SET)
    forces, flags = device.run(np.r_[np.zeros(5), np.linspace(0, 600, 40), np.full(100, 600), np.linspace(600, 0, 60)])
    assert np.max(np.diff(forces)) <= 0.1 + np.spacing(forces.max())  # the rounding of one addition
    assert np.min(np.diff(forces)) < -0.2  # falls with its model
    assert np.count_nonzero(flags & 8) == device.status()["slewed"] > 50


def test_a_drive_begins_with_no_energy_of_an_earlier_touch():
    device = Device()
    device.go(SET)
    device.run(np.r_[np.linspace(0, 300, 200), np.linspace(300, 0, 200)])
    assert device.status()["energy_mJ"] > 0.1
    device.must("STOP")
    device.run([0] * 25)
    device.beat()
    device.must("DRIVE", mode=0, offset=0.0, duration_ticks=50, boot_id=7)
    assert device.status()["energy_mJ"] == 0


def test_each_sample_says_whether_a_set_is_rendered():
    device = Device()
    device.go(SET)
    _, flags = device.run([0] * 5)
    assert np.all(flags & 256)
    device.must("STOP")
    _, flags = device.run([0] * 5)
    assert not np.any(flags & 256)


def test_force_only_pushes_and_follows_contact():
    device = Device()
    device.run([-200] * 3)
    device.go(SET)
    x = np.r_[np.linspace(-200, 400, 300), np.linspace(400, -200, 60), np.full(300, -200)]
    forces, flags = device.run(x)
    assert np.all(forces >= 0) and not np.any(forces[x.astype(int) <= 0])
    np.testing.assert_array_equal(flags & 1 > 0, x.astype(int) > 0)
    assert device.state == "RUNNING"


def test_start_in_contact_is_refused_and_out_of_contact_it_is_not():
    """A force that begins on a handle in the material gives energy that the hand has not put in: 80 mJ were seen."""
    device = Device(slew=200.0)
    staged = device.stage(SET)
    device.confirm("COMMIT", staged)
    for counts in (1, 300):
        device.run(np.linspace(0, counts, 200))
        device.beat()
        assert device.confirm("START", staged)[1]["reason"] == "IN_CONTACT" and device.state == "STOPPED"
    device.run(np.linspace(300, 0, 200))
    assert device.confirm("START", staged)[0] == "ACK"


def test_nothing_starts_before_a_position_is_known():
    """The first one may be deep in the material."""
    device = Device()
    staged = device.stage(SET)
    device.confirm("COMMIT", staged)
    device.hello_said = False  # so that this host waits for no tick
    device.beat()
    assert device.confirm("START", staged)[1]["reason"] == "NO_INPUT"
    assert device.refusal("DRIVE", offset=1.0, duration_ticks=9, boot_id=7) == "NO_INPUT"


# The line


def test_a_heartbeat_is_as_old_as_the_tick_that_came_back(pressed):
    """Nothing is lost on the line and its delay grows: force ends `watchdog_ticks` after the tick last heard."""
    heard = pressed.status()["tick"]
    for _ in range(30):
        pressed.feed(frame("HEARTBEAT", 0, pack("HEARTBEAT", boot_id=7, tick=heard)))
        pressed.run([300] * 10, beating=False)
    assert pressed.state == "HOLD" and cause(pressed) == "WATCHDOG"
    pressed.collect()
    assert pressed.notices[-1]["tick"] == heard + WATCHDOG


def test_a_heartbeat_from_the_future_feeds_nothing(pressed):
    pressed.beat()
    pressed.run([300] * 200, beating=False)
    tick = pressed.status()["tick"] + 1
    pressed.feed(frame("HEARTBEAT", 0, pack("HEARTBEAT", boot_id=7, tick=tick)))
    pressed.run([300] * 60, beating=False)
    assert pressed.state == "HOLD"


def test_a_pulse_answers_each_heartbeat(pressed):
    pressed.collect()
    pressed.pulses.clear()
    pressed.beat()
    pressed.collect()
    (pulse,) = pressed.pulses
    assert (pulse["tick"], pulse["boot_id"], pulse["state"], pulse["stops"]) == (pressed.status()["tick"], 7, 1, 0)


# The board


def test_a_hardware_stop_is_an_estop_of_its_own_cause(pressed):
    press = pressed.lib.shim_tick_of_board
    assert press(pressed.memory, 300, 0, 1) == 0 and pressed.state == "ESTOP" and cause(pressed) == "SWITCH"
    stops = pressed.stops
    assert press(pressed.memory, 300, 0, 1) == 0 and pressed.stops == stops and pressed.status()["flags"] & 2
    assert pressed.refusal("CLEAR", boot_id=7) == "STOP_OPEN"
    press(pressed.memory, 300, 0, 0)
    pressed.must("CLEAR", boot_id=7)
    assert pressed.state == "STOPPED"


def test_each_opening_of_the_hardware_stop_is_a_stop_of_its_own(pressed):
    press = pressed.lib.shim_tick_of_board
    press(pressed.memory, 300, 0, 1)
    press(pressed.memory, 300, 0, 0)
    clear = pressed.packed("CLEAR", boot_id=7)  # of the first opening
    press(pressed.memory, 300, 0, 1)
    press(pressed.memory, 300, 0, 0)
    assert pressed.refusal("CLEAR", clear) == "STALE" and pressed.state == "ESTOP"


def test_a_tick_later_than_the_device_s_delay_holds():
    device = Device(delay_us=300)
    staged = device.stage(SET)  # needs 1.0 N.s/m at this delay, which 256 frequencies tell
    device.run([0] * 130)
    assert device.confirm("COMMIT", staged)[1]["reason"] == "NOT_PASSIVE"
    assert device.status()["staging"] == 0 and device.status()["active_id"] == 0
    device = Device(delay_us=300, damping=2.0)
    staged = device.stage(SET)
    device.run([0] * 130)
    device.beat()
    for name in ("COMMIT", "START"):
        assert device.confirm(name, staged)[0] == "ACK"
    late = device.lib.shim_tick_of_board
    for _ in range(5):
        late(device.memory, 0, 300, 0)
    assert device.state == "RUNNING"
    late(device.memory, 0, 301, 0)
    assert device.state == "HOLD" and cause(device) == "OVERRUN" and device.status()["overruns"] == 1


def test_a_motor_that_would_get_too_hot_lets_go():
    """The mean square over a second: 4 N are more than 3 N bear, and as long as the average takes it lasts."""
    device = Device(continuous_force=3.0, heating=1.0)
    device.go({"K0": 0.8, "K1": 1.0, "B1": 0.01, "alpha": 0.2})
    device.run(np.linspace(0, 400, 400))
    _, flags = device.run([400] * 3000)
    held = np.flatnonzero(flags & 64)[0]
    assert device.state == "HOLD" and cause(device) == "HEAT" and 400 < held < 2000


def test_a_device_that_is_not_homed_renders_nothing():
    device = Device(capabilities=3)
    device.config["capabilities"] = 11
    device.boot(7)
    device.hello()
    staged = device.stage(SET)
    device.confirm("COMMIT", staged)
    device.hello_said = False  # so that this host waits for no tick
    assert device.refusal("HOME", boot_id=7, position_mm=0.0) == "NO_INPUT"  # of a position that nobody knows yet
    device.run([7000] * 5)  # an encoder counts from anywhere
    device.beat()
    assert device.status()["flags"] == 0 and device.status()["position_mm"] == 0
    assert device.confirm("START", staged)[1]["reason"] == "NOT_HOMED"
    assert device.refusal("DRIVE", mode=1, offset=1.0, duration_ticks=9, boot_id=7) == "NOT_HOMED"
    for position, limit in ((61.0, 60.0), (-21.0, -20.0)):
        _, message = device.ask("HOME", boot_id=7, position_mm=position)
        assert (message["reason"], message["value"], message["limit"]) == ("DRIVE_RANGE", position, limit)
    assert device.refusal("HOME", boot_id=7, position_mm=float("nan")) == "NOT_FINITE"
    device.must("HOME", boot_id=7, position_mm=-1.27)
    device.tick(7000)
    assert device.status()["flags"] == 1 and device.status()["position_mm"] == np.float32(-100 * np.float32(STEP))
    assert device.confirm("START", staged)[0] == "ACK"
    forces, _ = device.run(7000 + np.linspace(0, 300, 300))
    assert not np.any(forces[:99]) and np.all(forces[110:] > 0)


def incremental():
    """A device that waits for HOME."""
    device = Device()
    device.config["capabilities"] = 11
    device.boot(7)
    device.hello()
    device.tick(0)
    return device


def test_a_home_acts_once():
    """Again, after another request and a move of the handle, it would hide that the handle is in the material."""
    device = incremental()
    home = device.packed("HOME", boot_id=7, position_mm=0.0)
    assert device.ask("HOME", home)[0] == "ACK"
    device.must("STREAM", divisor=0, fields=0)
    device.run(np.linspace(0, 500, 100))
    assert device.refusal("HOME", home) == "STALE" and device.status()["contact"] == 1


@pytest.mark.parametrize("end", [-20.0, 60.0])
def test_a_home_at_the_end_of_the_stroke_is_within_it(end):
    """The nearest count may be outside, where every position would be bad input."""
    device = incremental()
    device.must("HOME", boot_id=7, position_mm=end)
    device.run([0] * 5)
    assert device.status()["input_held"] == 0
    assert device.status()["position_mm"] == pytest.approx(end, abs=STEP)


def test_a_lost_input_ends_the_knowledge_of_the_surface():
    device = incremental()
    device.must("HOME", boot_id=7, position_mm=-1.0)
    for _ in range(5):
        device.tick(0, valid=False)
    device.tick(0)
    assert device.status()["flags"] == 0
    absolute = Device()
    for _ in range(5):
        absolute.tick(0, valid=False)
    assert absolute.status()["flags"] == 1


@pytest.mark.parametrize("changes", [1, 2])
def test_what_was_felt_before_a_home_is_forgotten_in_both_banks(changes):
    """The surface is elsewhere now: a history at the old one would be felt as a force of the past."""
    device, fresh = Device(), Device()
    for each in (device, fresh):
        staged = each.go(SET, 1)
        for set_id in range(2, changes + 1):
            staged = each.stage(SET, set_id)
            each.confirm("COMMIT", staged)
    device.run(np.r_[np.linspace(0, 300, 100), np.full(100, 300)])
    device.must("STOP")
    device.run([300] * 25)
    device.must("HOME", boot_id=7, position_mm=-0.127)
    fresh.must("STOP")
    fresh.run([0] * 25)
    fresh.must("HOME", boot_id=7, position_mm=-0.127)
    press = np.linspace(0, 200, 60)
    forces = []
    for each, start in ((device, 300), (fresh, 0)):
        each.tick(start)
        each.beat()
        assert each.confirm("START", staged)[0] == "ACK"
        forces.append(each.run(start + press)[0])
    np.testing.assert_array_equal(*forces)
    assert forces[0].max() > 1


def test_a_nudge_ends_where_the_handle_has_moved():
    device = Device(capabilities=3, slew=1e5)
    device.config["capabilities"] = 11
    device.boot(7)
    device.hello()
    device.tick(50)
    device.beat()
    nudge = {"mode": 0, "shape": 3, "offset": 0.5, "amplitude": 0.254, "duration_ticks": 200, "boot_id": 7}
    device.must("DRIVE", **nudge)
    forces, _ = device.run([50] * 10 + [60] * 5 + [70] * 30)
    assert np.all(forces[:15] == -0.5) and device.state == "STOPPED" and not np.any(forces[15:])  # without a ramp
    assert device.refusal("DRIVE", **(nudge | {"amplitude": 0.0})) == "DRIVE_RANGE"


# Energy


def test_the_observer_reports_the_work_of_a_touch():
    device = Device()
    device.go(SET)
    x = np.round(200 * (1 - np.cos(np.arange(500) * 2 * np.pi / 500))).astype(int)
    for touch in range(2):
        forces, _ = device.run(x)
        work = np.sum(np.r_[0, forces[:-1]] * np.diff(np.r_[0, x])) * STEP
        assert work > 0.5
        assert device.status()["energy_mJ"] == pytest.approx(work, rel=1e-3)
        device.run(np.full(300 * touch, 0))


def test_the_passivity_controller_acts_where_the_config_switches_it_on():
    """A sampled spring gives energy to a quick hand; the controller keeps what it gave near 0."""
    x = np.round(200 - 100 * np.cos(2 * np.pi * 20 * np.arange(1000) / 1000)).astype(int)
    balance, acted = {}, {}
    for capabilities in (0, 4):
        device = Device(capabilities=capabilities)
        device.go({"K0": 1.8, "K1": 0.5, "B1": 0.001, "alpha": 0.2})
        _, flags = device.run(np.r_[np.linspace(1, 100, 30), x])
        balance[capabilities], acted[capabilities] = device.status()["energy_mJ"], np.count_nonzero(flags & 16)
        assert device.status()["controlled"] == acted[capabilities]
    quiet = Device(capabilities=4)
    quiet.go(SET)
    assert not np.any(quiet.run(np.linspace(0, 300, 200))[1] & 16)  # a hand that presses takes nothing
    assert balance[0] < -3 and acted[0] == 0
    assert balance[4] > -1 and acted[4] > 20


# DRIVE


def test_drive_force_triangle():
    device = Device(slew=1e5)
    device.beat()
    device.must("DRIVE", mode=0, shape=1, offset=1.0, amplitude=2.0, period_ticks=40, duration_ticks=100, boot_id=7)
    forces, flags = device.run([0] * 130)
    phase = np.arange(100) % 40
    wave = np.interp(phase, [0, 10, 30, 40], [0, 1, -1, 0])
    np.testing.assert_allclose(forces[:99], -(1 + 2 * wave)[:99], atol=1e-5)  # inwards is negative
    assert (
        np.all(flags[:99] & 512)
        and not np.any(flags[99:] & 512)
        and device.state == "STOPPED"
        and not np.any(forces[99 + HOLD :])
    )
    assert [notice["state"] for notice in device.notices][-3:] == [3, 2, 0]


def test_drive_step_is_creep_with_recovery():
    device = Device(slew=1e5)
    device.beat()
    device.must("DRIVE", mode=0, shape=2, offset=3.0, amplitude=0.5, period_ticks=30, duration_ticks=50, boot_id=7)
    forces, _ = device.run([0] * 49)
    assert list(forces) == [-3.0] * 30 + [-0.5] * 19


def driven(device, stiffness, friction, offset, ticks, **shape):
    """Positions (mm) of a handle of 0.3 kg on a spring (N/mm), with the device's damping and Coulomb friction (N), that
    the servo drives."""
    device.beat()
    device.must("DRIVE", mode=1, offset=offset, duration_ticks=ticks + 100, boot_id=7, **shape)
    x = v = force = 0.0
    trace = []
    for _ in range(ticks):
        pull = -force - stiffness * x - 0.95e-3 * v
        rubbed = v + pull / 0.3  # mm/s, after a tick of 1 ms
        v = np.sign(rubbed) * max(0.0, abs(rubbed) - friction / 0.3)
        x += 1e-3 * v
        device.beat()
        force = device.tick(round(x / STEP))
        trace.append(x)
    return np.array(trace)


def test_drive_position_reaches_its_goal_without_a_hold():
    device = Device(velocity=500.0)
    trace = driven(device, 0.8, 0.0, 5.0, 2900)
    assert device.state == "DRIVING"
    assert abs(np.mean(trace[-200:]) - 5.0) < 0.03 and max(trace) < 6.5


@pytest.mark.parametrize(("stiffness", "friction"), [(0.0, 2.0), (0.0, 4.0), (7.0, 0.5), (0.3, 3.0)])
def test_a_handle_that_moves_is_not_taken_for_stuck(stiffness, friction):
    device = Device(velocity=500.0)
    driven(device, stiffness, friction, 5.0, 1500)
    assert device.state == "DRIVING"
    device = Device(velocity=500.0)
    driven(device, stiffness, friction, 0.0, 1500, shape=1, amplitude=4.0, period_ticks=1000)
    assert device.state == "DRIVING"


def test_a_drive_that_sees_no_movement_lets_go():
    """An encoder whose cable is off gives one count for ever, which is a good position in every other respect."""
    rng = np.random.default_rng(0)
    for _ in range(40):
        counts, offset = rng.integers(-100, 500), rng.choice([-1, 1]) * rng.uniform(9.0, 15.0)
        step, speed = rng.integers(0, 2), rng.uniform(10.0, 100.0)
        device = Device(servo_speed=speed)
        device.run([counts] * 3)
        device.beat()
        device.must("DRIVE", mode=1, offset=offset, duration_ticks=3000, boot_id=7)
        forces, _ = device.run(counts + step * (np.arange(1500) % 2))  # the last digit may flicker
        assert device.state == "HOLD" and cause(device) == "INPUT"
        assert np.flatnonzero(forces)[-1] < 700 and np.abs(forces).max() < 15.0
        device.beat()
        device.must("CLEAR", boot_id=7)


def test_drive_falls_silent_with_the_host():
    device = Device()
    device.beat()
    device.must("DRIVE", mode=0, offset=3.0, duration_ticks=1000, boot_id=7)
    device.beat()
    forces, _ = device.run([0] * 400, beating=False)
    assert np.flatnonzero(forces)[-1] == WATCHDOG - 1 + HOLD - 2 and device.state == "HOLD"


def test_a_drive_that_runs_away_lets_go_at_three_times_the_servo_s_speed():
    """A force on a free handle of 0.3 kg met the stop at 464 mm/s, with the velocity limit at 1,000."""
    device = Device()
    device.beat()
    device.must("DRIVE", mode=0, offset=3.0, duration_ticks=1000, boot_id=7)
    x = v = force = fastest = 0.0
    for _ in range(200):
        v += -force / 0.3  # mm/s in a tick
        x += 1e-3 * v
        device.beat()
        force = device.tick(round(x / STEP))
        fastest = max(fastest, v if force else 0.0)
    assert device.state == "HOLD" and cause(device) == "VELOCITY" and 290 < fastest < 420


# Restart


def test_a_restart_at_every_step_renders_nothing_that_was_not_confirmed_to_this_start():
    """The host's next words reach a device that has just begun anew: only HELLO and SET_PARAMS do something."""
    old = Device(boot_id=7)
    identity = dict(zip(("set_id", "crc"), old.stage(SET), strict=True)) | {"boot_id": 7}
    words = [
        frame("SET_PARAMS", 2, parameters(SET)),
        frame("HEARTBEAT", 0, pack("HEARTBEAT", boot_id=7)),
        frame("COMMIT", 3, pack("COMMIT", **identity)),
        frame("HEARTBEAT", 0, pack("HEARTBEAT", boot_id=7)),
        frame("START", 4, pack("START", **identity)),
    ]
    stream = b"".join(words)
    for at in range(len(stream) + 1):  # also in the middle of a frame
        for greeted in (False, True):
            device = Device(boot_id=7)
            device.feed(stream[:at])
            device.run([100] * 5, beating=False)
            device.boot(8)
            if greeted:
                device.hello()
            device.feed(stream[at:])
            device.feed(stream)  # and all of it once more
            forces, _ = device.run([200] * 300)
            assert not np.any(forces)
            device.feed(b"\0")
            status = device.status()
            assert (status["state"], status["active_id"], status["boot_id"]) == (0, 0, 8)


def test_counters_stay_at_their_largest():
    device = Device()
    forces, _ = device.run([5000] * 70_000)
    assert device.status()["input_held"] == 65535 and not np.any(forces)
