"""The bridge to a rendering device: a parameter set in, force and position out.

    with Renderer.open("sim") as device:                       # or a port, or "socket://host:port"
        device.send(K0=-3.18, K1=5.58, B1=7.88, alpha=0.176)   # staged, committed, read back
        device.start()
        table = device.telemetry(2.0)

The device decides last: it checks every set again, with its own damping, and refuses by name. It renders only while
this process sends heartbeats, and is stopped when the block ends, however it ends. What is in force is read back and
compared bit for bit. A device that restarts is never started again by itself. No JAX here; firmware/PROTOCOL.md is the
wire.

Units: K N/mm, B1 N·s^α/mm, T s, mm, N, damping N·s/m.
"""

import contextlib
import math
import time
from collections.abc import Callable
from functools import partial
from typing import Any, Literal, SupportsFloat

from hilbo.device import protocol
from hilbo.device.condition import Condition, condition_of
from hilbo.device.failures import DeviceError, RefusalError
from hilbo.device.handshake import greet, take_over
from hilbo.device.link import Link
from hilbo.device.messages import Status
from hilbo.device.parameter_sets import InForce, in_force, wanted_for
from hilbo.device.ports import BAUD, list_ports, open_port
from hilbo.device.reasons import Capability, NackReason, State, held_because, meaning
from hilbo.device.staging import put_in_force, retry_while_busy
from hilbo.device.telemetry import Counts, Samples, TelemetryBuffer, joined
from hilbo.errors import InputError

__all__ = ["Capability", "DeviceError", "InForce", "RefusalError", "Renderer", "State", "list_ports"]


def __dir__() -> list[str]:
    return __all__


_ANSWER = 0.1  # s
_SIMULATED = 1.0  # s for an answer; the simulator shares this computer's processors
_LOCKSTEP = 30.0  # s, where no time passes meanwhile
_POLL = 0.1  # s
_NEAR = 0.01  # s between two looks at a handle that is to leave
_SINKS = 1.0  # s for a force to sink to zero, of which the protocol allows 0.1
_STALLED = 20  # polls without telemetry
_SHAPES = {"hold": 0, "triangle": 1, "step": 2, "nudge": 3}


