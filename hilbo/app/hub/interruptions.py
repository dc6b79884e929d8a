"""Interruptions of a session: by its device, by a laptop that slept, by a participant's page that was closed.

    device, clocks, signs of life --> event in the log --> the runner restarts

The rig reports what happens to a device (lost, HOLD, ESTOP, ready again); here that becomes an event of the pending
trial. After an interruption the participant must press Begin, except after a HOLD or ESTOP, which the experimenter
clears.
"""

import asyncio
import contextlib
import time
from collections import deque
from collections.abc import Callable, Coroutine
from typing import Any, no_type_check

from hilbo.app.interface import HubInterface
from hilbo.app.rigs.rig import Snapshot
from hilbo.errors import InputError
from hilbo.session.log import actions
from hilbo.session.log.event_log import LogError
from hilbo.session.log.state import LiveSession

__all__ = ["Interruptions", "interrupt"]

_STOPPED = {"HOLD": "hold", "ESTOP": "estop"}
_LATER = 1.0  # s between two looks at the clock
_JUMP = 3.0  # s by which the clock, or the wait for it, may be off before the laptop must have been closed
_GONE = 3.0  # s without a participant's page until a trial that is being felt is begun again


class Interruptions:
    """Watches a `Hub` for interruptions, from `begin` to `end`: once a second, and at each change of the device."""

    hub: HubInterface

    @no_type_check  # at run time: a hub has no rig before it is opened
    def __init__(self, hub: HubInterface):
        self.hub = hub
        self._condition = ""  # the device's, when it was last seen
        self._unwritten: deque[Callable[[LiveSession, float], Any]] = deque()  # its events, not yet on the disk
        self._writing = asyncio.Lock()
        self._tasks: list[asyncio.Task] = []
        self._faults: dict[str, str] = {}  # by what of the watch does not work, until it does again
        self._wall, self._steady = time.time(), time.monotonic()  # at the last look
        self._here, self._absent = False, None  # whether the participant's page is, and since when it is not

    async def begin(self, seen: Snapshot) -> None:
        """Log the device's condition when the session opens, and start to watch clock, page and log once a second."""
        await self._device_changed(seen, opening=True)
        self._wall, self._steady = time.time(), time.monotonic()
        self._spawn(self._watch("time", self._look))
        self._spawn(self._watch("log", self.hub.check_log))

    async def end(self) -> None:
        """Commit the device events that still wait for the disk, for at most `_LATER` s, and cancel all watching.

        Raises `LogError` with how many events are missing in the log, if they could not be written.
        """
        # Not after `cancel`, which leaves an event that is being written in the queue. A disk that hangs does not keep
        # the device from being stopped.
        writing = asyncio.ensure_future(self._write())
        await asyncio.wait([writing], timeout=_LATER)
        for task in (writing, *self._tasks):
            task.cancel()
        if self._unwritten:
            why, missing = self.hub.alert or "The disk does not answer.", len(self._unwritten)
            raise LogError(
                f"{why} Not in the log: {missing} change{'s' * (missing > 1)} of the device, the last to"
                f' "{self._condition}"; go on with --resume, and void the trial that it interrupted.'
            )

    @property
    def fault(self) -> str | None:
        """What fails in watching, as a sentence; None while all works."""
        return next(iter(self._faults.values()), None)

    def device_changed(self, seen: Snapshot) -> None:
        """Handle a new snapshot of the rig in a separate task: log a changed condition as an event of the trial that
        is pending now, and notify the pages."""
        self._spawn(self._device_changed(seen))

    def _spawn(self, work: Coroutine[Any, Any, None]) -> None:
        """Run `work` as a task that is cancelled by `end`; its exception becomes `fault`."""
        task = asyncio.ensure_future(work)
        self._tasks.append(task)
        task.add_done_callback(self._ended)

    def _ended(self, task: asyncio.Task) -> None:
        """Callback at the end of a task: forget it, and set (or clear) the fault "device" by its exception."""
        self._tasks.remove(task)
        if not task.cancelled():
            self._set_fault("device", task.exception())

    def _set_fault(self, what: str, error: BaseException | None) -> None:
        """Set the fault of the watch named `what`, or clear it (`error` None); the pages are notified if `fault`
        changes."""
        before = self.fault
        self._faults.pop(what, None)
        if error is not None:
            words = str(error) or type(error).__name__
            self._faults[what] = f"A fault in watching what interrupts the session: {words}."
        if self.fault != before:
            self.hub.publish()

    async def _device_changed(self, seen: Snapshot, *, opening: bool = False) -> None:
        """Log the device's condition if it has changed, and notify the pages in any case. A lost device restarts the
        runner, and the participant must press Begin again. `opening`: the session has just opened."""
        hub, condition = self.hub, _condition_of(seen)
        if condition != self._condition:
            self._condition = condition
            self._unwritten.append(_device_event(seen, condition, hub.state.pending, opening))
            hub.begun = hub.begun and condition != "lost"  # a device that comes back does not go on by itself
            await self._write()
            if condition == "lost":
                hub.runner.forget()
                hub.runner.restart()
            hub.runner.wake()
        hub.publish()

    async def _write(self) -> None:
        """Commit the waiting device events in order. One that is refused is dropped; after a `LogError` (such as a full
        disk) it and the later ones wait for the next call."""
        async with self._writing:
            while self._unwritten:
                with contextlib.suppress(InputError):
                    try:
                        await self.hub.commit(self._unwritten[0])
                    except LogError:
                        return
                self._unwritten.popleft()

    async def _watch(self, what: str, look: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Call `look` every `_LATER` s until cancelled, also after it failed, and set or clear its fault under the name
        `what`. Each watch is a separate task: a slow disk must not look like a laptop that slept."""
        while True:
            await asyncio.sleep(_LATER)
            try:
                await look()
                self._set_fault(what, None)
            except Exception as error:
                self._set_fault(what, error)

    async def _look(self) -> None:
        """One check: interrupt after the clock jumped by more than `_JUMP` s; commit waiting device events; notify the
        pages if the participant's page came or went; interrupt if it has been away for `_GONE` s since Begin."""
        hub, now, mono = self.hub, time.time(), time.monotonic()
        slept = max(abs((now - self._wall) - (mono - self._steady)), mono - self._steady - _LATER)
        self._wall, self._steady = now, mono
        if slept > _JUMP:
            await interrupt(hub, f"The computer's clock jumped by {slept:.0f} s: it slept, or was set.")
        await self._write()
        self._here, before = hub.watchers.participant_here, self._here
        if self._here != before:
            hub.publish()
        if self._here or not hub.begun:
            self._absent = None
        elif self._absent is None:
            self._absent = mono
        elif mono - self._absent > _GONE:
            self._absent = None
            await interrupt(hub, "The participant's page is closed.")


async def interrupt(hub: HubInterface, why: str) -> None:
    """Interrupt the presentation: note `why` in the log, have an unfinished pending trial begin again, and restart the
    runner, which presents after Begin is pressed. An event that is refused or cannot be written is left out silently,
    the other one is written."""
    pending, hub.begun = hub.state.pending, False
    repeat = [actions.repeat] if pending is not None and pending.unfinished else []
    for make in (lambda state, at: actions.note(state, why, at), *repeat):
        with contextlib.suppress(InputError, LogError):
            await hub.commit(make)
    hub.runner.restart()


def _condition_of(seen: Snapshot) -> str:
    """The condition of a device as events name it: "lost", "hold", "estop", or "ready" in all other states."""
    return "lost" if seen.lost else _STOPPED.get(seen.state, "ready")


def _device_event(seen: Snapshot, condition: str, pending: Any, opening: bool) -> Callable[[LiveSession, float], Any]:
    """A function of (state, time) that makes the event of a device's condition, with its facts and the id of `pending`,
    the trial pending now or None.

    A HOLD that a killed server left behind (`excused`, when the session opens) is logged as "stopped", which voids no
    trial.
    """
    facts = {"trial": None if pending is None else pending.id, "reason": seen.lost or seen.reason, **seen.facts}
    says = "stopped" if opening and seen.excused else condition
    return lambda state, at: actions.device(state, says, at, **facts)
