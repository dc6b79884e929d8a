"""Rig of a haptic device: a thread that runs jobs on the device one after the other and polls it ten times a second.

Nothing here knows of trials or answers. A job gives a `Future`; a fault of the device or the line is the `DeviceError`
of the job, and sets `lost` of the snapshot; so does a device that has restarted, or receives no heartbeats. A lost
device is tried again once a second; it comes back stopped. Sets are activated, and START is sent, out of contact
only: both are tried again until the hand has left. START and CLEAR carry the count of stops that was known when they
were requested, so that neither acts after a stop that came meanwhile.
"""

import asyncio
import contextlib
import math
import queue
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Any

from hilbo.app.rigs.rig import Loaded, Showing, Snapshot
from hilbo.app.rigs.sample_flags import SampleCounter
from hilbo.device.messages import Status
from hilbo.device.reasons import DeviceFlag, HoldReason, held_because
from hilbo.hardware_bridge import Capability, DeviceError, ParameterSet, Renderer, State
from hilbo.session.log.header_check import study_of
from hilbo.study.file.reading import StudyFile

__all__ = ["DeviceRig"]

_POLL = 0.1  # s between two looks at the device
_NEAR = 0.01  # s between two tries while a set, or START, waits for the hand to leave
_RETRY = 1.0  # s
COUNTERS = ("holds", "estops", "overruns", "saturated", "slewed", "controlled", "input_held", "frames_dropped")