class Renderer:
    """A connected device; `device` is what it said of itself (`HelloReply`), `notes` what a person should know.

    `simulator` is the `Simulator` behind a simulated one, else None.

    Make one with `open`. Every method raises `RefusalError` (an `InputError`) for numbers the device refuses, and
    `DeviceError` when device or line fail; both say in one sentence what to do.
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

        `damping` (N·s/m) and `delay` (s) are what a study counts on: a device with less damping, or one that checks its
        sets for a longer delay of the force, is refused. `patience` (s) is for one answer,
        0.1 on a line. `capture` gets every byte that arrives. `options` are those of the simulated device
        (`simulator.Simulator`). Raises `InputError` for a line that cannot be opened, and `DeviceError` for one on
        which no device of this protocol answers.
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
        try:
            self.close()
        except DeviceError:
            if error is None:
                raise

    def close(self) -> None:
        """Stop the device and let go of the line. Raises `DeviceError` if it could not be told to stop."""
        try:
            if self._link.lost is None:
                self._link.request(protocol.Stop())
            else:
                self._link.shout(protocol.Stop())
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
        """What the device can do."""
        return Capability(self.device.capabilities)

    @property
    def link(self) -> Link:
        """The conversation, with its counters."""
        return self._link

    def _begin(self) -> None:
        """A new conversation: who is there, at rest, heartbeats, telemetry."""
        self._link = self._connect()
        try:
            self.device = greet(self._link, self._damping, self._delay)
            self._buffer = TelemetryBuffer(self.device.encoder_step_mm)
            self._link.on_telemetry = self._buffer.add
            self.notes += take_over(self._link, self.device)
            if self._link.ours:
                self._link.pause(self.tick_s)  # a device knows its position from its first tick on
            self.stream()
        except BaseException:
            self._link.close()
            raise

    def send(
        self,
        *,
        K0: SupportsFloat,
        K1: SupportsFloat,
        B1: SupportsFloat,
        alpha: SupportsFloat,
        N: int = 101,
        T: SupportsFloat = 1e-3,
        memory: str = "short",
        states: int = 10,
        force_limit: SupportsFloat | None = None,
        wait: SupportsFloat = 5.0,
    ) -> InForce:
        """Put a set in force: staged, committed, read back and compared bit for bit.

        In contact the device first warms the set's own history; `wait` is how long (s) that may take. `force_limit`
        (N) is the device's own if not given. A set that is in force already is not sent again.
        K0, K1 in N/mm, B1 in N·s^α/mm, T in s. Raises `InputError` for numbers that do not fit and for a set
        that the device refuses, `DeviceError` if the line fails.
        """
        numbers = {"K0": K0, "K1": K1, "B1": B1, "alpha": alpha, "N": N, "T": T, "memory": memory, "states": states}
        wanted = wanted_for(self.device, **numbers, force_limit=force_limit)
        return put_in_force(self._link, self.device, wanted, float(wait))

    def in_force(self) -> InForce | None:
        """The set in force, or None."""
        return in_force(self._link.request(protocol.GetSet(bank=0)))

    @property
    def delay(self) -> float:
        """Longest time from the sample of a position until its force is out, s: sets are checked for it."""
        return self._link.request(protocol.GetLimits()).delay_us * 1e-6

    def home(self, position: SupportsFloat = 0.0) -> None:
        """Tell a device without an absolute encoder that its handle stands at `position` (mm) now.
        Raises `DeviceError` while it moves, `RefusalError` for a position outside of its stroke.
        """
        place = {"stop": self._link.stops, "position_mm": float(position)}
        self._link.request(protocol.Home(boot_id=self.device.boot_id, **place))

    def start(self, *, stop: int | None = None, wait: SupportsFloat = 5.0) -> None:
        """Render the set that is in force. Telemetry from before is dropped.

        `stop` is the device's count of stops that the order follows (`link.stops`), by default what is known at the
        call: after a later stop the device refuses it. `wait` is how long (s) the handle may stay in the material,
        where nothing is started. Raises `DeviceError` if no set is in force, if the handle has not left by then, and
        where the device refuses for another reason.
        """
        stop = self._link.stops if stop is None else stop
        current = self.in_force()
        if current is None:
            raise DeviceError("The device has no set in force; send one first.")
        self._link.heartbeat()
        self._buffer.take()
        order = {"set_id": current.set_id, "crc": current.crc, "boot_id": self.device.boot_id, "stop": stop}
        give_up = self._link.now() + float(wait)
        while True:
            try:
                self._link.request(protocol.Start(**order))
                return
            except DeviceError as error:
                if not error.in_contact or self._link.now() > give_up:
                    raise
            self._link.pause(_NEAR)

    def stop(self) -> None:
        """Force to zero, smoothly."""
        self._link.request(protocol.Stop())

    def estop(self) -> None:
        """Force to zero at once, latched until `clear`."""
        self._link.request(protocol.Estop())

    def clear(self, *, stop: int | None = None) -> None:
        """Leave HOLD or ESTOP, once the reason is understood; the device first lets its force sink to zero.

        `stop` is the stop that it ends (`link.stops`), by default the last one known at the call. A later stop stays,
        and raises `DeviceError`.
        """
        clear = protocol.Clear(boot_id=self.device.boot_id, stop=self._link.stops if stop is None else stop)
        retry_while_busy(self._link, self.device, clear, self._link.now() + _SINKS)

    def status(self) -> Status:
        """State and counters."""
        return self._link.request(protocol.GetStatus())

    def state(self) -> State:
        """The state alone."""
        return State(self.status().state)

    def condition(self) -> Condition:
        """Homed or not, hardware stop, delay, and what the motor bears."""
        return condition_of(self.status(), self._link.request(protocol.GetLimits()))

    def limits(self) -> dict[str, tuple[float, float]]:
        """What the device takes: lowest and highest K0, K1 (N/mm), B1 (N·s^α/mm) and alpha."""
        limits = self._link.request(protocol.GetLimits())
        return {n: (getattr(limits, f"{n}_low"), getattr(limits, f"{n}_high")) for n in ("K0", "K1", "B1", "alpha")}

    def echo(self, data: bytes) -> bytes:
        """The same bytes back, from the device."""
        return self._link.request(protocol.Echo(data=data)).data

    def stream(self, divisor: int = 1, *, sensed: bool | None = None) -> int:
        """Telemetry of every `divisor`-th tick, or of as many as the line carries; 0 switches it off.

        `sensed`: with the force sensor, by default where there is one. Returns the divisor in force.
        """
        fields = int(bool(self.can & Capability.FORCE_SENSOR) if sensed is None else sensed)
        try:
            self._link.request(protocol.Stream(divisor=divisor, fields=fields))
        except RefusalError as error:
            if error.nack.reason != NackReason.LINE_TOO_SLOW:
                raise
            divisor = int(error.nack.limit)
            self._link.request(protocol.Stream(divisor=divisor, fields=fields))
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
        """The device moves by itself for `duration` s: see DRIVE in PROTOCOL.md. Force in N, position in mm, s.

        `stop`: as for `start`.
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
        self._link.request(
            protocol.Drive(mode=int(mode == "position"), shape=_SHAPES[shape], **numbers, **ticks, **order)
        )

    def _ticks(self, what: str, seconds: SupportsFloat) -> int:
        """A time of a drive in ticks; whether the device takes so many is its own to say."""
        ticks = float(seconds) / self.tick_s
        if not 0 <= ticks < 2**32 - 1:  # NaN too
            raise InputError(f"The drive's {what} is {seconds} s; give a number from 0 to {2**32 * self.tick_s:.0f}.")
        return round(ticks)

    def telemetry(self, seconds: SupportsFloat = 1.0) -> Any:
        """A pandas table of everything since `start` or the last call, after `seconds` more of the device's time.

        Columns: tick, time_s, position_mm, force_N (commanded), sensed_N (NaN without sensor), flags (`SampleFlag`).
        Raises `DeviceError` if the line is lost or no telemetry comes.
        """
        return self.samples(seconds).table(self.tick_s)

    def samples(self, seconds: SupportsFloat = 1.0) -> Samples:
        """The same over `seconds` of device time, as columns of numbers, without pandas.

        Arrays (n,), in the units of `telemetry`. Raises `DeviceError` if the line is lost or no telemetry comes.
        """
        if not math.isfinite(float(seconds)):
            raise InputError(f"The time is {seconds} s; give a number.")
        buffer, quiet, ticks = self._buffer, 0, float(seconds) / self.tick_s
        first, pieces = buffer.tick, []
        while buffer.tick - first < ticks:
            if self._more():
                quiet, first = 0, first or buffer.tick
                pieces += [buffer.take()] if buffer.much else []
            elif self._link.lost:
                raise DeviceError(self._link.lost)
            elif self._link.restarted or (quiet := quiet + 1) > _STALLED:
                self.limits()  # says it better if device or line have a problem
                raise DeviceError(f"{self._link.name}: no telemetry comes; switch it on with stream().")
        return joined([*pieces, buffer.take()])

    def _more(self) -> bool:
        """Whether telemetry comes soon."""
        seen = self._buffer.counts()
        if self._link.ours:
            self._link.pause(_POLL / 2)
        else:
            self._buffer.wait(_POLL)
        return self._buffer.counts() != seen

    def newest(self) -> Any:
        """The newest telemetry message, or None; for displays."""
        return self._buffer.newest

    def counts(self) -> Counts:
        """Samples received, dropped by the device, and missing."""
        return self._buffer.counts()

    def events(self) -> list[str]:
        """What the device has told unasked since the last call, in words."""
        sentences = []
        with contextlib.suppress(IndexError):
            while True:
                notice = self._link.notices.popleft()
                sentences.append(f"tick {notice.tick}: {meaning(State, notice.state)}, {held_because(notice.reason)}")
        return sentences

    def reconnect(self, timeout: SupportsFloat = 5.0) -> bool:
        """Connect again after the line or the device was away; True if the device has not restarted meanwhile.

        It is left stopped, and a restarted one without a set: send it again, and start it when somebody is ready.
        `timeout` in s. Raises `DeviceError` if a simulated device has ended.
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
    ticks = simulator.ticks if simulator is not None and simulator.lockstep else None
    if patience is None:
        patience = _LOCKSTEP if ticks else _SIMULATED if simulator else _ANSWER
    return Link(open_port(port, baud), patience=patience, capture=capture, ticks=ticks)
