"""Rig of a haptic device: a thread that runs jobs on the device one after the other and polls it ten times a second.

Nothing here knows of trials or answers. A job gives a `Future`; whatever the device or the line does wrong is the job's
`DeviceError`, and the snapshot that everybody may read says `lost` with the sentence; so it does of a device that has
restarted, or hears no heartbeats. A lost device is tried again once a second; it comes back stopped. Sets go over to
the device, and START is sent, out of contact only: both are tried again until the hand has left. START and CLEAR carry
the count of stops that was known when they were requested, so that neither acts after a stop that came meanwhile.
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
    """A `Renderer` behind a queue, which renders a study's sets. `changed` is called in the rig's thread after every
    look that found news, and `notice` with every sentence that the device told unasked."""

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
        self._counter = SampleCounter(lambda: self.device.samples(0).flags)  # what has arrived, without waiting
        self.simulated = bool(self.device.can & Capability.SIMULATED)
        self.notes = list(self.device.notes)
        self.snapshot = self._look()
        self._thread = threading.Thread(target=self._work, name="hilbo-device", daemon=True)
        self._thread.start()

    def do(self, job: Callable[[Renderer], Any]) -> Future:
        """Has `job(device)` done after those before it."""
        result: Future = Future()
        self._jobs.put((lambda: job(self._ready()), result))
        return result

    @property
    def words(self) -> str:
        """Port of the device, and its damping."""
        return f"{self.device.link.name}, damping {self.device.device.damping_N_s_per_m:.3g} N·s/m"

    async def prepare(self, showing: Showing) -> Loaded:
        """Put the set of a rendering in force, once the handle is out of contact."""
        wanted = self._wanted(showing)
        while (loaded := await asyncio.wrap_future(self.do(lambda device: self._load(device, wanted)))) is None:
            await asyncio.sleep(_NEAR)
        return loaded

    async def show(self, showing: Showing) -> None:
        """Render the set in force once the handle is out of contact; a no-op if it is rendered already, and for the
        reference, which is not rendered here."""
        if showing.step == 0:
            self._counter.begin((showing.trial, showing.presentation))
        if showing.values is None:
            return
        stop = self.device.link.stops
        while not await asyncio.wrap_future(self.do(lambda device: self._render(device, stop))):
            await asyncio.sleep(_NEAR)

    def telemetry(self, trial: int, presentation: int) -> Mapping[str, int] | None:
        """Counts of the samples since the first step of this presentation, up to the newest that has arrived."""
        return self._counter.counts((trial, presentation))

    async def blank(self) -> None:
        """Do nothing: the set in force stays, and returns the handle when the hand leaves it."""

    async def rest(self) -> None:
        """Stop the device; the order is sent even if the caller is cancelled."""
        stopped = asyncio.wrap_future(self.do(self._stop))
        stopped.add_done_callback(_looked_at)
        await asyncio.shield(stopped)

    async def estop(self) -> None:
        """Force to zero at once: overtakes everything that waits."""
        await asyncio.get_running_loop().run_in_executor(None, self.device.estop)

    async def clear(self) -> None:
        """Go on after the hold or stop that was known when this was called, and after no later one.

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
        self._own_stops.append(device.stop())

    def hang_up(self) -> None:
        """Do nothing: no client waits for a device."""

    def close(self) -> None:
        """Stop the device and let go of it."""
        self._ending.set()
        self._jobs.put(None)
        self._thread.join(10)
        with contextlib.suppress(DeviceError):
            self.device.close()

    def _wanted(self, showing: Showing) -> ParameterSet:
        """The set of a rendering, with the memory and the period of its material's renderer."""
        m, values = study_of(self._study, showing.material).space.mechanics, showing.values
        assert m is not None and values is not None  # a device renders, and a rendering
        numbers = (values[name] for name in ("K0", "K1", "B1", "alpha"))
        return ParameterSet(*numbers, N=m.N, T=m.T, memory=m.memory, states=m.states)

    def _ready(self) -> Renderer:
        if self.snapshot.lost:
            raise DeviceError(self.snapshot.lost)
        return self.device

    def _render(self, device: Renderer, stop: int) -> bool:
        """Whether the set is rendered now; not while something touches the handle. `stop`: the count of stops when that
        was requested."""
        self._see(self._look())
        if self.snapshot.state == "RUNNING":
            return True
        if self.snapshot.state == "STOPPED" and self.snapshot.contact:
            return False
        self._counter.drain()  # START drops what has not been taken
        try:
            device.start(stop=stop, wait=0.0)
        except DeviceError as error:
            if not error.in_contact:
                raise
            self._see(self.snapshot._replace(contact=True))  # the hand has come back since the look
            return False
        return True

    def _load(self, device: Renderer, wanted: ParameterSet) -> Loaded | None:
        """Send a set, and return the one in force afterwards with the time it took; None, and nothing sent, while
        something touches the handle."""
        self._see(self._look())
        if self.snapshot.contact:
            return None
        begun = time.perf_counter()
        in_force = device.send(wanted)
        took = time.perf_counter() - begun
        return Loaded({"in_force": in_force._asdict(), "serial_s": took}, took)

    def _work(self) -> None:
        looked = time.monotonic()
        while not self._ending.is_set():
            job, result = self._next()
            if result is not None and result.set_running_or_notify_cancel():
                try:
                    result.set_result(job())
                except BaseException as error:  # the waiting side's to judge
                    result.set_exception(error)
            if result is None or time.monotonic() - looked > self._pause:  # jobs may leave no pause between them
                self._regularly()
                looked = time.monotonic()

    @property
    def _pause(self) -> float:
        return _RETRY if self.snapshot.lost else _POLL

    def _next(self) -> Any:
        try:
            return self._jobs.get(timeout=self._pause) or (None, None)
        except queue.Empty:
            return None, None

    def _regularly(self) -> None:
        if self._ending.is_set():
            return
        if self.snapshot.lost:
            self._again()
            return
        try:
            self._see(self._look())
            self._counter.drain()
            for sentence in self.device.events():
                self._notice(sentence)
        except DeviceError as error:
            self._see(self.snapshot._replace(lost=str(error), state="LOST", contact=False))

    def _again(self) -> None:
        """Reconnect a lost device, which is then stopped and without a set."""
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
        before, self.snapshot = self.snapshot, seen
        if seen != before:
            self._changed(seen)


def _reason(status: Status) -> str:
    """Reason of a hold or stop, in words."""
    if status.hold_reason == HoldReason.SWITCH and not status.flags & DeviceFlag.STOP_OPEN:
        return "the hardware stop was open"  # it is closed again, and can be cleared
    return held_because(status.hold_reason)


def _looked_at(done: asyncio.Future) -> None:
    """Retrieve the exception of a future that may not be awaited."""
    if not done.cancelled():
        done.exception()