class DeviceRig:
    """Rig of a `Renderer`, which presents a study's sets. To make one calls `connect` and starts the thread. In that
    thread, `changed` is called with each snapshot that differs from the last, `notice` with each sentence that the
    device sends unasked."""

    title = "Device"

    def __init__(
        self,
        study: StudyFile,
        connect: Callable[[], Renderer],
        changed: Callable[[Snapshot], Any] = lambda _: None,
        notice: Callable[[str], Any] = lambda _: None,
    ):
        self._study, self._connect, self._changed, self._notice = study, connect, changed, notice
        self._jobs: queue.SimpleQueue[tuple[Callable[[], Any], Future] | None] = queue.SimpleQueue()
        self._ending = threading.Event()
        self._own_stops: list[int] = []  # the device's count of stops at each acknowledged STOP of this rig
        self.device = connect()
        self._counter = SampleCounter(lambda: self.device.samples(0).flags)  # data that have arrived, without waiting
        self.simulated = bool(self.device.can & Capability.SIMULATED)
        self.notes = list(self.device.notes)
        self.snapshot = self._look()
        self._thread = threading.Thread(target=self._work, name="hilbo-device", daemon=True)
        self._thread.start()

    def do(self, job: Callable[[Renderer], Any]) -> Future:
        """Queue `job(device)` for the rig's thread; its future has the result, or the exception: `DeviceError` while
        the device is lost, and once `close` was called."""
        result: Future = Future()
        self._jobs.put((lambda: job(self._ready()), result))
        if self._ending.is_set():
            self._refuse_jobs()
        return result

    @property
    def words(self) -> str:
        """Name of the device's line and its damping, as a text."""
        return f"{self.device.link.name}, damping {self.device.device.damping_N_s_per_m:.3g} N·s/m"

    async def prepare(self, showing: Showing) -> Loaded:
        """Wait until the handle is out of contact, put the set of a rendering active, and return it. Raises
        `DeviceError`."""
        wanted = self._wanted(showing)
        while (loaded := await asyncio.wrap_future(self.do(lambda device: self._load(device, wanted)))) is None:
            await asyncio.sleep(_NEAR)
        return loaded

    async def show(self, showing: Showing) -> None:
        """Start to render the active set once the handle is out of contact; nothing if it is rendered already, nor
        for a step without a rendering (reference, neutral). Step 0 starts the count of the presentation's samples.
        Raises `DeviceError`."""
        if showing.step == 0:
            self._counter.begin((showing.trial, showing.presentation))
        if showing.values is None:
            return
        stop = self.device.link.stops
        while not await asyncio.wrap_future(self.do(lambda device: self._render(device, stop))):
            await asyncio.sleep(_NEAR)

    def telemetry(self, trial: int, presentation: int) -> Mapping[str, int] | None:
        """Counts of the samples since the first step of this presentation of a trial, up to the newest that has
        arrived; None for another presentation than the latest."""
        return self._counter.counts((trial, presentation))

    async def blank(self) -> None:
        """Do nothing: the active set stays, and returns the handle when the hand leaves it."""

    async def rest(self) -> None:
        """Stop the device, and wait for that; the order is sent even if the caller is cancelled. Raises
        `DeviceError`."""
        stopped = asyncio.wrap_future(self.do(self._stop))
        stopped.add_done_callback(_retrieve_exception)
        await asyncio.shield(stopped)

    async def estop(self) -> None:
        """Force to zero at once, before all queued jobs, in a separate thread. Raises `DeviceError`."""
        await asyncio.get_running_loop().run_in_executor(None, self.device.estop)

    async def clear(self) -> None:
        """Leave the hold or stop that was known when this was called, but no later one, and wait for that. Raises
        `DeviceError`.

        A STOP of this rig that was requested before, and acknowledged meanwhile, is no later one, unless the device
        counted another stop before it.
        """
        acknowledged = len(self._own_stops)  # read before `stops`: a STOP that `stops` includes changes nothing below
        stop = self.device.link.stops

        def clear(device: Renderer) -> None:
            known = stop
            for count in self._own_stops[acknowledged:]:
                known = count if count == known + 1 else known
            device.clear(stop=known)

        await asyncio.wrap_future(self.do(clear))

    def _stop(self, device: Renderer) -> None:
        """Stop the device, and record its count of stops."""
        self._own_stops.append(device.stop())

    def hang_up(self) -> None:
        """Do nothing: no client waits for a device."""

    def close(self) -> None:
        """End the thread, in at most 10 s, refuse all jobs that it has not begun, then stop the device and disconnect;
        errors of the device are ignored."""
        self._ending.set()
        self._jobs.put(None)
        self._thread.join(10)
        self._refuse_jobs()
        with contextlib.suppress(DeviceError):
            self.device.close()

    def _refuse_jobs(self) -> None:
        """Take all jobs out of the queue; each one's exception is a `DeviceError`."""
        with contextlib.suppress(queue.Empty):
            while True:
                _, result = self._jobs.get_nowait() or (None, None)
                if result is not None and result.set_running_or_notify_cancel():
                    result.set_exception(DeviceError("The session has ended, and the device is disconnected."))

    def _wanted(self, showing: Showing) -> ParameterSet:
        """The set of a rendering, with memory and sampling period of its material's renderer."""
        m, values = study_of(self._study, showing.material).space.mechanics, showing.values
        assert m is not None and values is not None  # a device renders, and a rendering
        numbers = (values[name] for name in ("K0", "K1", "B1", "alpha"))
        return ParameterSet(*numbers, N=m.N, T=m.T, memory=m.memory, states=m.states)

    def _ready(self) -> Renderer:
        """The device. Raises `DeviceError` while it is lost."""
        if self.snapshot.lost:
            raise DeviceError(self.snapshot.lost)
        return self.device

    def _render(self, device: Renderer, stop: int) -> bool:
        """Start to render unless the device renders already, and return True; False, without a start, while something
        touches the handle. `stop`: the count of stops when this was requested. Raises `DeviceError`."""
        self._see(self._look())
        if self.snapshot.state == "RUNNING":
            return True
        if self.snapshot.state == "STOPPED" and self.snapshot.contact:
            return False
        self._counter.drain()  # START drops samples that have not been taken
        try:
            device.start(stop=stop, wait=0.0)
        except DeviceError as error:
            if not error.in_contact:
                raise
            self._see(self.snapshot._replace(contact=True))  # the hand has come back since the look
            return False
        return True

    def _load(self, device: Renderer, wanted: ParameterSet) -> Loaded | None:
        """Send a set, and return the active one afterwards with the time it took; None, and nothing sent, while
        something touches the handle."""
        self._see(self._look())
        if self.snapshot.contact:
            return None
        begun = time.perf_counter()
        in_force = device.send(wanted)
        took = time.perf_counter() - begun
        return Loaded({"in_force": in_force._asdict(), "serial_s": took}, took)

    def _work(self) -> None:
        """The thread, until `close`: run the queued jobs, and poll the device when none is queued or the last poll was
        longer ago than `_pause`."""
        looked = time.monotonic()
        while not self._ending.is_set():
            job, result = self._next()
            if result is not None and result.set_running_or_notify_cancel():
                try:
                    result.set_result(job())
                except BaseException as error:  # the waiting side's to judge
                    result.set_exception(error)
            if result is None or time.monotonic() - looked > self._pause:  # jobs may leave no pause between them
                self._poll()
                looked = time.monotonic()

    @property
    def _pause(self) -> float:
        """Time between two polls of the device, s; longer while it is lost."""
        return _RETRY if self.snapshot.lost else _POLL

    def _next(self) -> Any:
        """The next job and its future, after at most `_pause` s; (None, None) if none came."""
        try:
            return self._jobs.get(timeout=self._pause) or (None, None)
        except queue.Empty:
            return None, None

    def _poll(self) -> None:
        """Poll the device: new snapshot, samples, and the sentences that it sent. A `DeviceError` makes it lost; a lost
        device is reconnected instead."""
        if self._ending.is_set():
            return
        if self.snapshot.lost:
            self._reconnect()
            return
        try:
            self._see(self._look())
            self._counter.drain()
            for sentence in self.device.events():
                self._notice(sentence)
        except DeviceError as error:
            self._see(self.snapshot._replace(lost=str(error), state="LOST", contact=False))

    def _reconnect(self) -> None:
        """Try to reconnect a lost device, which is then stopped and without a set; a simulator that has ended is
        started anew. An error is the new `lost` of the snapshot."""
        try:
            if self.device.simulator is not None and not self.device.simulator.alive():
                with contextlib.suppress(DeviceError):
                    self.device.close()
                self.device = self._connect()
            else:
                self.device.reconnect(timeout=0)
            self._see(self._look())
        except (DeviceError, OSError, ValueError) as error:
            self._see(self.snapshot._replace(lost=str(error)))

    def _look(self) -> Snapshot:
        """A new snapshot, from the device's status. Raises `DeviceError`, also if the device has restarted or receives
        no heartbeats."""
        status = self.device.status()
        if self.device.link.restarted or self.device.link.faint:  # which answer this question all the same
            self.device.limits()  # and no other: `DeviceError` with what has happened
        state = State(status.state).name if status.state in State._value2member_map_ else f"state {status.state}"
        counters = {name: getattr(status, name) for name in COUNTERS}
        force, position = (v if math.isfinite(v) else 0.0 for v in (status.force_N, status.position_mm))
        rows = [("Contact", "yes" if status.contact else "no"), ("Position", f"{position:.2f} mm")]
        rows += [("Force", f"{force:.2f} N"), *((n.replace("_", " "), str(v)) for n, v in counters.items() if v)]
        rows += [] if status.flags & DeviceFlag.HOMED else [("Homed", "no")]
        rows += [("Hardware stop", "open")] if status.flags & DeviceFlag.STOP_OPEN else []
        return Snapshot(
            state,
            bool(status.contact),
            None,
            reason=_reason(status) if state in ("HOLD", "ESTOP") else "",
            facts={"counters": counters},
            rows=tuple(rows),
            excused=state == "HOLD" and status.hold_reason == HoldReason.WATCHDOG,
        )

    def _see(self, seen: Snapshot) -> None:
        """Set the snapshot, and call `changed` if it differs from the last."""
        before, self.snapshot = self.snapshot, seen
        if seen != before:
            self._changed(seen)


def _reason(status: Status) -> str:
    """Reason of a hold or stop, in words."""
    if status.hold_reason == HoldReason.SWITCH and not status.flags & DeviceFlag.STOP_OPEN:
        return "the hardware stop was open"  # it is closed again, and can be cleared
    return held_because(status.hold_reason)


def _retrieve_exception(done: asyncio.Future) -> None:
    """Mark the exception of a future as retrieved, so that asyncio does not report it."""
    if not done.cancelled():
        done.exception()
