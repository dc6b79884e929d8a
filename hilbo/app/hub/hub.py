"""The one place that changes a live session: it owns the log, the state, the device and the choosing.

    page or program --> answer / press / command --> event --> log (fsync) --> state --> views to everybody

Events are made one after the other, and one counts only when it is on the disk: then the state moves on, the sender is
told, and the next proposal is made. Threads work beside the event loop: the disk's, a device's (`device_rig`), the
choosing's, and the server's own. What a participant does next is in `runner`, what comes between in `interruptions`.
"""

import asyncio
import contextlib
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

from hilbo.app.hub import commands
from hilbo.app.hub.commands import NotNowError
from hilbo.app.hub.interruptions import Interruptions
from hilbo.app.hub.runner import Runner
from hilbo.app.pages import blind, views
from hilbo.app.rigs.rig import Rig, Snapshot
from hilbo.app.wire.messages import Answer, Command, Press
from hilbo.app.wire.security import Role
from hilbo.app.wire.watchers import Watchers
from hilbo.session.log import actions
from hilbo.session.log.event_log import LogError, LogLostError
from hilbo.session.log.records import RefusedError
from hilbo.session.log.state import LiveSession

__all__ = ["PRESSES", "Hub"]

_WHY = 200  # characters of an error
_RECENT = 200  # events that the experimenter's page may show
PRESSES = ("begin", "break", "more", "here")
Result = TypeVar("Result")


