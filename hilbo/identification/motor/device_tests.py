"""Automatic tests of a device: self-test of the line, measurement of its damping, and tests of a material.

Time is counted in ticks of the device. Drives are positive inwards, towards the material, and so is `sensed_N`;
`force_N` is positive outwards (firmware/PROTOCOL.md, "Signs"). Units: mm, N, s.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from hilbo.device.reasons import HoldReason, SampleFlag, held_because, meaning
from hilbo.device.telemetry import Samples, joined
from hilbo.errors import InputError
from hilbo.hardware_bridge import Capability, DeviceError, Renderer, State
from hilbo.identification.motor.friction import Friction, friction, sweeps
from hilbo.identification.motor.pressing import Pressed, pressed, table_of

__all__ = ["CutShortError", "SelfTest", "characterise", "drive", "measure_damping", "selftest", "wait_until"]

_SWEEPS = 24  # back-and-forth sweeps
_SLOWEST, _FASTEST = 10.0, 55.0  # mm/s
_SETTLE = 0.12  # s after each turn
_SPREAD = 0.01  # relative range of depth and loads over the repeats
_FREE = 0.1  # N, largest mean sensor force without contact
_TIMEOUT = 2.0  # s, timeout for immediate actions


class CutShortError(DeviceError):
    """A measurement ended early; `table` has the data of the `repeats` that were complete."""

    def __init__(self, words: str, table: Any, repeats: int):
        super().__init__(words)
        self.table, self.repeats = table, repeats


class SelfTest(NamedTuple):
    """Results of the self-test.

    `echoes` of `asked` loopback messages returned intact; round trip in ms (median, 99th percentile); `watchdog_ticks`
    from the last heartbeat to HOLD, `watchdog_limit` the configured value; `force_after_N`: force after the ramp.
    `delay_us`: longest time from when a tick was due until its force was output, measured by the device;
    `delay_limit_us`: the delay for which it checks sets.
    """

    asked: int
    echoes: int
    median_ms: float
    p99_ms: float
    retries: int
    dropped: int
    watchdog_ticks: int
    watchdog_limit: int
    force_after_N: float
    delay_us: int
    delay_limit_us: int


def wait_until(device: Renderer, done: Callable[[], Any], what: str, seconds: float = _TIMEOUT) -> Any:
    """Poll `done` until its value is true and return it; `DeviceError` after `seconds`.

    `what` completes the sentence "The device has not ... within".
    """
    give_up = device.link.now() + seconds
    while not (value := done()):
        if device.link.now() > give_up:
            raise DeviceError(f"The device has not {what} within {seconds:g} s; check it, then try again.")
        device.link.pause(0.005)
    return value


def drive(device: Renderer, mode: Any, shape: Any, offset: float, amplitude: float = 0.0, **times: Any) -> Samples:
    """Perform a drive (a motion by the device itself), wait until it has stopped, and return its samples.

    `times`: `duration` and `period` (s) of `Renderer.drive`, the former required. Samples received earlier are
    discarded. Raises `DeviceError` if the drive ends early.
    """
    device.samples(0.0)
    device.drive(mode, shape, offset, amplitude, **times)
    begun, arrived = device.status().tick, [device.samples(times["duration"])]
    while not _ended(arrived[-1], begun):
        arrived.append(device.samples(0.05))
    wait_until(device, lambda: device.state() != State.STOPPING, "stopped")
    samples = joined(arrived)
    driving = (samples.flags & SampleFlag.DRIVING) != 0
    if driving.sum() * device.divisor < round(times["duration"] / device.tick_s) - device.divisor:
        status = device.status()
        raise DeviceError(
            f"The device has ended its drive early, now {meaning(State, status.state)}:"
            f" {held_because(status.hold_reason)}; nothing of it is used."
        )
    return Samples(*(column[driving] for column in samples))


def _ended(samples: Samples, begun: int) -> bool:
    """Whether the last sample comes after the drive that began at or just after the tick `begun` (modulo 2^32)."""
    if samples.flags.size == 0 or samples.flags[-1] & SampleFlag.DRIVING:
        return False
    return 2 < (int(samples.tick[-1]) - begun) % 2**32 < 2**31


def measure_damping(device: Renderer, say: Callable[[str], None], seed: int = 0) -> Friction:
    """Measure damping, Coulomb friction and mass of the free device by triangular sweeps at 24 speeds.

    Nothing may touch the handle. `say` receives progress messages; `seed` of the order of the speeds and of the
    bootstrap. Raises `InputError` if the stroke is too short, `DeviceError` if something touches the handle, if no
    friction law fits, and if the line does not carry every tick, since the mean force needs all of them.
    """
    if device.divisor > 1:
        raise DeviceError(
            f"{device.link.name}: the line carries every {device.divisor}th tick, and damping needs all of them; use a"
            " faster line (--baud, and the device's own rate)."
        )
    limits, rng = device.device, np.random.default_rng(seed)
    low, high = limits.position_low_mm, limits.position_high_mm
    middle, most, measured = (low + high) / 2, 0.3 * (high - low), []
    fastest = min(_FASTEST, 0.2 * limits.velocity_limit_mm_per_s, 0.7 * most / _SETTLE)
    # All periods differ, since errors of encoder and servo recur at equal speed.
    for count, speed in enumerate(rng.permutation(np.geomspace(min(_SLOWEST, fastest / 4), fastest, _SWEEPS))):
        say(f"sweep {count + 1} of {_SWEEPS}: {speed:.0f} mm/s")
        reach = most * rng.uniform(0.8, 1.0)
        period = round(4 * reach / speed, 3)
        samples = drive(device, "position", "triangle", middle, reach, period=period, duration=1.25 * period + 0.02)
        if np.mean(np.abs(samples.sensed_N)) > _FREE:  # false without a sensor
            raise DeviceError("Something touches the handle; take it away, damping is measured on the free device.")
        tick = device.tick_s * device.divisor
        measured += sweeps(samples.position_mm, -samples.force_N, tick, period, _SETTLE, count)
    return friction(measured, seed)


def characterise(
    device: Renderer,
    say: Callable[[str], None],
    *,
    repeats: int = 16,
    depth: float = 5.0,
    force: float = 3.0,
    after: float = 0.5,
    hold: float = 3.0,
    rest: float = 2.0,
    seed: int = 0,
) -> Any:
    """Run the paper's relaxation (`depth` mm held) and creep (`force` N, then `after` N) on the material at position 0.

    `hold`: duration (s) of the relaxation and of each half of the creep. Returns the DataFrame that `hilbo identify`
    reads: test, repeat, time_s, position_mm, force_N. Each test begins off the material and at rest; between tests it
    recovers for `rest` s. Depth and loads vary by up to half a per cent from repeat to repeat, so that the encoder's
    rounding averages out. Raises `InputError` for numbers that are not above 0, and `DeviceError`; once a repeat is
    complete, faults and Ctrl-C raise `CutShortError` with the data so far.
    """
    step, low = device.device.encoder_step_mm, device.device.position_low_mm
    if not (repeats >= 1 and depth > 0 and force > 0 and after >= 0 and hold > 0 and rest > 0):  # nor is any NaN
        raise InputError("Repeats, depth, force, hold and rest must be above 0, and after 0 or above.")
    off_material = max(low / 2, -1.0)
    spread = 1 + _SPREAD * (np.random.default_rng(seed).permutation(repeats) + 0.5 - repeats / 2) / repeats
    last = {"relaxation": hold, "creep": 2 * hold}
    presses: dict[str, list[Pressed]] = {"relaxation": [], "creep": []}

    try:
        for repeat, scale in enumerate(spread, 1):
            say(f"relaxation {repeat} of {repeats}")
            drive_kind = "position", "hold", depth * scale
            relaxation = _pressed(device, "relaxation", off_material, rest, *drive_kind, duration=hold + 0.5)
            say(f"creep {repeat} of {repeats}")
            drive_kind = "force", "step", force * scale, after * scale
            creep = _pressed(device, "creep", -step, rest, *drive_kind, period=hold, duration=2 * hold + 0.1)
            presses["relaxation"].append(relaxation)
            presses["creep"].append(creep)
        drive(device, "position", "hold", off_material, duration=0.5)
    except (DeviceError, KeyboardInterrupt) as error:
        complete = len(presses["creep"])
        if not complete:
            raise
        words = str(error) or "It was ended from the keyboard."
        raise CutShortError(words, table_of(presses, last, device.tick_s * device.divisor), complete) from error
    return table_of(presses, last, device.tick_s * device.divisor)


def _pressed(device: Renderer, kind: str, before: float, rest: float, *motion: Any, **times: float) -> Pressed:
    """Run one test of a `kind` with the drive `motion` and `times`, after `rest` s at the position `before` (mm)."""
    free = drive(device, "position", "hold", before, duration=rest)
    return pressed(drive(device, *motion, **times), kind, bool(device.can & Capability.FORCE_SENSOR), _noise(free))


def _noise(free: Samples) -> float:
    """Standard deviation of the sensor's force (N) off the material, over the second half of those samples; else 0.

    0 without a sensor and without such samples.
    """
    off = free.sensed_N[free.position_mm <= 0]
    return float(np.std(off[off.size // 2 :])) if off.size and not np.isnan(off).any() else 0.0


def selftest(device: Renderer, say: Callable[[str], None], echoes: int = 300) -> SelfTest:
    """Test the loopback of messages of every byte and length (`echoes` of them), the round-trip time, and the watchdog.

    The device drives with 0 N, goes into HOLD, and is cleared again. `say` receives progress messages. Raises
    `InputError` for a device that cannot drive, and `DeviceError` for one that fails otherwise.
    """
    say("loopback")
    rng, intact = np.random.default_rng(0), 0
    device.link.round_trips.clear()
    for n in range(echoes):
        sent = bytes(range(4 * (n % 65), 4 * (n % 65) + n % 65 % 4)) if n < 65 else rng.bytes(n % 65)
        intact += device.echo(sent) == sent
    times = np.array(device.link.round_trips) * 1e3
    say("watchdog")
    ticks, force = _watchdog(device)
    return SelfTest(
        echoes,
        intact,
        float(np.median(times)),
        float(np.quantile(times, 0.99)),
        device.link.retries,
        device.link.dropped,
        ticks,
        device.device.watchdog_ticks,
        force,
        device.status().delay_us,
        round(device.delay * 1e6),
    )


def _watchdog(device: Renderer) -> tuple[int, float]:
    """Stop the heartbeat in a drive of 0 N: ticks from the last heartbeat to HOLD, and the force (N) after the ramp.

    Clears the HOLD afterwards. Raises `InputError` for a device that cannot drive, and `DeviceError` for a HOLD of
    another reason or none.
    """
    if not device.can & Capability.DRIVE:
        raise InputError(
            "This device cannot move by itself, and its watchdog is not tested; start a set, then pull the plug."
        )
    device.drive("force", "hold", 0.0, duration=5.0)
    wait_until(device, lambda: device.state() == State.DRIVING, "begun to drive")
    with device.link.silence():
        last = device.status().tick  # earlier heartbeats have arrived by now
        wait_until(device, lambda: device.state() == State.HOLD, "let go without heartbeats")
    status = device.status()
    if status.hold_reason != HoldReason.WATCHDOG:
        raise DeviceError(f"The device is in HOLD, but {held_because(status.hold_reason)}; check that first.")
    notice = next(n for n in reversed(device.link.notices) if n.state == State.HOLD)
    wait_until(device, lambda: device.status().tick > notice.tick + device.device.hold_ticks, "gone on")
    force = device.status().force_N
    device.clear()
    return notice.tick - last, force
