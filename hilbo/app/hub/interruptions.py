"""What interrupts a session though nobody asked for it: its device, a laptop that slept, a participant who is gone, and
a hand that does not leave.

    device, clocks, signs of life --> event in the log --> the runner begins anew

What a device does (lost, HOLD, E-STOP, ready again) and when is the rig's to see; what that means for the trial that is
pending is said here. Nothing that was interrupted goes on by itself: the participant presses Begin.
"""

import asyncio
import contextlib
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from hilbo.app.interface import HubInterface
from hilbo.app.rigs.rig import Snapshot
from hilbo.errors import InputError
from hilbo.session.log import actions
from hilbo.session.log.event_log import LogError
from hilbo.session.log.state import LiveSession

__all__ = ["Interruptions", "interrupt"]

_STOPPED = {"HOLD": "hold", "ESTOP": "estop"}
_LATER = 1.0  # s between two looks at the clock
_JUMP = 3.0  # s by which the clock, or the wait for it, may be off before somebody must have closed the laptop
_GONE = 3.0  # s without a participant's page until a trial that is being felt is begun again


class Interruptions:
    """Those of a `Hub`, from `begin` to `end`."""

    def __init__(self, hub: HubInterface):
        self.hub = hub
        self._condition = ""  # the device's, when it was last seen
        self._unsaid: deque[Callable[[LiveSession, float], Any]] = deque()  # what it did, not yet on the disk
        self._saying = asyncio.Lock()
        self._tasks: list[asyncio.Task] = []
        self._faults: dict[str, str] = {}  # by what of the watch does not work, until it does again
        self._wall, self._steady = time.time(), time.monotonic()  # at the last look
        self._here, self._absent = False, None  # whether the participant's page is, and since when it is not

    async def begin(self, seen: Snapshot) -> None:
        """Say how the device was found, and watch the time from now on."""
        await self._device_changed(seen, opening=True)
        self._wall, self._steady = time.time(), time.monotonic()
        self._spawn(self._watch_time())

    def end(self) -> None:
        """Watch no more."""
        for task in self._tasks:
            task.cancel()

    @property
    def fault(self) -> str | None:
        """What of the watch does not work, in a sentence; it stands until that works again."""
        return next(iter(self._faults.values()), None)

    def device_changed(self, seen: Snapshot) -> None:
        """What the device did unasked is an event where it matters to a trial: the one that was pending then."""
        self._spawn(self._device_changed(seen))

    def _spawn(self, work) -> None:
        task = asyncio.ensure_future(work)
        self._tasks.append(task)
        task.add_done_callback(self._ended)

    def _ended(self, task: asyncio.Task) -> None:
        """Nothing ends silently."""
        self._tasks.remove(task)
        if not task.cancelled():
            self._went("device", task.exception())

    def _went(self, what: str, error: BaseException | None) -> None:
        """The experimenter is told of a fault, and no more once the same works again."""
        before = self.fault
        self._faults.pop(what, None)
        if error is not None:
            words = str(error) or type(error).__name__
            self._faults[what] = f"A fault in watching what interrupts the session: {words}."
        if self.fault != before:
            self.hub.publish()

    async def _device_changed(self, seen: Snapshot, *, opening: bool = False) -> None:
        hub, condition = self.hub, _condition_of(seen)
        if condition != self._condition:
            self._condition = condition
            self._unsaid.append(_told(seen, condition, hub.state.pending, opening))
            hub.begun = hub.begun and condition != "lost"  # a device that comes back does not go on by itself
            await self._say()
            if condition == "lost":
                hub.runner.forget()
                hub.runner.restart()
            hub.runner.wake()
        hub.publish()

    async def _say(self) -> None:
        """What the device did, in the log in its order; what does not fit on the disk waits until there is room."""
        async with self._saying:
            while self._unsaid:
                with contextlib.suppress(InputError):
                    try:
                        await self.hub.commit(self._unsaid[0])
                    except LogError:
                        return
                self._unsaid.popleft()

    async def _watch_time(self) -> None:
        """A laptop that slept, a page that was closed, and what the device did that is not in the log yet. A fault is
        told, and the watch goes on."""
        while True:
            await asyncio.sleep(_LATER)
            try:
                await self._look()
                self._went("time", None)
            except Exception as error:
                self._went("time", error)

    async def _look(self) -> None:
        """At the clocks, at what is still to be said, and for the participant's page."""
        hub, now, mono = self.hub, time.time(), time.monotonic()
        await hub.check_log()
        if hub.lost:
            return
        slept = max(abs((now - self._wall) - (mono - self._steady)), mono - self._steady - _LATER)
        self._wall, self._steady = now, mono
        if slept > _JUMP:
            await interrupt(hub, f"The computer's clock jumped by {slept:.0f} s: it slept, or was set.")
        await self._say()
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
    """What was being felt is felt again from its beginning, once somebody presses Begin. `why`: a note in the log."""
    pending, hub.begun = hub.state.pending, False
    with contextlib.suppress(InputError, LogError):
        await hub.commit(lambda state, at: actions.note(state, why, at))
        if pending is not None and pending.unfinished:
            await hub.commit(actions.repeat)
    hub.runner.restart()


def _condition_of(seen: Snapshot) -> str:
    return "lost" if seen.lost else _STOPPED.get(seen.state, "ready")


def _told(seen: Snapshot, condition: str, pending: Any, opening: bool) -> Callable[[LiveSession, float], Any]:
    """Makes the event of what the device did to the trial that is pending now.

    A device that held because the server before this one was killed has done what it should, and voids nothing.
    """
    facts = {"trial": None if pending is None else pending.id, "reason": seen.lost or seen.reason, **seen.facts}
    says = "stopped" if opening and seen.excused else condition
    return lambda state, at: actions.device(state, says, at, **facts)
