"""Commissioning of a device: signs of encoder and motor tested at low energy, then homing, delay and damping.

First a person pushes the handle in with the motor off, which gives the encoder's sign. Nudges (DRIVE, shape 3) then
give the motor's sign: a force that ends by itself when the handle has moved, limited by `Bounds`. The first wrong sign
ends the commissioning and latches the emergency stop, and no force is output after it. Only a device with both signs
right is homed, driven, and measured.

Positions and drives are positive inwards, into the material. Units: mm, N, s, mJ, delay in µs, damping N·s/m.
"""

import math
from collections.abc import Callable
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from hilbo.device.reasons import SampleFlag, held_because, meaning
from hilbo.hardware_bridge import Capability, DeviceError, RefusalError, Renderer, State
from hilbo.identification.motor.device_tests import drive, measure_damping, wait_until
from hilbo.identification.motor.friction import Friction

__all__ = [
    "Bounds",
    "Commissioned",
    "Nudge",
    "Person",
    "commission",
    "damping_for",
    "delay_for",
    "find_signs",
    "rounded_down",
]

_FEWEST = 2  # encoder steps of the smallest movement with a reliable direction
_STILL, _REST = 0.3, 10.0  # s without movement before a nudge, and timeout for it
_RAISE = 1.5  # factor from a force that moves nothing to the next
_BY_HAND = 1.0  # mm
_PUSH_TIMEOUT = 120.0  # s for a push by hand
_LASTS = 3.0  # s of the drive at 0 N
_WAITS = 10.0  # s for the heaviest set's history
_MARGIN, _LEAST_MARGIN, _ROUND = 0.25, 50, 10  # share, µs, µs


@runtime_checkable
class Person(Protocol):
    """Interface to the person at the device; each method returns once the person, or a script, has acted."""

    def encoder_checked(self) -> bool:
        """Return whether the encoder is known to count up into the material.

        If it is not, ask the person to push the handle in and return False at once.
        """
        ...

    def take_hands_off(self) -> None:
        """Have the person confirm that no hand is on the handle. Raises `InputError` without confirmation."""
        ...

    def place(self, moved_mm: float) -> float | None:
        """Return the handle's position (mm) as the person gives it; `moved_mm`: how far it has moved since the start.

        None for a device that is already homed.
        """
        ...


class Bounds(NamedTuple):
    """Limits of a nudge: first and largest force (N), travel (mm), motor work (mJ), and impulse (N·s).

    The device ends a nudge at half of the travel; the other half is left for the force to decay, so that the motor's
    work stays below `work_mJ`. A larger force gets less travel and less time: with an encoder that does not count, the
    push is limited by the impulse.
    """

    first_N: float = 0.3
    most_N: float = 2.0
    travel_mm: float = 0.5
    work_mJ: float = 0.15
    impulse_N_s: float = 0.015

    def reach(self, force: float) -> float:
        """Travel (mm) at which the device ends a nudge of this force (N, above 0)."""
        return min(self.travel_mm, self.work_mJ / force) / 2

    def lasts(self, force: float, device: Renderer) -> float:
        """Duration (s) for which this force (N, above 0), rising at the slew limit, has the impulse; a tick or more."""
        slew = device.device.slew_limit_N_per_s
        rise_time = force / (2 * slew)
        duration = self.impulse_N_s / force
        seconds = duration + rise_time if duration >= rise_time else math.sqrt(2 * self.impulse_N_s / slew)
        return max(math.floor(seconds / device.tick_s + 1e-6), 1) * device.tick_s

    def forces(self, device: Renderer) -> list[float]:
        """Increasing forces (N) to try, each up to 1.5 times the last, within the limits of this device.

        Those are of its motor, and of its encoder, which must detect the movement within the motor's work allowed.
        """
        motor_limit = min(device.device.force_limit_N, device.condition().continuous_force_N)
        detectable = self.work_mJ / (2 * _FEWEST * device.device.encoder_step_mm)
        most = min(self.most_N, motor_limit, detectable, self.impulse_N_s / device.tick_s)
        forces = [min(self.first_N, most)]
        while forces[-1] < most:
            forces.append(min(_RAISE * forces[-1], most))
        return forces


class Nudge(NamedTuple):
    """Result of a nudge with `force_N`: displacement and motor work (mJ).

    Force and displacement are positive inwards.
    """

    force_N: float
    moved_mm: float
    work_mJ: float


class Commissioned(NamedTuple):
    """Result of a commissioning: nudges that moved the handle, friction, longest delay (µs) measured, and notes."""

    nudges: tuple[Nudge, ...]
    friction: Friction
    longest_delay_us: int
    notes: tuple[str, ...]


