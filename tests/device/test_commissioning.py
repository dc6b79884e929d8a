"""Commissioning against simulated devices whose wiring, encoder, friction or delay is not as it should be."""

from dataclasses import replace

import numpy as np
import pytest
from simulated import needs_device, own_cache  # noqa: F401

from hilbo.device import messages
from hilbo.device.link import Link
from hilbo.errors import InputError
from hilbo.hardware_bridge import DeviceError, Renderer, State
from hilbo.identification.motor import commissioning
from hilbo.identification.motor.commissioning import Bounds, commission, damping_for, delay_for, find_signs
from hilbo.identification.motor.friction import Friction, Interval

pytestmark = needs_device

NEW = {"rate": "lockstep", "finger": "none", "not_homed": True}
START = -1.0  # mm, where the simulated handle stands at the start


def quiet(_words):
    """Says nothing."""


class Someone:
    """A person who pushes the handle in, lets go, and knows where it stands."""

    def __init__(self, device):
        self.device, self.calls = device, []

    def encoder_checked(self):
        self.calls.append("push")
        self.device.simulator.tell("finger hold")
        return False

    def take_hands_off(self):
        self.calls.append("off")
        self.device.simulator.tell("finger none")

    def place(self, _moved):
        self.calls.append("place")
        return START + self.device.status().position_mm


class Nobody(Someone):
    """A person who says that the encoder is right, and touches nothing."""

    def encoder_checked(self):
        return True


@pytest.fixture
def recorded(monkeypatch):
    """All telemetry that is read, and the orders to drive, of every device in the test."""
    seen, drives, samples, drive = [], [], Renderer.samples, Renderer.drive

    def reading(self, seconds=1.0):
        seen.append(samples(self, seconds))
        return seen[-1]

    def driving(self, *way, **times):
        drives.append(way)
        return drive(self, *way, **times)

    monkeypatch.setattr(Renderer, "samples", reading)
    monkeypatch.setattr(Renderer, "drive", driving)
    return seen, drives


def energies(seen, mass, inverted):
    """Motor work and largest kinetic energy of the handle, mJ, from positions and forces of every tick."""
    position, force = (np.concatenate([getattr(piece, name) for piece in seen]) for name in ("position_mm", "force_N"))
    inwards = force if inverted else -force
    work = np.cumsum(inwards[:-1] * np.diff(position))
    velocity = (position[8:] - position[:-8]) / 8e-3 / 1e3  # m/s
    return work.max(), 0.5 * mass * np.max(velocity**2) * 1e3


@pytest.mark.parametrize("mass", [0.05, 0.3, 1.0])
@pytest.mark.parametrize("coulomb", [0.0, 0.02, 0.5])
def test_a_motor_that_is_wired_the_other_way_is_pushed_once_with_little_energy(recorded, mass, coulomb):
    bounds = Bounds()
    options = NEW | {"inverted": True, "mass": mass, "coulomb": coulomb}
    with Renderer.open("sim", options=options) as device:
        with pytest.raises(DeviceError, match=r"the motor pushes the wrong way: .* swap the motor's two wires"):
            find_signs(device, quiet, bounds)
        after = device.samples(0.2)
        assert device.state() == State.ESTOP and not after.force_N.any()
    seen, drives = recorded
    work, kinetic = energies(seen, mass, True)
    assert 0 < work <= bounds.work_mJ and kinetic <= bounds.work_mJ
    forces = [way[2] for way in drives]
    assert all(force > 0 for force in forces) and (len(forces) == 1 or coulomb > bounds.first_N)


@pytest.fixture
def measured(monkeypatch):
    """The measurement of damping, of some seconds, is left out."""
    friction = Friction(Interval(0.95, 0.94, 0.96), *(Interval(0.3, 0.2, 0.4),) * 3, 0.01, 96, 24)
    monkeypatch.setattr(commissioning, "measure_damping", lambda *_: friction)


@pytest.mark.deep
def test_the_measurement_takes_its_place_in_the_order(recorded):
    with Renderer.open("sim", options=NEW) as device:
        result = commission(device, Someone(device), quiet)
    assert result.friction.damping.lower <= 0.95 <= result.friction.damping.upper
    assert list(dict.fromkeys(way[0] for way in recorded[1])) == ["force", "position"]


