"""Values at a limit, counts one by one, and what one order leaves to the next: places where a core is easily wrong by
one, in ways that no motion of a hand would show."""

import ctypes

import numpy as np
import pytest
from helpers_firmware import CAUSES, EXPONENTIALS, Device, build, full_set, library, parameters

SET = {"K0": -3.18, "K1": 5.58, "B1": 7.88, "alpha": 0.176}
IDENTIFIED = {"K0": -2.89, "K1": 5.70, "B1": 5.89, "alpha": 0.203}
SOFT = {"K0": 0.2, "K1": 0.5, "B1": 0.5, "alpha": 0.5}
MARGIN = 1 + 5e-4  # HB_DELAY_MARGIN


def pressing(**changed) -> Device:
    """Running, with the handle 3.8 mm in the material."""
    device = Device(**changed)
    device.go(SET)
    device.run(np.linspace(0, 300, 200))
    device.run([300] * 30)
    return device


# Limits


@pytest.mark.parametrize(("mode", "limit"), [(0, 40.0), (0, -40.0), (1, 60.0), (1, -20.0)])
def test_a_drive_may_reach_its_limit_and_not_beyond(mode, limit):
    device = Device()
    device.beat()
    beyond = float(np.nextafter(np.float32(limit), np.float32(2 * limit)))
    assert device.ask("DRIVE", mode=mode, offset=beyond, duration_ticks=10, boot_id=7)[0] == "NACK"
    device.must("DRIVE", mode=mode, offset=limit, duration_ticks=10, boot_id=7)


@pytest.mark.parametrize(("offset", "slewed"), [(2.0, 0), (2.0001, 1)])
def test_a_change_as_large_as_the_slew_limit_is_not_slewed(offset, slewed):
    device = Device(slew=2000.0)  # 2 N a tick
    device.beat()
    device.must("DRIVE", mode=0, offset=offset, duration_ticks=10, boot_id=7)
    device.tick()
    assert device.status()["slewed"] == slewed and ("slewed" in device.flags) == bool(slewed)


def test_a_force_at_the_limit_is_not_marked_saturated():
    device = Device()
    device.beat()
    device.must("DRIVE", mode=0, offset=40.0, duration_ticks=100, boot_id=7)
    forces, flags = device.run([0] * 40)
    assert forces[-1] == -40.0 and not np.any(flags >> 2 & 1)


@pytest.mark.parametrize("end", [-20.0, 60.0])
def test_a_home_at_a_count_that_is_an_end_of_the_stroke_is_exact(end):
    device = Device(step=0.0125, capabilities=3)
    device.tick()
    before = device.stops
    device.must("HOME", boot_id=7, position_mm=end)
    device.run([0] * 3)
    status = device.status()
    assert (status["position_mm"], status["input_held"], device.stops) == (end, 0, before + 1)


def test_a_handle_at_the_velocity_limit_is_not_too_fast():
    for counts, state in ((80, "RUNNING"), (81, "HOLD")):  # 1 mm a tick is 1,000 mm/s
        device = Device(step=0.0125, velocity=1000.0)
        device.go(SET)
        device.run(counts * np.arange(3))
        assert device.state == state


def test_one_exponential_is_a_set():
    Device().go(full_set(states=[(1.0, 2 - 2**0.7)]))  # 2/(2 - loss) is 2^alpha, as the device asks


# Counts


def test_the_longest_delay_is_kept():
    device = Device(delay_us=300)
    for delay, longest in ((100, 100), (250, 250), (40, 250)):
        device.lib.shim_tick_of_board(device.memory, 0, delay, 0)
        assert device.status()["delay_us"] == longest


def test_busy_tells_the_ticks_that_are_left():
    """After a switch in contact, at 0.1 N a tick: a set is taken after as many ticks as its refusal tells."""
    device = pressing(slew=100.0)
    second = device.stage(SOFT, 2)
    device.run([300] * device.status()["ticks_until_ready"])
    assert device.confirm("COMMIT", second)[0] == "ACK"
    told = []
    while (answer := device.ask("SET_PARAMS", parameters(SET, 3)))[0] == "NACK":
        assert answer[1]["reason"] == "BUSY"
        told.append(answer[1]["ticks"])
        device.run([300])
    assert told[0] == 1 and len(told) > 3  # before the first tick it is not known what is left
    assert told[1:] == list(range(len(told) - 1, 0, -1))


def test_a_second_estop_is_no_second_emergency_but_the_switch_tells_its_cause():
    device = pressing()
    device.must("ESTOP")
    stops, estops = device.stops, device.status()["estops"]
    device.must("ESTOP")
    assert device.stops == stops + 1 and device.status()["estops"] == estops
    device.lib.shim_tick_of_board(device.memory, 300, 0, 1)
    assert CAUSES[device.status()["hold_reason"]] == "SWITCH" and device.status()["estops"] == estops + 1