def commission(
    device: Renderer, person: Person, say: Callable[[str], None], bounds: Bounds | None = None, seed: int = 0
) -> Commissioned:
    """Check the signs of a device, home it, and measure its delay, friction and damping, in this order.

    The device moves by itself, and a soft set stays active. `say` receives progress messages; `bounds` of the nudges,
    None for the default; `seed` of the order of the sweeps and of the bootstrap. Raises `DeviceError` at the first
    fault, after an emergency stop for a wrong sign, and `InputError` without the person's confirmation.
    """
    _check_ready(device)
    start_mm = device.status().position_mm
    if not person.encoder_checked():
        say("waiting for a push by hand")
        _check_encoder(device)
        start_mm = device.status().position_mm
    person.take_hands_off()
    nudges = find_signs(device, say, bounds or Bounds())
    if not device.can & Capability.HOMED_AT_BOOT:
        _home(device, person, _position_at_rest(device) - start_mm)
    say("delay")
    notes = _heaviest_set(device)
    drive(device, "force", "hold", 0.0, duration=_LASTS)
    friction = measure_damping(device, say, seed)
    return Commissioned(nudges, friction, _longest_delay(device), tuple(notes))


def _check_ready(device: Renderer) -> None:
    """Raise `DeviceError` for a device that cannot nudge, is not STOPPED, or has already exceeded its delay.

    Also if its hardware stop is open.
    """
    name, status, condition = device.link.name, device.status(), device.condition()
    if not device.can & Capability.DRIVE:
        raise DeviceError(f"{name}: this device cannot move by itself; set HB_CAN_DRIVE in its capabilities.")
    if condition.stop_open:
        raise DeviceError(f"{name}: the hardware stop is open; close it, then `hilbo device clear`.")
    if status.state != State.STOPPED:
        raise DeviceError(
            f"{name}: the device is {meaning(State, status.state)}: {held_because(status.hold_reason)}; find out why,"
            " then `hilbo device clear`."
        )
    _check_delay(device)


def _check_delay(device: Renderer) -> int:
    """Longest delay since the device's start, µs. Raises `DeviceError` if it exceeds the device's configured delay."""
    condition = device.condition()
    longest = condition.longest_delay_us
    if longest > condition.delay_us:
        raise DeviceError(
            f"{device.link.name}: the device's delay_us of {condition.delay_us} is too short: a force came out"
            f" {longest} us after its tick was due; set it to {delay_for(longest)} or more, then commission again."
        )
    return longest


def _check_encoder(device: Renderer) -> None:
    """Wait up to 120 s for a push by hand with the motor off.

    Raises `DeviceError` if the position decreases, after an emergency stop, and if nothing moves.
    """
    least_mm = max(_BY_HAND, 4 * device.device.encoder_step_mm)
    before = device.samples(0.02).position_mm[-1]

    def pushed() -> float | None:
        moved = device.samples(0.02).position_mm[-1] - before
        return moved if abs(moved) >= least_mm else None

    moved = wait_until(device, pushed, f"seen a push by hand of {least_mm:g} mm", _PUSH_TIMEOUT)
    if moved < 0:
        device.estop()
        raise DeviceError(
            f"{device.link.name}: the encoder counts the wrong way: pushed in, its position fell by {-moved:.2f} mm;"
            " swap its channels A and B, or change encoder_sign in the device's header, then commission again."
        )


def find_signs(device: Renderer, say: Callable[[str], None], bounds: Bounds) -> tuple[Nudge, ...]:
    """Nudge the handle inwards, then outwards, until it moves each way; return the two nudges that moved it.

    Raises `DeviceError` at the first wrong sign, after an emergency stop, and if the handle does not move. `say`
    receives progress messages.
    """
    return tuple(_first_that_moves(device, say, bounds, sign) for sign in (1, -1))


def _first_that_moves(device: Renderer, say: Callable[[str], None], bounds: Bounds, sign: int) -> Nudge:
    """Nudge in direction `sign` (1 inwards, -1 outwards) with increasing force until the handle moves.

    Raises `DeviceError` for a movement in the other direction, after an emergency stop, and for no movement at the
    largest force.
    """
    forces, side = bounds.forces(device), "inwards" if sign > 0 else "outwards"
    for force in forces:
        say(f"nudge of {force:.2g} N {side}")
        nudge = _nudge(device, sign * force, bounds)
        if abs(nudge.moved_mm) < _FEWEST * device.device.encoder_step_mm:
            continue
        if nudge.moved_mm * sign > 0:
            return nudge
        device.estop()
        raise DeviceError(
            f"{device.link.name}: the motor pushes the wrong way: {force:.2g} N {side} moved the handle by"
            f" {abs(nudge.moved_mm):.2f} mm the other way; swap the motor's two wires, or change motor_sign in the"
            " device's header, then commission again."
        )
    raise DeviceError(
        f"{device.link.name}: the handle did not move {side} at up to {forces[-1]:.2g} N; check the motor's supply, the"
        " amplifier's enable and the encoder's cable, move the handle off its mechanical stop, or allow more with"
        " --most-force."
    )


