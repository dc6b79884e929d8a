"""The hub of a live session, the only place that changes it: it owns the log, the state, the rig and the chooser.

    page or program --> answer / press / command --> event --> log (fsync) --> state --> views to all pages

Events are made one at a time, and an event counts only once it is on the disk: then the state advances, the sender gets
its response, and the next trial is proposed. In addition to the event loop there are threads for the disk, a device
(`device_rig`), the choice of trials and the map. `runner` presents the trials, `interruptions` handles what interrupts
them.
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
from hilbo.app.rigs.rig import Notice, Rig, Snapshot
from hilbo.app.wire.messages import Answer, Command, Press
from hilbo.app.wire.security import Role
from hilbo.app.wire.watchers import Watchers
from hilbo.session.log import actions
from hilbo.session.log.event_log import LogError, LogLostError
from hilbo.session.log.records import Event, RefusedError
from hilbo.session.log.state import LiveSession

__all__ = ["PRESSES", "Hub"]

_WHY = 200  # characters of an error
_RECENT = 200  # events and notices that the experimenter's page may show
PRESSES = ("begin", "break", "more", "here")
Result = TypeVar("Result")


class Hub:
    """A live session. `log` is its open `EventLog`, which it does not close; `chooser` proposes trials;
    `connect(changed, notice)` makes the rig, which calls `changed` with each new snapshot and `notice` with each
    sentence that a device sends unasked; `maps(chooser)` makes the `Maps`, None for a session without a map.

    `invite`, once set, makes a new link for a role; `observe`, once set, is called with the state before each event of
    the log, the event, and the state after it, and must neither raise nor wait; `settle`, once set, is called when
    everything is compiled, before anything is presented; `gap` (s) is the pause between two trials; `tag` is the prefix
    of the trials' names in browsers.
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
        self.begun = False  # whether the participant has pressed Begin, since the server started or the page came back
        self.alert: str | None = None
        self.lost = False  # whether the log's file is lost: the session has ended
        self.without_map = ""  # why, in a sentence
        self.trust: list[list[str]] = []
        self.recent: deque = deque(reversed(log.before[-_RECENT:]), maxlen=_RECENT)
        self.delays: list[dict[str, float]] = []  # s, from each answer on
        self.invite: Callable[[Role], dict[str, str]] | None = None
        self.observe: Callable[[LiveSession, Event, LiveSession], None] = lambda before, event, after: None
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
        """Connect the rig (in a thread), start to compile (in another), log the rig's state, start to watch for
        interruptions and to present. Raises `InputError` or `DeviceError` if the rig cannot be connected."""
        self._lock, self._loop = asyncio.Lock(), asyncio.get_running_loop()
        rig = await self._loop.run_in_executor(self._disk, lambda: self._connect(self._from_rig, self._noticed))
        self._rig = rig
        self._warming = self._loop.run_in_executor(self.compute, self._warm)
        self._warming.add_done_callback(self._warmed)
        await self._interruptions.begin(rig.snapshot)
        self.runner.restart()

    def _warm(self) -> None:
        """Compile what choosing and the map need; called in the thread of the choices. If the map fails, `without_map`
        says why and the session has no map; what the chooser raises is raised."""
        self.chooser.warm()
        if self._make_maps is None:
            return
        try:
            maps = self._make_maps(self.chooser)
            maps.warm()
            self._maps = maps
        except Exception as error:  # any error: a person is waiting, and the session needs no map
            why = " ".join(str(error).split())[:_WHY]
            self.without_map = f"There will be no map ({why}); the session goes on without it."

    def _warmed(self, warm: asyncio.Future) -> None:
        """Call `settle` and notify the pages: the callback at the end of compilation, also if that failed, but not if
        it was cancelled."""
        if warm.cancelled():  # the session ends before it
            return
        self.settle()
        self.publish()

    async def close(self) -> None:
        """End the session's work: stop watching and presenting, end all streams, close the rig and the hub's threads.
        The log stays open. Raises `LogError`, after all that, if the log lacks events of the device."""
        try:
            await self._interruptions.end()
        finally:
            await self._close()

    async def _close(self) -> None:
        """`close`, without the end of watching."""
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
        """The rig, which presents the renderings; only after `open`."""
        assert self._rig is not None
        return self._rig

    @property
    def warm(self) -> asyncio.Future:
        """The future of the compilation, done when everything is compiled; only after `open`."""
        assert self._warming is not None
        return self._warming

    # Events.

    @property
    def fault(self) -> str | None:
        """What fails in watching for interruptions, as a sentence; None while all works."""
        return self._interruptions.fault

    async def commit(self, make: Callable[[LiveSession, float], Any], *, mine: bool = False) -> Any:
        """Call `make(state, time in s since the epoch)` with the newest state, write the event that it makes to the
        log, apply it, notify the pages, and return it; None, with nothing written, if it makes none. One commit runs at
        a time.

        The runner is restarted if the event changes the next presentation, unless `mine` says that the runner itself
        asks. Raises what `make` raises (`RefusedError`), and `LogError` if the event is not on the disk. A cancelled
        caller does not cancel the commit, so that log and state always agree.
        """
        return await asyncio.shield(asyncio.ensure_future(self._commit(make, mine)))

    async def _commit(self, make, mine):
        """Carry out `commit`, with the same arguments; cancelled with its caller. After an answer it also gives the
        runner the times from which the delay to the next rendering is computed."""
        assert self._lock is not None
        async with self._lock:
            event = make(self.state, time.time())
            if event is None:
                return None
            before, key = self.state, self.runner.key()
            self.state = await self._on_disk(self.log.append, event)
            self.observe(before, event, self.state)
            self.alert = None
            self.recent.appendleft(event)
            if event.kind == "answer":
                self.runner.clock = {"came": self._came, "logged": time.perf_counter(), "fsync": self.log.sync_s}
        if not mine and self.runner.key() != key:
            self.runner.restart()
        self.publish()
        return event

    async def check_log(self) -> None:
        """Check that the log's file is still the open log (`EventLog.check`). If it is not, set `lost` and `alert` and
        restart the runner, which then presents nothing; raises nothing."""
        assert self._lock is not None
        async with self._lock:
            with contextlib.suppress(LogLostError):
                await self._on_disk(self.log.check)

    async def _on_disk(self, work: Callable[..., Result], *arguments: object) -> Result:
        """Return the result of `work(*arguments)`, called in the disk's thread. A `LogError` is shown to the
        experimenter (`alert`) and raised again; the first `LogLostError` also sets `lost` and restarts the runner."""
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
        """End all streams of views and all waiting requests of the rig, since the server ends."""
        self.watchers.end_all()
        if self._rig is not None:
            self._rig.hang_up()

    def publish(self) -> None:
        """Notify all open pages and programs that there is a newer view."""
        self.watchers.tell()

    # What pages and programs ask for.

    def text(self, key: str) -> str:
        """The participant's text for a key, in the study's own words or language."""
        return self.state.study.session.text(key)

    def view(self, role: Role) -> dict[str, Any]:
        """What a role may see now, as a dict for JSON; without parameters for a blind experimenter, and empty for a
        stimulus program or preparer, who receive orders instead."""
        if role == "participant":
            return views.participant(self)
        if role != "experimenter":  # who presents is given orders, and has no view
            return {}
        seen = views.experimenter(self)
        return blind.experimenter(self, seen) if self._blinds else seen

    async def answer(self, message: Answer, page: str | None) -> dict[str, Any]:
        """Log a participant's answer. Returns {"accepted": name of the trial, "again": whether this same answer was in
        the log before}, once it is on the disk. `page`: id of the browser window, None for a program. Raises
        `NotNowError` for a window that is not the newest, a trial of another session, and an answer that is refused;
        `LogError`."""
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
        """Carry out a participant's button `what`: "break", "more" (another warm-up trial), "here" (sign of life of the
        page), else begin: start the next block after the warm-up, or else let the runner present. `page` as in
        `answer`. Raises `NotNowError`, also for a button that was pressed during another trial or presentation than the
        present one; `LogError`."""
        self._check_page(page)
        if what == "here":
            self.watchers.alive(page)
            return
        if message.trial not in (None, views.trial_name(self)):
            raise NotNowError(
                "The button was pressed during another trial, or before this one began again; look again."
            )
        try:
            if what == "break":
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
        """Carry out an experimenter's command and return the response (`commands.carry_out`). Raises `NotNowError`,
        `InputError`, `LogError`."""
        return await commands.carry_out(self, what, message)

    async def map(self) -> dict[str, Any] | None:
        """Slices of the posterior (`Maps.slices`), computed once for each state of the answers and the pending trial;
        then `trust` is computed too, and the pages are notified. None if the experimenter is blind or no trials are
        chosen; empty while there is no compiled map."""
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
        """Whether the experimenter must not see parameters: the study has a [stimulus] that is not shown to them."""
        stimulus = self.state.study.stimulus
        return stimulus is not None and "experimenter" not in stimulus.shown_to

    @property
    def draws(self) -> bool:
        """Whether the map is compiled, so that slices are available."""
        return self._maps is not None

    def _check_page(self, page: str | None) -> None:
        """Raise `NotNowError` unless the participant's window `page` is the newest; None, a program, always passes."""
        if not self.watchers.counts(page):
            raise NotNowError(self.state.study.session.text("moved"))

    def _trial_of(self, name: str) -> tuple[int, int]:
        """Id and presentation of a trial, from its name in browsers, `tag:id.presentation`. Raises `NotNowError` for
        another session's name, and for text of another form."""
        tag, _, numbers = name.rpartition(":")
        trial, _, presentation = numbers.partition(".")
        if tag != self.tag or not (trial.isdecimal() and presentation.isdecimal() and len(numbers) < 16):
            raise NotNowError("This trial is not of this session.")
        return int(trial), int(presentation)

    # Callbacks of the rig's thread.

    def _from_rig(self, seen: Snapshot) -> None:
        """Hand a new snapshot, from the rig's thread, to the event loop."""
        self._loop.call_soon_threadsafe(self._interruptions.device_changed, seen)

    def _noticed(self, sentence: str) -> None:
        """Show a sentence of the device, from the rig's thread, among the events of the experimenter's page."""
        self._loop.call_soon_threadsafe(self.recent.appendleft, Notice(time.time(), sentence))
        self._loop.call_soon_threadsafe(self.publish)