def test_a_long_loss_of_the_encoder_is_forgotten_as_soon_as_a_short_one():
    """A bad position counts 10, a good one takes 1 back, and 30 are too many: more than 30 are not kept."""
    device = Device()
    staged = device.stage(SET)
    device.confirm("COMMIT", staged)
    for _ in range(40):
        device.tick(valid=False)
    device.run([0] * 15)
    device.beat()
    assert device.confirm("START", staged)[0] == "ACK"
    device.tick(valid=False)
    assert device.state == "RUNNING"


def test_a_hold_is_one_stop_and_each_has_a_ramp_of_its_own():
    device = pressing()
    for _ in range(2):
        stops = device.stops
        forces, flags = device.run([300] * 300, beating=False)  # the host falls silent
        assert device.state == "HOLD" and device.stops == stops + 1
        hold = int(np.argmax(flags >> 6 & 1))
        ramp = forces[hold - 1] * (1 - np.arange(1, 21) / 20)
        np.testing.assert_allclose(forces[hold : hold + 20], ramp, atol=1e-5)
        device.beat()
        device.must("CLEAR", boot_id=7)
        device.run([150, -5, -5])
        device.beat()
        assert device.confirm("START", (1, device.crc))[0] == "ACK"
        device.run(np.linspace(0, 300, 200))


def test_a_device_in_the_air_says_that_nothing_touches_it():
    device = Device()
    for counts, contact in ((-5, 0), (0, 0), (5, 1)):
        device.tick(counts)
        assert device.status()["contact"] == contact


def test_another_version_is_told_beside_the_device_s_own():
    device = Device(hello=False)
    kind, nack = device.ask("HELLO", version=7, schema=0)
    assert (kind, nack["reason"], nack["value"], nack["limit"]) == ("NACK", "VERSION", 7.0, 2.0)


def test_an_echo_is_whole():
    for data in (b"", b"a", bytes(range(1, 60))):
        assert Device().ask("ECHO", data) == ("ECHO_REPLY", {"payload": data})


def test_a_device_at_rest_has_no_flags_and_waits_for_nothing():
    device = Device()
    device.tick()
    assert device.flags == set() and device.status()["ticks_until_ready"] == 0


# What one order leaves to the next


@pytest.mark.parametrize("mode", [0, 1])
def test_a_drive_that_has_ended_ramps_down_from_its_force(mode):
    device = Device(velocity=500.0)
    device.beat()
    offset = 3.0 if mode == 0 else 0.5
    device.must("DRIVE", mode=mode, offset=offset, duration_ticks=40, boot_id=7)
    forces, _ = device.run([0] * 80)
    last = forces[38]
    assert last < -0.4
    np.testing.assert_allclose(forces[39:59], last * (1 - np.arange(1, 21) / 20), atol=2e-2 * abs(last))
    assert not np.any(forces[59:])


def test_another_drive_waits_for_the_end_of_the_first():
    device = Device()
    device.beat()
    device.must("DRIVE", mode=0, offset=1.0, duration_ticks=100, boot_id=7)
    device.tick()
    assert device.refusal("DRIVE", mode=0, offset=2.0, duration_ticks=100, boot_id=7) == "STATE"
    assert list(device.run([0] * 3)[0]) == [-1.0] * 3


@pytest.mark.parametrize("end", [lambda device: device.must("STOP"), lambda device: device.run([150, -5])])
def test_a_stop_and_a_hand_that_leaves_take_the_rest_of_a_switch_with_them(end):
    device = pressing(slew=50.0, velocity=1990.0)
    staged = device.stage(SOFT, 2)
    device.run([300] * device.status()["ticks_until_ready"])
    device.beat()
    assert device.confirm("COMMIT", staged)[0] == "ACK"
    device.run([300])
    assert device.offset != 0
    end(device)
    assert device.status()["holds"] == 0
    assert device.offset == 0


@pytest.mark.parametrize("commits", [1, 2])
def test_the_staged_set_is_read_from_either_bank(commits):
    device = Device()
    for number in range(commits):
        assert device.confirm("COMMIT", device.stage(SET, number + 1))[0] == "ACK"
        device.tick()
    device.stage(SOFT, 9)
    staged, in_force = device.must("GET_SET", bank=1), device.must("GET_SET", bank=0)
    assert (staged["set_id"], in_force["set_id"]) == (9, commits)
    assert staged["K1_N_per_mm"] == 0.5 and in_force["K1_N_per_mm"] == pytest.approx(5.58)


def test_a_handle_that_moved_before_it_was_stuck_is_stuck():
    device = Device(servo_speed=100.0)
    device.beat()
    device.must("DRIVE", mode=1, offset=15.0, duration_ticks=3000, boot_id=7)
    device.run(np.minimum(3 * np.arange(1500), 200))
    assert device.state == "HOLD" and CAUSES[device.status()["hold_reason"]] == "INPUT"