def test_a_script_learns_how_far_the_nudges_have_moved_the_handle(measured, monkeypatch):
    monkeypatch.setattr(commissioning, "find_signs", lambda *way: (commissioning._nudge(way[0], 0.3, way[2]),))
    with Renderer.open("sim", options=NEW) as device:
        moved = []
        person = Nobody(device)
        person.place = lambda by: moved.append((by, device.status().position_mm)) or START + by
        commission(device, person, quiet)
        by, position = moved[0]  # the device counts from where it started
        assert by == pytest.approx(position, abs=1e-4) and by > 0.2
        assert device.status().position_mm == pytest.approx(START + by, abs=0.0127)


@pytest.mark.parametrize("coulomb", [0.02, 1.0])
def test_a_device_in_order_is_commissioned(recorded, measured, coulomb):
    with Renderer.open("sim", options=NEW | {"coulomb": coulomb, "delay": 150}) as device:
        person = Someone(device)
        result = commission(device, person, quiet)
        assert device.condition().homed and device.state() == State.STOPPED
    assert person.calls == ["push", "off", "place", "off"]
    inwards, outwards = result.nudges
    assert inwards.force_N > 0 and inwards.moved_mm > 0 and outwards.force_N < 0 and outwards.moved_mm < 0
    assert all(0 < nudge.work_mJ <= Bounds().work_mJ and abs(nudge.force_N) > coulomb for nudge in result.nudges)
    assert (result.longest_delay_us, result.notes) == (150, ())
    assert {way[:2] for way in recorded[1]} == {("force", "nudge"), ("force", "hold")}


def test_an_encoder_that_counts_the_other_way_is_found_before_the_motor_pushes(recorded):
    with Renderer.open("sim", options=NEW | {"encoder_inverted": True}) as device:
        person = Someone(device)
        with pytest.raises(DeviceError, match=r"the encoder counts the wrong way: .* swap its channels A and B"):
            commission(device, person, quiet)
        assert device.state() == State.ESTOP
    assert person.calls == ["push"] and recorded[1] == []


def test_both_signs_wrong_are_found_though_nudges_cannot_see_it():
    options = NEW | {"encoder_inverted": True, "inverted": True}
    with Renderer.open("sim", options=options) as device:
        assert len(find_signs(device, quiet, Bounds())) == 2
        with pytest.raises(DeviceError, match="the encoder counts the wrong way"):
            commission(device, Someone(device), quiet)


def test_the_force_of_a_handle_that_does_not_move_is_raised_to_its_most(recorded):
    with Renderer.open("sim", options=NEW | {"coulomb": 5.0}) as device:
        with pytest.raises(DeviceError, match=r"the handle did not move inwards at up to 2 N; check .* --most-force"):
            find_signs(device, quiet, Bounds())
        assert device.state() == State.STOPPED
    force = np.concatenate([piece.force_N for piece in recorded[0]])
    ends = np.flatnonzero(np.diff(np.r_[0, force != 0, 0]))
    impulses = [-force[begin:end].sum() * 1e-3 for begin, end in zip(ends[::2], ends[1::2], strict=True)]
    assert len(impulses) == len(recorded[1]) and 0.012 < min(impulses) <= max(impulses) <= Bounds().impulse_N_s
    forces = [way[2] for way in recorded[1]]
    assert forces[0] == 0.3 and forces[-1] == 2.0 and np.all(np.diff(forces) > 0)


def test_a_handle_at_its_stop_is_no_wrong_sign():
    with (
        Renderer.open("sim", options=NEW | {"start": 20}) as device,
        pytest.raises(DeviceError, match=r"the handle did not move inwards .* off its mechanical stop"),
    ):
        find_signs(device, quiet, Bounds(most_N=0.5))


@pytest.mark.parametrize(
    ("fault", "options", "words"),
    [
        ("stop open", {}, "the hardware stop is open; close it"),
        ("finger sine", {}, "has not come to rest by itself"),
        (
            "late_us 300",
            {"delay": 100},
            "delay_us of 100 is too short: a force came out 400 us after its tick was due; set it to 500",
        ),
    ],
)
def test_a_device_that_is_not_ready_is_not_pushed(recorded, fault, options, words):
    with Renderer.open("sim", options=NEW | options) as device:
        person = Nobody(device)
        person.take_hands_off = lambda: None
        device.simulator.tell(fault)
        device.link.pause(0.05)
        with pytest.raises(DeviceError, match=words):
            commission(device, person, quiet)
    assert recorded[1] == []


def test_an_emergency_stop_is_cleared_by_a_person_first():
    with Renderer.open("sim", options=NEW) as device:
        device.estop()
        with pytest.raises(DeviceError, match="the device is ESTOP: the emergency stop was pressed"):
            commission(device, Nobody(device), quiet)


