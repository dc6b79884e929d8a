"""Interface to a rendering device: send parameter sets, start and stop it, and read force and position.

    with Renderer.open("sim") as device:                       # or a port, or "socket://host:port"
        device.send(K0=-3.18, K1=5.58, B1=7.88, alpha=0.176)   # staged, committed, read back
        device.start()
        table = device.telemetry(2.0)

The firmware has the final say: it checks every set again, with its own damping, and rejects it with a reason. It
renders only while this process sends heartbeats, and is stopped at the end of the block in every case. The active set
is read back and compared bit for bit. A device that restarts is never started again automatically. No JAX here;
firmware/PROTOCOL.md specifies the wire protocol.

Units: K N/mm, B1 N·s^α/mm, T s, mm, N, damping N·s/m.
"""

import contextlib
import math
import time
from collections.abc import Callable
from functools import partial
from typing import Any, Literal, SupportsFloat

from hilbo.device.condition import Condition, condition_of
from hilbo.device.failures import DeviceError, RefusalError
from hilbo.device.handshake import greet, take_over
from hilbo.device.link import Link
from hilbo.device.messages import (
    Clear,
    Drive,
    Echo,
    Estop,
    GetLimits,
    GetSet,
    GetStatus,
    Home,
    Start,
    Status,
    Stop,
    Stream,
)
from hilbo.device.parameter_sets import InForce, ParameterSet, in_force
from hilbo.device.ports import BAUD, list_ports, open_port
from hilbo.device.reasons import Capability, NackReason, State, held_because, meaning
from hilbo.device.staging import put_in_force, retry_while_busy
from hilbo.device.telemetry import Counts, Samples, TelemetryBuffer, joined
from hilbo.errors import InputError

__all__ = ["Capability", "DeviceError", "InForce", "ParameterSet", "RefusalError", "Renderer", "State", "list_ports"]


def __dir__() -> list[str]:
    return __all__


_ANSWER = 0.1  # s for an answer
_SIMULATED = 1.0  # s for an answer; the simulator shares this computer's CPU
_LOCKSTEP = 30.0  # s, where no time passes meanwhile
_POLL = 0.1  # s
_NEAR = 0.01  # s between two checks for contact
_SINKS = 1.0  # s, timeout for the force to decay to zero; the protocol allows 0.1
_STALLED = 20  # polls without telemetry
_SHAPES = {"hold": 0, "triangle": 1, "step": 2, "nudge": 3}