class Hub:
    """A session being held. `log` is its `EventLog`, `chooser` proposes, `connect` makes the rig that shows renderings
    (given what is to be told of each new snapshot, and of what it says unasked), `maps` makes what draws the slices of
    the chooser's posterior.

    `invite`, once set, makes a new link for a role; `settle`, once set, is called when all that is needed is compiled,
    before anything is rendered; `gap` (s) is the pause between two trials, `tag` is what trials of this session are
    known by in browsers.
    """

    def __init__(
        self,
        log: Any,
        chooser: Any,
        connect: Callable[[Callable[[Snapshot], Any], Callable[[str], Any]], Rig],
        *,
        tag: str,
        maps: Callable[[Any], Any] | None = None,
        gap: float = 0.7,
    ):
        self.log, self.chooser, self.tag, self.gap = log, chooser, tag, gap
        self.state: LiveSession = log.state
        self._rig: Rig | None = None
        self.begun = False  # whether the participant has said so, since the server started or the page came back
        self.alert: str | None = None
        self.lost = False  # whether the log's file is lost: the session has ended
        self.without_map = ""  # why, in a sentence
        self.trust: list[list[str]] = []
        self.recent: deque = deque(reversed(log.before[-_RECENT:]), maxlen=_RECENT)
        self.delays: list[dict[str, float]] = []  # s, from each answer on
        self.invite: Callable[[Role], dict[str, str]] | None = None
        self.settle: Callable[[], Any] = lambda: None
        self._connect, self._make_maps, self._maps = connect, maps, None
        self._warming: asyncio.Future | None = None
        self.watchers = Watchers(lambda: self.text("moved"))
        self._disk = ThreadPoolExecutor(1, "hilbo-disk")
        self.compute = ThreadPoolExecutor(1, "hilbo-choice")
        self._lock: asyncio.Lock | None = None
        self._came = 0.0
        self._map: tuple[str, Any] | None = None
        self._drawing = ThreadPoolExecutor(1, "hilbo-map")
        self.runner, self._interruptions = Runner(self), Interruptions(self)

    # Life.

    async def open(self) -> None:
        """Connect to the rig, and begin. Raises `InputError` or `DeviceError`."""
        self._lock, self._loop = asyncio.Lock(), asyncio.get_running_loop()
        rig = await self._loop.run_in_executor(self._disk, lambda: self._connect(self._from_rig, self._noticed))
        self._rig = rig
        self._warming = self._loop.run_in_executor(self.compute, self._warm)
        self._warming.add_done_callback(self._warmed)
        await self._interruptions.begin(rig.snapshot)
        self.runner.restart()

    def _warm(self) -> None:
        """Compile what choosing and drawing need; nothing is rendered before it is done."""
        self.chooser.warm()
        if self._make_maps is None:
            return
        try:
            maps = self._make_maps(self.chooser)
            maps.warm()
            self._maps = maps
        except Exception as error:  # whatever it is: a person is waiting, and the session needs no map
            why = " ".join(str(error).split())[:_WHY]
            self.without_map = f"There will be no map ({why}); the session goes on without it."

    def _warmed(self, warm: asyncio.Future) -> None:
        if warm.cancelled():  # the session ends before it
            return
        self.settle()
        self.publish()

    async def close(self) -> None:
        """Stop the rig, let go of everything."""
        self._interruptions.end()
        self.runner.cancel()
        if self._warming is not None:
            self._warming.cancel()
        self.watchers.end_all()
        if self._rig is not None:
            await self._loop.run_in_executor(None, self._rig.close)
        self._disk.shutdown()
        for pool in (self.compute, self._drawing):
            pool.shutdown(wait=False, cancel_futures=True)

    @property
    def rig(self) -> Rig:
        """What shows renderings, from `open` on."""
        assert self._rig is not None
        return self._rig

    @property
    def warm(self) -> asyncio.Future:
        """Done when all that is needed is compiled; from `open` on."""
        assert self._warming is not None
        return self._warming

    # Events.

    @property
    def fault(self) -> str | None:
        """What of the watch over the session does not work."""
        return self._interruptions.fault

    async def commit(self, make: Callable[[LiveSession, float], Any], *, mine: bool = False) -> Any:
        """Have an event made from the newest state, on the disk, and counted; None if there is none to make.

        `mine`: the runner itself asks, and goes on by itself. Raises `RefusedError`, or `LogError`. Whoever waits for
        it may give up: the event is finished all the same, so that log and state never part.
        """
        return await asyncio.shield(asyncio.ensure_future(self._commit(make, mine)))

    async def _commit(self, make, mine):
        assert self._lock is not None
        async with self._lock:
            event = make(self.state, time.time())
            if event is None:
                return None
            before = self.runner.key()
            self.state = await self._on_disk(self.log.append, event)
            self.alert = None
            self.recent.appendleft(event)
            if event.kind == "answer":
                self.runner.clock = {"came": self._came, "logged": time.perf_counter(), "fsync": self.log.sync_s}
        if not mine and self.runner.key() != before:
            self.runner.restart()
        self.publish()
        return event

    async def check_log(self) -> None:
        """Stop the session if its log is lost (`EventLog.check`)."""
        assert self._lock is not None
        async with self._lock:
            with contextlib.suppress(LogLostError):
                await self._on_disk(self.log.check)

    async def _on_disk(self, work: Callable[..., Result], *arguments: object) -> Result:
        """The result of work on the log, in the disk's thread. Raises `LogError`, of which the experimenter is told."""
        try:
            return await self._loop.run_in_executor(self._disk, work, *arguments)
        except LogError as error:
            alert, self.alert = self.alert, str(error)
            if isinstance(error, LogLostError) and not self.lost:
                self.lost = True
                self.runner.restart()
            if self.alert != alert:
                self.publish()
            raise

    def hang_up(self) -> None:
        """The server ends: nobody waits for news."""
        self.watchers.end_all()
        if self._rig is not None:
            self._rig.hang_up()

    def publish(self) -> None:
        """Tell everybody who looks that there is news."""
        self.watchers.tell()

    # What pages and programs ask for.

    def text(self, key: str) -> str:
        """What participants read, in the study's language."""
        return self.state.study.session.text(key)

    def view(self, role: Role) -> dict[str, Any]:
        """What a role may see now."""
        if role == "participant":
            return views.participant(self)
        if role != "experimenter":  # who presents is given orders, and has no view
            return {}
        seen = views.experimenter(self)
        return blind.experimenter(self, seen) if self._blinds else seen

    async def answer(self, message: Answer, page: str | None) -> dict[str, Any]:
        """A participant's answer, accepted once; on the disk when this returns. Raises `NotNowError`."""
        self._check_page(page)
        trial, presentation = self._trial_of(message.trial)
        times = {"response_s": message.response_ms, "shortest_s": message.shortest_ms}
        browser = {name: ms / 1000 for name, ms in times.items() if ms is not None}
        clicked = views.seconds_of(message.clicked)
        browser |= {} if clicked is None else {"clicked": clicked}

        def make(state, at):
            asked = state.trial(trial)
            if asked.values is None and asked.presentation != presentation:
                raise RefusedError("old-trial", "This trial has been begun again since.")
            self._came = came
            telemetry = self.rig.telemetry(trial, presentation)
            return actions.answer(
                state, trial, message.client, message.answers, at, browser=browser, telemetry=telemetry
            )

        came = time.perf_counter()
        try:
            event = await self.commit(make)
        except RefusedError as error:
            raise NotNowError(str(error)) from None
        return {"accepted": message.trial, "again": event is None}

    async def press(self, what: str, message: Press, page: str | None) -> None:
        """A participant's button, or their page's sign of life. Raises `NotNowError`."""
        self._check_page(page)
        try:
            if what == "here":
                self.watchers.alive(page)
            elif what == "break":
                await self.commit(lambda state, at: actions.pause(state, "participant", at))
            elif what == "more":
                await self.commit(actions.more)
            elif self.state.screen == "ready":
                await self.commit(actions.go_on)
            elif not self.begun:
                self.begun = True
                self.runner.wake()
        except RefusedError as error:
            raise NotNowError(str(error)) from None

    async def command(self, what: str, message: Command) -> dict[str, Any]:
        """An experimenter's command. Raises `NotNowError`."""
        return await commands.carry_out(self, what, message)

    async def map(self) -> dict[str, Any] | None:
        """Slices of the posterior, made once for each state of the answers; None where there is nothing to show, empty
        while they are being prepared."""
        state = self.state
        version = views.map_version(state)
        if self._blinds:
            return None
        if self._maps is None:
            return {}
        if self._map is None or self._map[0] != version:
            self._map = version, await self._loop.run_in_executor(self._drawing, self._maps.slices, state)
            self.trust = await self._loop.run_in_executor(self._drawing, self._maps.trust, state)
            self.publish()
        return self._map[1]

    @property
    def _blinds(self) -> bool:
        """Whether the experimenter is not to know the parameters."""
        stimulus = self.state.study.stimulus
        return stimulus is not None and "experimenter" not in stimulus.shown_to

    @property
    def draws(self) -> bool:
        """Whether there are slices to be had."""
        return self._maps is not None

    def _check_page(self, page) -> None:
        if not self.watchers.counts(page):
            raise NotNowError(self.state.study.session.text("moved"))

    def _trial_of(self, name: str) -> tuple[int, int]:
        tag, _, numbers = name.rpartition(":")
        trial, _, presentation = numbers.partition(".")
        if tag != self.tag or not (trial.isdecimal() and presentation.isdecimal() and len(numbers) < 16):
            raise NotNowError("This trial is not of this session.")
        return int(trial), int(presentation)

    # What the rig's thread tells.

    def _from_rig(self, seen: Snapshot) -> None:
        self._loop.call_soon_threadsafe(self._interruptions.device_changed, seen)

    def _noticed(self, sentence: str) -> None:
        self._loop.call_soon_threadsafe(self.publish)
