"""The task that presents trials: propose, prepare, present step by step, wait for the answer.

It is restarted whenever an event changes the next presentation (an answer, a break, an undo, a HOLD …). The rig
prepares a rendering while the reference or nothing is presented, and a step begins when the rig reports that it is
presented. Nothing is presented before Begin, nor during compilation; otherwise the rig rests. A hand that blocks the
start of a rendering is asked to leave; if it stays, the presentation is interrupted. During a presentation the next
proposal is computed for every possible answer, so that after the answer it is only looked up.
"""

import asyncio
import contextlib
import time
from collections.abc import Sequence
from concurrent.futures import Future
from typing import Any, no_type_check

from hilbo.app.hub.interruptions import interrupt
from hilbo.app.interface import HubInterface
from hilbo.app.rigs.rig import Loaded, MissedError, Showing
from hilbo.session.log import actions
from hilbo.session.log.records import Event, RefusedError, Trial

__all__ = ["Runner"]

_LATER = 1.0  # s until what the device refused is tried again
_SOON = 0.05  # s
_HAND = 0.15  # s in contact before the page asks the hand to leave
_LEAVES = 20.0  # s that it may stay after that, until the presentation is interrupted


class HandError(RuntimeError):
    """The participant's hand did not leave the device in time."""


class Runner:
    """The task of a `Hub` that presents trials. `stage`: what it does now ("idle", "choosing", "hello", "between",
    "let-go", "showing", "step", "answer" or "trouble"); `step`: index of the step that is presented; `ends`: when that
    step ends (s, monotonic); `trouble`: why it does not continue."""

    hub: HubInterface

    @no_type_check  # at run time: a hub has no rig before it is opened, and no runner yet
    def __init__(self, hub: HubInterface):
        self.hub = hub
        self.stage, self.trouble = "idle", ""
        self.step: int | None = None
        self.ends = 0.0
        self.clock: dict[str, float] = {}
        self._task: asyncio.Task | None = None
        self._stop = asyncio.Event()
        self._asked: float | None = None  # time of the request to leave, monotonic
        self._in_force: tuple[int, int, str] | None = None
        self._showing: Showing | None = None  # the last request
        self._differs = False  # whether the rig ever presented another rendering than requested
        self._wake = asyncio.Event()
        self._ahead: Future | None = None
        self.fits_after = 0  # fits that a participant had to wait for

    def key(self) -> tuple:
        """What identifies the presentation due now: the screen, and id and presentation number of the pending trial.
        When it changes, the task restarts."""
        pending = self.hub.state.pending
        return self.hub.state.screen, pending and (pending.id, pending.presentation)

    def restart(self) -> None:
        """Cancel the present work and start a task that works from the current state."""
        self.cancel()
        self._stop = asyncio.Event()
        self._task = asyncio.create_task(self._run(self._stop))

    def cancel(self) -> None:
        """Cancel the present work, if any; the stage becomes "idle"."""
        self._stop.set()
        if self._task is not None:
            self._task.cancel()
            self._task = None
        self.stage, self.step, self._asked = "idle", None, None

    def wake(self) -> None:
        """Have the task check the condition that it waits for (Begin, or the rig) again."""
        self._wake.set()

    def forget(self) -> None:
        """Record that the rig has no active stimulus, so that the next one is prepared again."""
        self._in_force = None

    async def _run(self, stop: asyncio.Event) -> None:
        """Work until only an event from outside can change the state. A missed step voids its trial, a hand that stays
        interrupts the trial, an event that is refused has no consequence, any other error becomes `trouble`; then the
        task restarts itself, unless `stop` is set."""
        try:
            try:
                await self._lead()
            except MissedError as error:
                await self._missed(str(error))
                self._schedule_restart(stop)
            except HandError as error:
                await interrupt(self.hub, str(error))
        except RefusedError:  # the state has changed meanwhile, and with it the next step
            await asyncio.sleep(_SOON)
            self._schedule_restart(stop)
        except Exception as error:  # any error is shown to the experimenter, and it is tried again
            self.trouble = str(error) or type(error).__name__
            self._at("trouble")
            await asyncio.sleep(_LATER)
            self._schedule_restart(stop)

    async def _lead(self) -> None:
        """Propose and present trials until an answer or another event is awaited. The rig is set to rest unless a trial
        is due and Begin was pressed. With a lost log it only shows the trouble."""
        hub = self.hub
        if hub.lost:
            await hub.rig.rest()
            self.trouble = hub.alert or ""
            self._at("trouble")
            return
        if hub.state.screen not in ("wait", "trial") or not hub.begun:
            self.clock = {}  # what follows a rest does not follow an answer
            await hub.rig.rest()
        while hub.state.screen in ("wait", "trial"):
            if hub.state.screen == "wait":
                self._at("choosing")
                await self._propose()
            else:
                trial = hub.state.pending
                assert trial is not None  # as on the screen
                if await self._warm_up_due() or not await self._present(trial):
                    continue
                return
        self._at("idle")

    async def _warm_up_due(self) -> bool:
        """Whether the warm-up is due again after a long pause; if so, its event is committed."""
        if not self.hub.state.warms_up_again(time.time()):
            return False
        await self.hub.commit(actions.warm_up, mine=True)
        return True

    def _schedule_restart(self, stop: asyncio.Event) -> None:
        """Schedule a restart of the task, unless `stop` is set: then it was cancelled already."""
        if not stop.is_set():
            asyncio.get_running_loop().call_soon(self.restart)

    def _at(self, stage: str, step: int | None = None, seconds: float = 0.0) -> None:
        """Set the stage, the index of the step and its end, `seconds` from now; clear `trouble` unless the stage is
        "trouble"; notify the pages."""
        self.stage, self.step, self.ends = stage, step, time.monotonic() + seconds
        if stage != "trouble":
            self.trouble = ""
        self.hub.publish()

    async def _propose(self) -> None:
        """Choose the next trial in the thread of the choices and commit its proposal. Raises `RefusedError` if
        meanwhile another trial is due."""
        hub = self.hub
        state = hub.state
        loop = asyncio.get_running_loop()
        begun, fits = time.perf_counter(), getattr(hub.chooser, "fits", 0)
        event = await loop.run_in_executor(hub.compute, actions.propose, state, hub.chooser, time.time())
        if "came" in self.clock:
            self.fits_after += getattr(hub.chooser, "fits", 0) - fits

        def make(newest, at):
            if newest.seq == event.seq - 1:
                return event
            if newest.need != state.need or newest.trials != state.trials:
                raise RefusedError("nothing", "the next proposal has changed.")
            return Event(seq=newest.seq + 1, kind=event.kind, time=at, data=event.data)

        self.clock["chosen"] = time.perf_counter() - begun
        await hub.commit(make, mine=True)
        self.clock["proposed"] = time.perf_counter()

    async def _present(self, trial: Trial) -> bool:
        """Present the steps of a trial, after Begin and the pause between trials; returns once it can be answered, at
        once if all steps were presented before. Returns False, with the steps not presented, if the warm-up is due
        again."""
        hub = self.hub
        if trial.step is not None and not trial.unfinished:
            self._look_ahead()
            self._at("answer")
            return True
        steps = hub.state.steps_of(trial)
        await hub.rig.blank()
        await self._rig_ready()
        loading = self._loading(trial, _next_side(steps, 0))
        try:
            await asyncio.shield(hub.warm)  # a long arithmetic start, and a device that renders, do not go together
            while not hub.begun:
                self._wake.clear()
                self._at("hello")
                await self._wake.wait()
            if await self._warm_up_due():  # Begin was pressed long after
                return False
            if not self._differs:
                self._look_ahead()
            if hub.gap and trial.id > 1:
                self._at("between")
                await asyncio.sleep(hub.gap)
            for i, (show, seconds) in enumerate(steps):
                if show in trial.renderings:
                    await self._untouched(loading)
                elif i and loading.done():
                    loading = self._loading(trial, _next_side(steps, i))
                await self._step(trial, i, show, seconds)
            await hub.rig.blank()
        finally:
            loading.cancel()
        self._at("answer")
        return True

    async def _step(self, trial: Trial, i: int, show: Any, seconds: float) -> None:
        """Have the rig show step `i`, `show`, and present it for `seconds` s; its begin and end are logged. Raises
        `MissedError` if the rig cannot show it, `HandError`, `RefusedError`."""
        commit = self.hub.commit
        self._showing = self._showing_of(trial, i, show)
        shown = asyncio.ensure_future(self.hub.rig.show(self._showing))
        try:
            loaded = await self._untouched(shown)
        finally:
            shown.cancel()
        self._asked = None
        if loaded is not None:
            await self._log_in_force(trial, show, loaded)
        await commit(lambda state, at: actions.present(state, trial.id, i, True, at), mine=True)
        self._at("step", i, seconds)
        await asyncio.sleep(seconds)
        await commit(lambda state, at: actions.present(state, trial.id, i, False, at), mine=True)

    async def _untouched(self, work: asyncio.Future) -> Any:
        """The result of `work`, which waits until no hand touches the rig. While a hand stays, the stage is "let-go".
        Raises what `work` raises, and `HandError` once the hand has been asked to leave for `_LEAVES` s."""
        wait = _HAND
        while not (await asyncio.wait([work], timeout=wait))[0]:
            touched, now = self.hub.rig.snapshot.contact, time.monotonic()
            self._asked = (self._asked or now) if touched else None
            if self._asked is not None and now - self._asked > _LEAVES:
                raise HandError(
                    f"The participant did not release the device within {_LEAVES:g} s; the trial restarts after Begin"
                    " is pressed."
                )
            stage = "let-go" if touched else "showing"
            if self.stage != stage:
                self._at(stage)
            wait = _SOON
        return await work

    def _loading(self, trial: Trial, side: str | None) -> asyncio.Task:
        """A background task of `_load`; if it is not awaited, its exception is dropped."""
        task = asyncio.ensure_future(self._load(trial, side))
        task.add_done_callback(_retrieve_exception)
        return task

    async def _load(self, trial: Trial, side: str | None) -> None:
        """Have the rig prepare a side ("a" or "b") of a trial, and log it if the rig then has it active. Nothing for
        None, or for a side active already."""
        if side is None or self._in_force == (trial.id, trial.presentation, side):
            return
        self._in_force = None  # unknown until this one is
        showing = self._showing_of(trial, 0, side)
        loaded = await self.hub.rig.prepare(showing)
        if loaded is not None:
            await self._log_in_force(trial, side, loaded)
            self._in_force = (trial.id, trial.presentation, side)

    async def _log_in_force(self, trial: Trial, side: str, loaded: Loaded) -> None:
        """Log that a side is active, with the rig's facts, and record the delay. If the confirmed values differ from
        the requested ones, the proposals computed in advance are computed again."""
        self._note_times(loaded)
        await self.hub.commit(lambda state, at: actions.sent(state, trial.id, side, at, **loaded.facts), mine=True)
        now = self.hub.state.trial(trial.id)
        self._differs = self._differs or now.presented != now.renderings
        if self._differs:
            self._look_ahead()

    def _showing_of(self, trial: Trial, step: int, show: Any) -> Showing:
        """The request to the rig for a step: `show` is "a", "b", "reference" or "neutral"; without values for the last
        two."""
        material = self.hub.state.header.blocks[trial.block].material
        return Showing(trial.id, trial.presentation, step, show, trial.renderings.get(show), material)

    async def _missed(self, why: str) -> None:
        """Log that the last requested step was not presented, for the reason `why`, which voids its trial; a refusal is
        ignored. Then Begin must be pressed."""
        hub, showing = self.hub, self._showing
        assert showing is not None  # only a step can be missed
        with contextlib.suppress(RefusedError):
            await hub.commit(lambda state, at: actions.missed(state, showing.trial, showing.show, why, at), mine=True)
        hub.begun = False

    def _note_times(self, loaded: Loaded) -> None:
        """Append the times (s) from the last answer to this active stimulus, by part, to `hub.delays`, if it follows
        an answer; then forget that answer."""
        clock, now = self.clock, time.perf_counter()
        if {"came", "chosen", "proposed"} <= set(clock):
            parts = {"total": now - clock["came"], "fsync": clock["fsync"], "chosen": clock["chosen"]}
            self.hub.delays.append(parts | {"serial": loaded.took_s, "acknowledged": clock["logged"] - clock["came"]})
        self.clock = {}

    async def _rig_ready(self) -> None:
        """Wait until the rig is connected and not in HOLD or ESTOP; meanwhile the stage is "trouble"."""
        while True:
            seen = self.hub.rig.snapshot
            if seen.lost is None and seen.state not in ("HOLD", "ESTOP"):
                return
            self.clock = {}
            why = f": {seen.reason}" if seen.reason else ""
            self.trouble = seen.lost or f"The {self.hub.rig.title.lower()} is in {seen.state}{why}."
            self._at("trouble")
            self._wake.clear()
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._wake.wait(), _LATER)

    def _look_ahead(self) -> None:
        """Start to compute the next proposal for each possible answer, in the thread of the choices; it stops once
        another presentation is due."""
        hub = self.hub
        state, key = hub.state, self.key()
        self._ahead = hub.compute.submit(hub.chooser.lookahead, state, lambda: self.key() == key)


def _next_side(steps: Sequence[tuple[str, float]], i: int) -> str | None:
    """The first side, "a" or "b", among the steps (show, seconds) from index `i` on; None if there is none."""
    return next((show for show, _ in steps[i:] if show in ("a", "b")), None)


def _retrieve_exception(done: asyncio.Future) -> None:
    """Mark the exception of a task as retrieved, so that asyncio does not report it."""
    if not done.cancelled():
        done.exception()