def test_a_handle_is_stuck_after_a_twentieth_of_a_second():
    """Of pushing with more than an eighth of the limit, more than 128 encoder steps behind its reference."""
    device = Device(servo_speed=100.0)
    device.beat()
    device.must("DRIVE", mode=1, offset=15.0, duration_ticks=3000, boot_id=7)
    behind = 0.1 * np.arange(1, 400)  # mm
    pushes = (behind > 128 * 0.0127) & (behind + 5e-3 * np.cumsum(behind) > 40.0 / 8)
    _, flags = device.run([0] * 399)
    assert int(np.argmax(flags >> 6 & 1)) == int(np.argmax(pushes)) + 49


def test_the_servo_is_a_pi_controller_with_damping():
    """Stiffness 1 N/mm, integral 5 N/(mm·s), damping 0.02 N·s/mm; the handle is pulled out of its reference at 12.7
    mm/s, and the force is below the slew limit."""
    device = Device(velocity=500.0)
    device.run([-300] * 3)
    device.beat()
    device.must("DRIVE", mode=1, offset=-300 * 0.0127, duration_ticks=1000, boot_id=7)
    moved = np.arange(1, 21)
    forces, _ = device.run(-300 - moved)
    error = moved * 0.0127
    inwards = error + 5e-3 * np.cumsum(error) + 0.02 * 12.7
    np.testing.assert_allclose(forces, -inwards, rtol=1e-3)


def test_the_servo_s_force_is_within_the_device_s_limit_and_only_there_marked():
    device = Device(force_limit=5.0, velocity=500.0)
    device.beat()
    device.must("DRIVE", mode=1, offset=50.0, duration_ticks=1000, boot_id=7)
    forces, flags = device.run(3 * (np.arange(300) % 2))  # it flickers, and is not stuck
    assert device.state == "DRIVING" and forces.min() == -5.0 and forces[-1] == -5.0
    np.testing.assert_array_equal(flags >> 2 & 1, forces == -5.0)


# Passivity at a delay


def test_a_set_that_needs_too_much_at_the_delay_says_how_much_and_leaves_nothing_behind():
    device = Device(delay_us=300)
    staged = device.stage(IDENTIFIED)
    device.run([0] * device.status()["ticks_until_ready"])
    kind, nack = device.confirm("COMMIT", staged)
    assert (kind, nack["reason"]) == ("NACK", "NOT_PASSIVE")
    assert nack["limit"] == pytest.approx(0.95) and nack["value"] > 0.95
    staged = device.stage(SOFT, 2)
    device.run([0] * device.status()["ticks_until_ready"])
    assert device.confirm("COMMIT", staged)[0] == "ACK"


@pytest.mark.parametrize("memory", ["short", "full"])
def test_the_damping_at_a_delay_is_the_largest_of_256_angles(memory):
    """Y(θ) of docs/methods/mechanics.md in float64, at the device's own angles. The largest lies in their upper half
    for sets with a negative static stiffness alone, which are refused for that."""
    rng = np.random.default_rng(3)
    lib, peaks = library(build()), []
    while len(peaks) < 300:
        K0 = rng.choice([0.44, -np.exp(rng.uniform(-2, 3))])
        K1, B1, delay = np.exp(rng.uniform(0, 4)), np.exp(rng.uniform(-6, 4)), int(rng.integers(20, 500))
        alpha, length = (0.3, len(EXPONENTIALS)) if memory == "full" else (rng.uniform(0.05, 0.95), 101)
        Y, prompt = needed(K0, K1, B1, alpha, delay, memory)
        if Y.max() < 1.01 * max(prompt, 0.1):
            continue
        numbers = (ctypes.c_double * 7)(memory == "full", length, 1000, K0, K1, B1, alpha)
        arrays = [
            np.array(part, np.float32).ctypes.data_as(ctypes.c_void_p) for part in zip(*EXPONENTIALS, strict=True)
        ]
        damping = lib.shim_delayed_damping(numbers, *arrays, ctypes.c_uint32(delay))
        assert damping == pytest.approx(0.5 * Y.max() * MARGIN, rel=2e-4)
        peaks.append(int(np.argmax(Y)))
    assert min(peaks) < 20 and max(peaks) > (128 if memory == "short" else 100), (min(peaks), max(peaks))


def needed(K0, K1, B1, alpha, delay, memory):
    """Y (N/mm) at each angle, and the largest without delay."""
    z = np.exp(1j * np.pi * np.arange(1, 257) / 256)[:, None]
    if memory == "short":
        C = z ** -np.arange(102.0) @ np.cumprod(np.r_[1, 1 - (1 + alpha) / np.arange(1, 102)])
    else:
        weight, loss = np.array(EXPONENTIALS).T
        C = np.sum(weight * (1 - 1 / z) / (1 - 1 / z + loss / z), 1)
    z, beta, sigma = z[:, 0], B1 * 1e3**alpha, delay / 1000
    H = K0 + K1 * beta * C / (K1 + beta * C)
    phi = np.real(H) - np.imag(H) / np.tan(np.angle(z) / 2)
    psi = phi + 2 * sigma * np.real(H / z)
    return (psi + np.sqrt(psi**2 + 4 * sigma * (1 - sigma) * np.abs(H) ** 2)) / 2, phi.max()