def test_a_hardware_stop_that_opens_within_a_nudge_ends_it(monkeypatch):
    with Renderer.open("sim", options=NEW | {"coulomb": 5.0}) as device:
        drive = device.drive

        def opens(*way, **times):
            drive(*way, **times)
            device.simulator.tell("stop open")

        device.drive = opens
        with pytest.raises(DeviceError, match="ended in ESTOP: the hardware stop is open"):
            find_signs(device, quiet, Bounds())
        assert device.condition().stop_open
        with pytest.raises(DeviceError, match="The hardware stop is open; close it, then clear"):
            device.clear()
        device.simulator.tell("stop closed")
        device.link.pause(0.01)
        device.clear()
        assert device.state() == State.STOPPED


def test_ctrl_c_within_a_nudge_stops_the_device(monkeypatch):
    def interrupted(*_arguments):
        raise KeyboardInterrupt

    requests, ask = [], Link.request

    def asking(self, message):
        requests.append(type(message))
        return ask(self, message)

    device = Renderer.open("sim", options=NEW)
    monkeypatch.setattr(Link, "request", asking)
    real = commissioning.wait_until
    waits = iter([real, interrupted])  # at rest, and for the end of the nudge
    monkeypatch.setattr(commissioning, "wait_until", lambda *arguments: next(waits)(*arguments))
    with pytest.raises(KeyboardInterrupt), device:
        find_signs(device, quiet, Bounds())
    assert messages.Drive in requests and requests[-1] is messages.Stop


def test_a_device_that_measures_no_delay_is_refused(monkeypatch):
    with Renderer.open("sim", options=NEW) as device:
        assert commissioning._longest_delay(device) == 0
        monkeypatch.setattr(Renderer, "can", property(lambda _self: 0))
        with pytest.raises(DeviceError, match="reports a delay of 0 us, which no motor has"):
            commissioning._longest_delay(device)
        with pytest.raises(DeviceError, match="cannot move by itself"):
            commission(device, Nobody(device), quiet)


def test_numbers_for_the_header_are_on_the_safe_side():
    assert [delay_for(longest) for longest in (0, 1, 150, 201, 400)] == [50, 60, 200, 260, 500]
    for lower, written in ((0.946217, 0.9462), (12.3456, 12.34), (-0.1, 0.0)):
        friction = Friction(Interval(1.0, lower, 2.0), *(Interval(0, 0, 0),) * 3, 0.0, 0, 0)
        assert damping_for(friction) == pytest.approx(written) and damping_for(friction) <= max(lower, 0)


def test_forces_stay_below_what_the_motor_bears_and_the_encoder_can_tell():
    with Renderer.open("sim", options=NEW) as device:
        assert Bounds(most_N=0.1).forces(device) == [0.1]
        most = Bounds(most_N=100.0).forces(device)[-1]
        assert most * 4 * device.device.encoder_step_mm == pytest.approx(Bounds().work_mJ)


def test_a_force_that_comes_late_ends_the_commissioning(measured):
    with Renderer.open("sim", options=NEW | {"delay": 100}) as device:
        person = Nobody(device)
        place = person.place

        def placed(moved):
            device.simulator.tell("late_us 300")  # of the tick after, in which the device homes
            return place(moved)

        person.place = placed
        person.take_hands_off = lambda: None
        with pytest.raises(DeviceError, match="delay_us of 100 is too short: a force came out 400 us after"):
            commission(device, person, quiet)


@pytest.mark.parametrize("slew", [1.0, 20.0, 500.0])
def test_a_slow_rise_of_the_force_keeps_the_impulse(monkeypatch, slew):
    with Renderer.open("sim", options=NEW) as device:
        device.device = replace(device.device, slew_limit_N_per_s=slew)
        for force in Bounds().forces(device):
            steps = np.minimum(np.arange(1, round(Bounds().lasts(force, device) * 1e3) + 1) * slew / 1e3, force)
            assert 0.7 * Bounds().impulse_N_s < steps.sum() * 1e-3 < 1.05 * Bounds().impulse_N_s


@pytest.mark.parametrize("delay", [75, 1050, "x"])
def test_a_delay_that_the_simulated_world_cannot_have_is_refused(delay):
    with pytest.raises(InputError, match=f"--delay {delay} makes no sense"):
        Renderer.open("sim", options=NEW | {"delay": delay})


def test_home_refuses_a_place_outside_of_the_stroke():
    with Renderer.open("sim", options=NEW) as device:
        assert not device.condition().homed
        with pytest.raises(InputError, match="HOME asks for 30"):
            device.home(30)
        device.home(2.5)
        assert device.condition().homed and device.status().position_mm == pytest.approx(2.5, abs=0.01)
