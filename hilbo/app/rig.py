"""The device of a session, in a thread of its own: one job after the other, its state looked at ten times a second.

Nothing here knows of trials or answers. A job gives a `Future`; whatever the device or the line does wrong is the job's
`DeviceError`, and the snapshot that everybody may read says `lost` with the sentence; so it does of a device that has
restarted, or hears no heartbeats. A lost device is tried again once a second; it comes back stopped. Sets go over to
the device out of contact only: a job waits until nobody presses.
"""

import contextlib
import math
import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, NamedTuple

from hilbo.hardware_bridge import DeviceError, InForce, Renderer, State

__all__ = ["Loaded", "Rig", "Snapshot"]

_POLL = 0.1  # s between two looks at the device
_NEAR = 0.01  # s between them while a set waits for the hand to leave
_RETRY = 1.0  # s
_PUSHED = 1.0  # s
COUNTERS = ("holds", "estops", "overruns", "saturated", "slewed", "controlled", "input_held", "frames_dropped")


class Snapshot(NamedTuple):
    """What was last seen. `lost` is why there is no device, None while there is one; mm, N."""

    state: str
    contact: bool
    position_mm: float
    force_N: float
    hold_reason: int
    counters: dict[str, int]
    needs: float | None
    lost: str | None


class Loaded(NamedTuple):
    """A set in force, and how long (s) the conversation about it took, without the wait for the hand."""

    in_force: InForce
    serial_s: float


class Rig:
    """A `Renderer` behind a queue. `changed` is called in the rig's thread after every look that found news, and
    `notice` with every sentence that the device told unasked."""

    def __init__(
        self,
        connect: Callable[[], Renderer],
        changed: Callable[[Snapshot], Any] = lambda _: None,
        notice: Callable[[str], Any] = lambda _: None,
    ):
        self._connect, self._changed, self._notice = connect, changed, notice
        self._jobs: queue.SimpleQueue[tuple[Callable[[], Any], Future] | None] = queue.SimpleQueue()
        self._ending = threading.Event()
        self.device = connect()
        self.notes = list(self.device.notes)
        self.snapshot = self._look()
        self._thread = threading.Thread(target=self._work, name="hilbo-device", daemon=True)
        self._thread.start()

    def do(self, job: Callable[[Renderer], Any]) -> Future:
        """Has `job(device)` done after those before it."""
        found: Future = Future()
        self._jobs.put((lambda: job(self._ready()), found))
        return found

    def load(self, wanted: dict[str, Any], stop: threading.Event, may_push: Callable[[], bool]) -> Future:
        """The set in force once nobody presses: `Loaded`; None if `stop` was set before that.

        While `may_push()`, a handle that was left pressed is pushed back by the set that is in force.
        """
        return self.do(lambda device: self._load(device, wanted, stop, may_push))

    def render(self) -> Future:
        """The set in force, from now on; nothing where it is rendered already."""
        return self.do(self._render)

    def estop(self) -> None:
        """Force to zero at once: overtakes everything that waits. Called from any thread but the event loop's."""
        self.device.estop()

    def close(self) -> None:
        """Stop the device and let go of it."""
        self._ending.set()
        self._jobs.put(None)
        self._thread.join(10)
        with contextlib.suppress(DeviceError):
            self.device.close()

    def _ready(self) -> Renderer:
        if self.snapshot.lost:
            raise DeviceError(self.snapshot.lost)
        return self.device

    def _render(self, device) -> None:
        self._see(self._look())
        if self.snapshot.state != "RUNNING":
            device.start()

    def _load(self, device, wanted, stop, may_push):
        patient = time.monotonic() + _PUSHED
        while True:
            self._see(self._look())
            if not self.snapshot.contact:
                break
            if stop.wait(_NEAR) or self._ending.is_set():
                return None
            resting = time.monotonic() > patient and self.snapshot.state == "STOPPED"
            if resting and may_push() and device.in_force() is not None:
                device.start()  # nothing but the last set's force brings a handle back that was left pressed
        begun = time.perf_counter()
        found = device.send(**wanted)
        return Loaded(found, time.perf_counter() - begun)

    def _work(self) -> None:
        while not self._ending.is_set():
            job, found = self._next()
            if found is None:
                self._regularly()
            elif found.set_running_or_notify_cancel():
                try:
                    found.set_result(job())
                except BaseException as error:  # the waiting side's to judge
                    found.set_exception(error)

    def _next(self) -> Any:
        try:
            return self._jobs.get(timeout=_RETRY if self.snapshot.lost else _POLL) or (None, None)
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
            for sentence in self.device.events():
                self._notice(sentence)
        except DeviceError as error:
            self._see(self.snapshot._replace(lost=str(error), state="LOST", contact=False))

    def _again(self) -> None:
        """A device that is back is stopped, and has no set that anybody should count on."""
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
        found = self.device.status()
        if self.device.link.restarted or self.device.link.faint:  # which answer this question all the same
            self.device.limits()  # and no other: `DeviceError` with what has happened
        state = State(found.state).name if found.state in State._value2member_map_ else f"state {found.state}"
        counters = {name: getattr(found, name) for name in COUNTERS}
        force, position = (v if math.isfinite(v) else 0.0 for v in (found.force_N, found.position_mm))
        return Snapshot(state, bool(found.contact), position, force, found.hold_reason, counters, None, None)

    def _see(self, seen: Snapshot) -> None:
        before, self.snapshot = self.snapshot, seen
        if seen != before:
            self._changed(seen)
