"""The state of a live session as the fold of its events: pure, without files, clock or device.

`LiveSession.fold(study, header, events)` is the state after a log, so that resuming is replaying. Renderings are in the
events themselves: a fold computes no fit.

Rules: a trial in which the device holds, stops or is lost after it began is void, and is asked again; so is one in
which a program that presents did not present what it was asked for, which counts as a stop (`missed`). A repeated,
voided, undone or interrupted presentation starts from its first step, and so does one that a pause cut off. Whatever
changes the answers drops a proposal that was made from the old ones.

Twice: the device's stops count while a rendering is on, of that rendering alone; what a person voids never counts. In
a block that chooses, a rendering in which the device stopped twice is not proposed again: another one takes its place.
In a planned block stops count for each planned trial, whatever other trials hold the same set; one that was stopped
twice is put off to the end of its block, and asked there until it is answered, or until a person leaves it out
(`skip`) or ends the session. So every block reaches its quota, but for what a person left out or ended. A repetition
that was stopped twice is not asked again.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

from hilbo.errors import InputError
from hilbo.session.confirmed import counted
from hilbo.session.header_check import study_of
from hilbo.session.records import Event, Header, Need, RefusedError, Trial
from hilbo.study.study_file import AnyStudy

__all__ = ["STOPS", "LiveSession", "Screen"]

Screen = Literal["wait", "trial", "ready", "rest", "paused", "done", "ended"]
_STOPPED = ("hold", "estop", "lost")
STOPS = 2
"""So often may the device stop in a rendering before it is not proposed again, or its planned trial put off."""


@dataclass(frozen=True)
class LiveSession:
    """The state of a session; made by `start`, `after` and `fold`."""

    study: AnyStudy = field(repr=False)
    header: Header
    seq: int = 0
    trials: tuple[Trial, ...] = ()
    extra: Mapping[int, int] = field(default_factory=dict)  # block -> renderings asked for by "another one"
    passed: frozenset[int] = frozenset()  # blocks that were begun by hand
    wanted: tuple[int, ...] = ()  # answered trials to be felt once more
    paused: str | None = None
    aborted: str | None = None
    machine: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[tuple[float, str], ...] = ()
    began: float | None = None
    last: float | None = None

    @classmethod
    def start(cls, study: AnyStudy, header: Header) -> "LiveSession":
        """A session before its first event. Raises InputError if the header belongs to another study."""
        if header.study != study.hash:
            raise InputError(
                f"this session belongs to a study of hash {header.study}, the study file has {study.hash}; use the file"
                " that the session was started with."
            )
        return cls(study, header)

    @classmethod
    def fold(cls, study: AnyStudy, header: Header, events: Iterable[Event]) -> "LiveSession":
        """The state after these events."""
        state = cls.start(study, header)
        for event in events:
            state = state.after(event)
        return state

    def after(self, event: Event) -> "LiveSession":
        """The next state."""
        if event.seq != self.seq + 1:
            raise InputError(f"event {event.seq} does not follow event {self.seq}; the log is not in order.")
        apply = _APPLY.get(event.kind)
        if apply is None:
            raise InputError(f'event {event.seq} is of the kind "{event.kind}", which this hilbo does not know.')
        following = apply(self, event)
        began = event.time if self.began is None else self.began
        return replace(following, seq=event.seq, began=began, last=event.time)

    # What follows from the state.

    @cached_property
    def pending(self) -> Trial | None:
        """The trial that is being felt or asked about."""
        return next((t for t in reversed(self.trials) if t.status == "pending"), None)

    def answers(self, block: int) -> list[Trial]:
        """The trials of a block that count, in their order; repeats do not."""
        return [t for t in self.trials if t.block == block and t.status == "answered" and t.repeats is None]

    def quota(self, block: int) -> int:
        """How many trials of a block are needed."""
        return self.header.blocks[block].count + self.extra.get(block, 0)

    def stops(self, block: int) -> Counter[Any]:
        """How often the device stopped while a rendering was on: by the place in the plan, or, in a block that
        chooses, by the items of the rendering."""
        voided = ((t, t.voided) for t in self.trials if t.block == block)
        return Counter(_stop_key(t, side) for t, why in voided if why is not None for side in why["sides"])

    def excluded(self, block: int) -> list[dict[str, float]]:
        """Renderings in which the device stopped twice, of a block that chooses them; they are not proposed again."""
        if self.header.blocks[block].trials:
            return []
        return [dict(key) for key, count in self.stops(block).items() if count >= STOPS]

    def put_off(self, block: int) -> list[int]:
        """Planned trials without an answer that the device stopped twice; they come last."""
        if not self.header.blocks[block].trials:
            return []
        done = {t.planned for t in self.answers(block)} | set(self.skipped(block))
        return sorted(k for k, count in self.stops(block).items() if count >= STOPS and k not in done)

    def skipped(self, block: int) -> list[int]:
        """Planned trials without an answer that a person left out."""
        have = {t.planned for t in self.answers(block)}
        left_out = {t.planned for t in self.trials if t.block == block and t.status == "left out"}
        return sorted(k for k in left_out - have if k is not None)

    def _next_planned(self, block: int) -> int | None:
        """The next planned trial without an answer; None where the block has enough, or none is left."""
        if len(self.answers(block)) >= self.quota(block):
            return None
        done = {t.planned for t in self.answers(block)} | set(self.skipped(block))
        left = [i for i in range(len(self.header.blocks[block].trials)) if i not in done]
        stops = self.stops(block)
        return min(left, key=lambda i: (stops[i] if stops[i] >= STOPS else 0, i), default=None)

    def full(self, block: int) -> bool:
        """Whether a block has all its answers, or nothing more to ask."""
        if self.header.blocks[block].trials:
            return self._next_planned(block) is None
        return len(self.answers(block)) >= self.quota(block)

    @cached_property
    def block(self) -> int | None:
        """The first block that is not full; None after the last."""
        return next((i for i in range(len(self.header.blocks)) if not self.full(i)), None)

    def gate(self, block: int) -> Literal["ready", "rest"] | None:
        """What stands before a block until somebody goes on: the end of a warm-up, or a rest."""
        if block == 0 or block in self.passed:
            return None
        if self.header.blocks[block].rest > 0:
            return "rest"
        return "ready" if self.header.blocks[block - 1].phase == "warm-up" else None

    @cached_property
    def screen(self) -> Screen:
        """What the participant has in front of them."""
        if self.aborted is not None:
            return "ended"
        if self.paused is not None:
            return "paused"
        if self.pending is not None:
            return "trial"
        if self.wanted:
            return "wait"
        if self.block is None:
            return "done"
        return self.gate(self.block) or "wait"

    @cached_property
    def need(self) -> Need | None:
        """What is to be proposed now; None while a trial is pending or nothing is to be asked."""
        if self.screen != "wait":
            return None
        if self.wanted:
            source = self.trial(self.wanted[0])
            return Need(source.block, source.planned, source.id)
        assert self.block is not None
        planned = self._next_planned(self.block) if self.header.blocks[self.block].trials else None
        return Need(self.block, planned)

    def trial(self, id: int) -> Trial:
        """The trial of this id. Raises RefusedError."""
        if not 1 <= id <= len(self.trials):
            raise RefusedError("old-trial", f"there is no trial {id} in this session.")
        return self.trials[id - 1]

    def with_trial(self, id: int, **changes) -> "LiveSession":
        """With one trial changed."""
        trials = list(self.trials)
        trials[id - 1] = replace(trials[id - 1], **changes)
        return replace(self, trials=tuple(trials))

    def dropped(self) -> "LiveSession":
        """Without the pending proposal: the answers that it was made from have changed. Repeats come from none."""
        trial = self.pending
        return self if trial is None or trial.repeats else self.with_trial(trial.id, status="dropped", on=None)


# What each event does to the state.


def _proposed(state, event):
    data = event.data
    trial = Trial(
        data["id"], data["block"], data["trial"], data, event.time, planned=data["planned"], repeats=data["repeats"]
    )
    return replace(state, trials=(*state.trials, trial), wanted=_without(state.wanted, data["repeats"]))


def _sent(state, event):
    trial = state.trial(event.data["id"])
    side = event.data["side"]
    state = state.with_trial(trial.id, sent={**trial.sent, side: event.data})
    if state.study.stimulus is None:
        return state
    values = counted(study_of(state.study, state.header.blocks[trial.block].material), event.data["values"])
    return state.with_trial(trial.id, confirmed={**trial.confirmed, side: values})


def _stimulus(state, event):
    trial, show = state.trial(event.data["id"]), event.data["show"]
    if not event.data["on"]:
        return state.with_trial(trial.id, on=None)
    before = trial.felt if event.data["step"] > 0 else frozenset()  # the first step begins everything anew
    felt = before | ({show} & set(trial.renderings))
    return state.with_trial(trial.id, step=event.data["step"], on=show, felt=felt)


def _answered(state, event):
    data = event.data
    facts = {"seq": event.seq, "time": event.time, "browser": data["browser"]}
    return state.with_trial(
        data["id"], status="answered", values=data["values"], client=data["client"], answered=facts, on=None
    )


def _without(wanted: tuple[int, ...], id: int | None) -> tuple[int, ...]:
    """The trials to be felt once more without the first mention of one."""
    place = wanted.index(id) if id in wanted else len(wanted)
    return wanted[:place] + wanted[place + 1 :]


def _taken_out(state, trial, **changes):
    """An answer, or a proposal, does not count any more: what was made from it goes, and it is not repeated."""
    state = state.with_trial(trial.id, on=None, **changes)
    if trial.status != "answered" or trial.repeats:
        return state
    state = replace(state.dropped(), wanted=tuple(id for id in state.wanted if id != trial.id))
    return _without_pending_repeat(state, trial.id)


def _without_pending_repeat(state, id: int):
    """The repetition of a trial that is being felt goes."""
    pending = state.pending
    if pending is None or pending.repeats != id:
        return state
    return state.with_trial(pending.id, status="dropped", on=None)


def _counts(state, id: int) -> bool:
    """Whether the answer to this trial counts."""
    return state.trial(id).status == "answered"


def _undone(state, event):
    trial = state.trial(event.data["id"])
    state = _taken_out(state, trial, status="undone")
    again = trial.repeats and _counts(state, trial.repeats)
    return replace(state, wanted=(trial.repeats, *state.wanted)) if again else state


def _again(trial) -> dict[str, Any]:
    return {"presentation": trial.presentation + 1, "step": None, "on": None, "felt": frozenset(), "confirmed": {}}


def _repeated(state, event):
    trial = state.trial(event.data["id"])
    if trial.status == "pending":
        return state.with_trial(trial.id, **_again(trial))
    return replace(state, wanted=(*state.wanted, trial.id))


def _stop_key(trial: Trial, side: str) -> Any:
    """What a stop counts for."""
    return tuple(trial.renderings[side].items()) if trial.planned is None else trial.planned


def _made_void(state, trial, by, reason, sides=()):
    """`sides`: the one that was on when the device stopped. `asked_again`: whether a repetition is."""
    voided = {"by": by, "reason": reason, "sides": list(sides)}
    state = _taken_out(state, trial, status="void", voided=voided)
    if not trial.repeats:
        return state
    stops = state.stops(trial.block)
    stopped_twice = any(stops[_stop_key(trial, side)] >= STOPS for side in trial.renderings)
    again = not stopped_twice and _counts(state, trial.repeats)
    state = state.with_trial(trial.id, voided=voided | {"asked_again": again})
    return replace(state, wanted=(trial.repeats, *state.wanted)) if again else state


def _voided(state, event):
    return _made_void(state, state.trial(event.data["id"]), "experimenter", event.data["reason"])


def _skipped(state, event):
    voided = {"by": "experimenter", "reason": event.data["reason"], "sides": []}
    return state.with_trial(event.data["id"], status="left out", on=None, voided=voided)


def _restored(state, event):
    trial = state.trial(event.data["id"])
    again, state = trial.voided, state.with_trial(trial.id, status="answered", voided=None)
    if not trial.repeats:
        return state.dropped()
    if not again.get("asked_again"):
        return state
    if trial.repeats in state.wanted:
        return replace(state, wanted=_without(state.wanted, trial.repeats))
    return _without_pending_repeat(state, trial.repeats)


def _paused(state, event):
    trial = state.pending
    if trial is not None and trial.unfinished:
        state = state.with_trial(trial.id, **_again(trial))
    return replace(state, paused=event.data["by"])


def _device(state, event):
    data = event.data
    trial = state.pending if data["trial"] is None else state.trial(data["trial"])
    begun = trial is not None and trial.step is not None and trial.status in ("pending", "answered")
    if data["condition"] in _STOPPED and trial is not None and begun:
        reason = f"device: {data['condition']}" + (f" ({data['reason']})" if data.get("reason") else "")
        state = _made_void(state, trial, "rule", reason, {trial.on} & set(trial.renderings))
    return replace(state, machine=data)


def _missed(state, event):
    trial = state.trial(event.data["id"])
    reason = f"stimulus: {event.data['reason']}"
    return _made_void(state, trial, "rule", reason, {event.data["show"]} & set(trial.renderings))


_APPLY = {
    "propose": _proposed,
    "sent": _sent,
    "stimulus": _stimulus,
    "missed": _missed,
    "answer": _answered,
    "undo": _undone,
    "repeat": _repeated,
    "void": _voided,
    "skip": _skipped,
    "restore": _restored,
    "pause": _paused,
    "resume": lambda state, event: replace(state, paused=None),
    "abort": lambda state, event: replace(state, aborted=event.data["reason"]),
    "note": lambda state, event: replace(state, notes=(*state.notes, (event.time, event.data["text"]))),
    "more": lambda state, event: replace(
        state, extra={**state.extra, event.data["block"]: state.extra.get(event.data["block"], 0) + 1}
    ),
    "go_on": lambda state, event: replace(state, passed=state.passed | {event.data["block"]}),
    "device": _device,
}