def _nudge(device: Renderer, force: float, bounds: Bounds) -> Nudge:
    """Perform one nudge with `force` (N, positive inwards) from rest, and wait until it has ended.

    `moved_mm` of the result is the largest displacement. Raises `DeviceError` if the device is not at rest before, not
    STOPPED after it, or sent no telemetry of it.
    """
    steps = device.device
    before = _position_at_rest(device)
    travel = max(bounds.reach(abs(force)), _FEWEST * steps.encoder_step_mm)
    device.samples(0.0)
    device.drive("force", "nudge", force, travel, duration=bounds.lasts(abs(force), device))
    wait_until(device, lambda: device.state() not in (State.DRIVING, State.STOPPING), "ended its nudge")
    samples, status = device.samples(0.05), device.status()
    if status.state != State.STOPPED:
        raise DeviceError(
            f"{device.link.name}: a nudge of {force:.2g} N ended in {meaning(State, status.state)}:"
            f" {held_because(status.hold_reason)}; find out why, then commission again."
        )
    driving = np.flatnonzero(samples.flags & SampleFlag.DRIVING)
    if not driving.size:
        raise DeviceError(f"{device.link.name}: no telemetry of the nudge has come; check the line, then try again.")
    moved = samples.position_mm[driving[0] :] - before
    work = -np.sum(samples.force_N[:-1] * np.diff(samples.position_mm))  # force_N is positive outwards
    return Nudge(force, float(moved[np.argmax(np.abs(moved))]), float(work))


def _position_at_rest(device: Renderer) -> float:
    """Wait up to 10 s until the handle is at rest and return its position (mm); `DeviceError` if it keeps moving."""
    step = device.device.encoder_step_mm

    def position() -> tuple[float] | None:
        recent = device.samples(_STILL).position_mm[-max(2, round(_STILL / device.tick_s / device.divisor)) :]
        return (float(recent[-1]),) if np.ptp(recent) <= 1.01 * step else None

    return wait_until(device, position, "come to rest by itself with its motor at rest", _REST)[0]


def _home(device: Renderer, person: Person, moved_mm: float) -> None:
    """Home the device at the position given by the person, then have hands taken off; nothing if that is None.

    `moved_mm`: how far the handle has moved since the start.
    """
    position = person.place(moved_mm)
    if position is not None:
        device.home(position)
        person.take_hands_off()


def _heaviest_set(device: Renderer) -> list[str]:
    """Send a soft set with the longest memory, to maximise the computing time of a tick; it stays active.

    Returns a list: empty, or with a note if the device refuses the set.
    """
    low = {name: ends[0] for name, ends in device.limits().items()}
    taps = device.device.most_taps - (device.device.most_taps + 1) % 2
    K1, B1, alpha = max(low["K1"], 1e-3), max(low["B1"], 1e-3), max(low["alpha"], 0.2)
    try:
        device.send(K0=0.0, K1=K1, B1=B1, alpha=alpha, N=taps, T=device.tick_s, wait=_WAITS)
    except RefusalError as error:
        return [f"The delay was measured without an active set, with which ticks take longer: {error}"]
    return []


def _longest_delay(device: Renderer) -> int:
    """Longest delay since the device's start, µs.

    Raises `DeviceError` if it exceeds the device's configured delay, and for hardware that reports 0.
    """
    longest = _check_delay(device)
    if longest == 0 and not device.can & Capability.SIMULATED:
        raise DeviceError(
            f"{device.link.name}: the device reports a delay of 0 us, which no motor has; measure it in its port"
            " (input.delay_us), then commission again."
        )
    return longest


def delay_for(longest_us: int) -> int:
    """`delay_us` for a config header: measured delay plus 25 %, at least plus 50 µs, rounded up to a multiple of 10."""
    return _ROUND * math.ceil((longest_us + max(_MARGIN * longest_us, _LEAST_MARGIN)) / _ROUND)


def damping_for(friction: Friction) -> float:
    """Damping (N·s/m) for a config header: the lower end of the interval, rounded down to four digits, or 0.

    0 where that end is not above 0.
    """
    return rounded_down(friction.damping.lower) if friction.damping.lower > 0 else 0.0


def rounded_down(value: float) -> float:
    """A number above 0, rounded down to four significant digits."""
    least = 10.0 ** (math.floor(math.log10(value)) - 3)
    return math.floor(value / least) * least