class Renderer:
    """Connected device; `device` is its description (`HelloReply`), `notes` are messages for the user.

    `damping` (N·s/m) and `delay` (s): as a study assumes, None unchecked; a device with less damping or more delay is
    refused. `simulator`: behind a simulated device, else None. Construct with `open`. Every method raises
    `RefusalError` (an `InputError`) for numbers the device refuses, and `DeviceError` when device or line fail.
    """

    def __init__(
        self,
        connect: Callable[[], Link],
        *,
        damping: SupportsFloat | None = None,
        delay: SupportsFloat | None = None,
        simulator: Any = None,
    ):
        self.notes: list[str] = []
        self.divisor = 0
        self._connect, self._damping, self._delay, self.simulator = connect, damping, delay, simulator
        self._begin()

    @classmethod
    def open(
        cls,
        where: str = "sim",
        *,
        damping: SupportsFloat | None = None,
        delay: SupportsFloat | None = None,
        baud: int = BAUD,
        patience: SupportsFloat | None = None,
        capture: Callable[[bytes], Any] | None = None,
        options: dict[str, Any] | None = None,
    ) -> "Renderer":
        """Connect to "sim", a serial port, or "socket://host:port".

        `damping` (N·s/m) and `delay` (s) are the values that a study assumes: a device with less damping, or one that
        checks its sets for a longer delay of the force, is refused. `patience` (s) is the timeout of one answer,
        default 0.1 on a line; `baud` the rate of a serial port. `capture` receives all bytes that arrive. `options` are
        those of the simulated device (`simulator.Simulator`), which `close` ends. Raises `InputError` for a line that
        cannot be opened, and for `options` of another device, and `DeviceError` if no device with this protocol
        answers.
        """
        if where == "sim":
            from hilbo.device.local.simulator import Simulator

            simulator = Simulator(**(options or {}))
        elif options:
            raise InputError(f"{where}: options are for the simulated device; use them with sim.")
        else:
            simulator = None
        waits = None if patience is None else float(patience)
        connect = partial(_connected, simulator.port if simulator else where, baud, waits, capture, simulator)
        try:
            return cls(connect, damping=damping, delay=delay, simulator=simulator)
        except BaseException:
            if simulator:
                simulator.close()
            raise

    def __enter__(self) -> "Renderer":
        return self

    def __exit__(self, kind, error, trace) -> None:
        """Call `close`. Its `DeviceError` is raised only if the block raised nothing, whose own error then follows."""
        try:
            self.close()
        except DeviceError:
            if error is None:
                raise

    def close(self) -> None:
        """Stop the device, end the connection and a simulated device. Raises `DeviceError` if the stop could not be
        sent."""
        try:
            if self._link.lost is None:
                self._link.request(Stop())
            else:
                self._link.shout(Stop())
        finally:
            self._link.close()
            if self.simulator is not None:
                self.simulator.close()

    @property
    def tick_s(self) -> float:
        """Period of the control loop, s."""
        return 1 / self.device.tick_rate_Hz

    @property
    def can(self) -> Capability:
        """Capabilities of the device."""
        return Capability(self.device.capabilities)

    @property
    def link(self) -> Link:
        """Connection to the device, with its counters."""
        return self._link

    def _begin(self) -> None:
        """Open a connection: handshake, stop of a moving device, heartbeats, telemetry. Sets `device`, and adds to
        `notes`."""
        self._link = self._connect()
        try:
            self.device = greet(self._link, self._damping, self._delay)
            self._buffer = TelemetryBuffer(self.device.encoder_step_mm)
            self._link.on_telemetry = self._buffer.add
            self.notes += take_over(self._link, self.device)
            if self._link.simulated_time:
                self._link.pause(self.tick_s)  # a device knows its position from its first tick on
            self.stream()
        except BaseException:
            self._link.close()
            raise

    def send(self, wanted: ParameterSet | None = None, /, *, wait: SupportsFloat = 5.0, **values: Any) -> InForce:
        """Activate a parameter set: stage, commit, read back and compare bit for bit.

        Either a `ParameterSet`, or its fields as `values`: K0, K1 in N/mm, B1 in N·s^α/mm, alpha, and optionally N, T
        in s, memory, states, and force_limit in N. In contact the device first fills the history of the new set; `wait`
        (s) is the timeout for that. A set that is active already is not sent again.
        Raises `InputError` for numbers that do not fit and for a set that the device refuses, `DeviceError` if the
        line fails.
        """
        messages = (ParameterSet(**values) if wanted is None else wanted).messages(self.device)
        return put_in_force(self._link, self.device, messages, float(wait))

    def in_force(self) -> InForce | None:
        """Ask the device for the active parameter set; None if there is none."""
        return in_force(self._link.request(GetSet(bank=0)))

    @property
    def delay(self) -> float:
        """Longest time (s) from the sample of a position to its force, for which the device checks its sets; asks the
        device."""
        return self._link.request(GetLimits()).delay_us * 1e-6

    def home(self, position: SupportsFloat = 0.0) -> None:
        """Tell a device without an absolute encoder that its handle is now at `position` (mm); nothing moves. Raises
        `DeviceError` while it moves, `RefusalError` for a position outside of its stroke."""
        place = {"stop": self._link.stops, "position_mm": float(position)}
        self._link.request(Home(boot_id=self.device.boot_id, **place))

    def start(self, *, stop: int | None = None, wait: SupportsFloat = 5.0) -> None:
        """Start rendering the active set. Earlier telemetry is dropped.

        `stop`: the device's count of stops that the caller has seen (`link.stops`), by default the latest one known:
        after a later stop the device refuses to start. `wait` (s): timeout for the handle to leave the material, since
        nothing is started in contact. Raises `DeviceError` if no set is active, if the handle stays in contact, and
        for other refusals.
        """
        stop = self._link.stops if stop is None else stop
        current = self.in_force()
        if current is None:
            raise DeviceError("The device has no active set; send one first.")
        self._link.heartbeat()
        self._buffer.take()
        order = {"set_id": current.set_id, "crc": current.crc, "boot_id": self.device.boot_id, "stop": stop}
        give_up = self._link.now() + float(wait)
        while True:
            try:
                self._link.request(Start(**order))
                return
            except DeviceError as error:
                if not error.in_contact or self._link.now() > give_up:
                    raise
            self._link.pause(_NEAR)

    def stop(self) -> int:
        """Ramp the force to zero, and return the device's count of stops, including this one."""
        return self._link.request(Stop()).stops

    def estop(self) -> None:
        """Emergency stop: force to zero at once, latched until `clear`."""
        self._link.request(Estop())

    def clear(self, *, stop: int | None = None) -> None:
        """Leave HOLD or ESTOP, once the reason is understood; waits for the force to decay to zero.

        `stop`: count of the stop that is cleared (`link.stops`), by default the last one known. A later stop stays in
        effect and raises `DeviceError`.
        """
        clear = Clear(boot_id=self.device.boot_id, stop=self._link.stops if stop is None else stop)
        retry_while_busy(self._link, self.device, clear, self._link.now() + _SINKS)

    def status(self) -> Status:
        """Ask the device for its state and counters."""
        return self._link.request(GetStatus())

    def state(self) -> State:
        """Ask the device for its `State`: STOPPED, RUNNING, STOPPING, DRIVING, HOLD or ESTOP. `status` has counters
        too."""
        return State(self.status().state)

    def condition(self) -> Condition:
        """Ask the device for homing, hardware stop, delay, and continuous force of the motor."""
        return condition_of(self.status(), self._link.request(GetLimits()))

    def limits(self) -> dict[str, tuple[float, float]]:
        """Ask the device for the ranges it accepts: lowest and highest K0, K1 (N/mm), B1 (N·s^α/mm) and alpha, by
        name."""
        limits = self._link.request(GetLimits())
        return {n: (getattr(limits, f"{n}_low"), getattr(limits, f"{n}_high")) for n in ("K0", "K1", "B1", "alpha")}

    def echo(self, data: bytes) -> bytes:
        """Send bytes to the device and return the bytes that it sends back."""
        return self._link.request(Echo(data=data)).data

    def stream(self, divisor: int = 1, *, sensed: bool | None = None) -> int:
        """Switch on telemetry of every `divisor`-th tick, or fewer if the line is too slow; 0 switches it off.

        `sensed`: include the force sensor, by default if there is one. Returns the active divisor.
        """
        fields = int(bool(self.can & Capability.FORCE_SENSOR) if sensed is None else sensed)
        try:
            self._link.request(Stream(divisor=divisor, fields=fields))
        except RefusalError as error:
            if error.nack.reason != NackReason.LINE_TOO_SLOW:
                raise
            divisor = int(error.nack.limit)
            self._link.request(Stream(divisor=divisor, fields=fields))
        self.divisor = divisor
        return divisor

    def drive(
        self,
        mode: Literal["force", "position"],
        shape: Literal["hold", "triangle", "step", "nudge"],
        offset: SupportsFloat,
        amplitude: SupportsFloat = 0.0,
        *,
        period: SupportsFloat = 0.0,
        duration: SupportsFloat,
        stop: int | None = None,
    ) -> None:
        """Let the device move by itself for `duration` s, with forces in N, positions in mm and times in s: see DRIVE
        in PROTOCOL.md. `stop`: as for `start`. Does not wait for the end of the drive.

        Raises `InputError` for another mode or shape, `DeviceError` for a device that cannot move by itself.
        """
        if not self.can & Capability.DRIVE:
            raise DeviceError(
                f"{self._link.name}: this device cannot move by itself; use one that can, or the simulator."
            )
        if mode not in ("force", "position") or shape not in _SHAPES:
            raise InputError(f'The drive is "{mode}", "{shape}"; it is force or position, and {", ".join(_SHAPES)}.')
        ticks = {"period_ticks": self._ticks("period", period), "duration_ticks": self._ticks("duration", duration)}
        numbers = {"offset": float(offset), "amplitude": float(amplitude)}
        order = {"boot_id": self.device.boot_id, "stop": self._link.stops if stop is None else stop}
        self._link.heartbeat()
        self._link.request(Drive(mode=int(mode == "position"), shape=_SHAPES[shape], **numbers, **ticks, **order))

    def _ticks(self, what: str, seconds: SupportsFloat) -> int:
        """Convert a time (s) to ticks. Raises `InputError` for one that does not fit the message; `what` names it."""
        ticks = float(seconds) / self.tick_s
        if not 0 <= ticks < 2**32 - 1:  # NaN too
            raise InputError(f"The drive's {what} is {seconds} s; give a number from 0 to {2**32 * self.tick_s:.0f}.")
        return round(ticks)

    def telemetry(self, seconds: SupportsFloat = 1.0) -> Any:
        """Pandas table of the telemetry since `start` or the last call, after `seconds` more of the device's time.

        Columns: tick, time_s, position_mm, force_N (commanded), sensed_N (NaN without sensor), flags (`SampleFlag`).
        Raises `DeviceError` if the line is lost or no telemetry comes.
        """
        return self.samples(seconds).table(self.tick_s)

    def samples(self, seconds: SupportsFloat = 1.0) -> Samples:
        """Telemetry as arrays (n,): samples since `start` or the last call, after `seconds` more of the device's time.
        Raises `InputError` for a time that is not finite, `DeviceError` if the line is lost or no telemetry comes."""
        if not math.isfinite(float(seconds)):
            raise InputError(f"The time is {seconds} s; give a number.")
        buffer, quiet, ticks = self._buffer, 0, float(seconds) / self.tick_s
        first, pieces = buffer.tick, []
        while buffer.tick - first < ticks:
            if self._more():
                quiet, first = 0, first or buffer.tick
                pieces += [buffer.take()] if buffer.over_half_full else []
            elif self._link.lost:
                raise DeviceError(self._link.lost)
            elif self._link.restarted or (quiet := quiet + 1) > _STALLED:
                self.limits()  # raises a more specific error if device or line have failed
                raise DeviceError(f"{self._link.name}: no telemetry comes; switch it on with stream().")
        return joined([*pieces, buffer.take()])

    def _more(self) -> bool:
        """Wait for telemetry for up to `_POLL` s (of simulated time half of that); return whether any came."""
        seen = self._buffer.counts()
        if self._link.simulated_time:
            self._link.pause(_POLL / 2)
        else:
            self._buffer.wait(_POLL)
        return self._buffer.counts() != seen

    def counts(self) -> Counts:
        """Counts of telemetry samples since the connection: received, dropped by the device, missing, and unread."""
        return self._buffer.counts()

    def events(self) -> list[str]:
        """Remove and return the device's notices since the last call, each as a sentence with tick, state and
        reason."""
        sentences = []
        with contextlib.suppress(IndexError):
            while True:
                notice = self._link.notices.popleft()
                sentences.append(f"tick {notice.tick}: {meaning(State, notice.state)}, {held_because(notice.reason)}")
        return sentences

    def reconnect(self, timeout: SupportsFloat = 5.0) -> bool:
        """Connect again after the line or the device was away; return True if the device has not restarted meanwhile.

        The device is left stopped, and after a restart without a set. `timeout` (s): how long opening the line is
        tried; then `InputError` is raised. Raises `DeviceError` if a simulated device has ended, or the device does not
        answer.
        """
        before, give_up = self.device.boot_id, time.monotonic() + float(timeout)
        self._link.close()
        if self.simulator is not None and not self.simulator.alive():
            raise DeviceError("The simulated device has ended; open a new one.")
        while True:
            try:
                self._begin()
                return self.device.boot_id == before
            except InputError:
                if time.monotonic() > give_up:
                    raise
                time.sleep(0.1)


def _connected(port, baud, patience, capture, simulator) -> Link:
    """Open the port (a name, or socket://HOST:PORT) and return a `Link` on it, in lockstep for such a `simulator`.
    `patience`: timeout (s) of an answer, None for the default of this kind of device. Raises `InputError` if the port
    cannot be opened."""
    ticks = simulator.ticks if simulator is not None and simulator.lockstep else None
    if patience is None:
        patience = _LOCKSTEP if ticks else _SIMULATED if simulator else _ANSWER
    return Link(open_port(port, baud), patience=patience, capture=capture, ticks=ticks)
