"""The state of a live session as the fold of its events: pure, without files, clock or device.

`LiveSession.fold(study, header, events)` is the state after a log. A session that is resumed is folded event by event,
each checked against the state before it (`replay.replayed`). Renderings are in the events: a fold computes no fit.
`hilbo.session.log.transitions` has what each event does.

Twice: the device's stops count while a rendering is on, of that rendering alone; what a person voids never counts. In
a block that chooses, a rendering in which the device stopped twice is not proposed again: another one takes its place.
In a planned block stops count for each planned trial, whatever other trials hold the same set; one that was stopped
twice is put off to the end of its block, and asked there until it is answered, or until a person leaves it out
(`skip`) or ends the session. So every block reaches its quota, but for what a person left out or ended.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from operator import itemgetter
from typing import Any, Literal

from hilbo.errors import InputError
from hilbo.session.log.records import PAUSE, Event, Header, Need, Pause, RefusedError, Trial, WarmUp
from hilbo.session.log.transitions import APPLY, STOPS, stop_key
from hilbo.study.file.protocols import protocol
from hilbo.study.file.reading import StudyFile

__all__ = ["LiveSession", "Screen"]

Screen = Literal["wait", "trial", "ready", "rest", "paused", "done", "ended"]


@dataclass(frozen=True)
class LiveSession:
    """The state of a session; made by `start`, `after` and `fold`."""

    study: StudyFile = field(repr=False)
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
    active: float | None = None  # the time of the last event of a presentation, or response
    pauses: tuple[Pause, ...] = ()
    again: WarmUp | None = None  # the last one

    @classmethod
    def start(cls, study: StudyFile, header: Header) -> "LiveSession":
        """A session before its first event. Raises InputError if the header belongs to another study."""
        if header.study != study.hash:
            raise InputError(
                f"this session belongs to a study of hash {header.study}, the study file has {study.hash}; use the file"
                " that the session was started with."
            )
        return cls(study, header)

    @classmethod
    def fold(cls, study: StudyFile, header: Header, events: Iterable[Event]) -> "LiveSession":
        """The state after these events."""
        state = cls.start(study, header)
        for event in events:
            state = state.after(event)
        return state

    def after(self, event: Event) -> "LiveSession":
        """The next state. Raises InputError for an event that does not follow, or of a kind that is not known."""
        if event.seq != self.seq + 1:
            raise InputError(f"event {event.seq} does not follow event {self.seq}; the log is not in order.")
        apply = APPLY.get(event.kind)
        if apply is None:
            raise InputError(f'event {event.seq} is of the kind "{event.kind}", which this hilbo does not know.')
        following = apply(self, event)
        began = event.time if self.began is None else self.began
        return replace(following, seq=event.seq, began=began, last=event.time, **self._activity(event))

    def _activity(self, event: Event) -> dict[str, Any]:
        """What an event of a presentation, or a response, changes: the last activity, and the pause before it."""
        if event.kind not in ("stimulus", "answer"):
            return {}
        id = event.data["id"]
        meanwhile = self.trial(id).on is not None if event.kind == "answer" else not event.data["on"]
        away = 0.0 if self.active is None or meanwhile else event.time - self.active
        ended = (Pause(event.seq, id, away),) if away >= PAUSE else ()
        return {"active": event.time, "pauses": self.pauses + ended}

    # What follows from the state.

    @cached_property
    def pending(self) -> Trial | None:
        """The trial that is being felt or asked about."""
        return next((t for t in reversed(self.trials) if t.status == "pending"), None)

    def answers(self, block: int) -> list[Trial]:
        """The trials of a block that count, in their order; repeats do not."""
        return [t for t in self.trials if t.block == block and t.status == "answered" and t.repeats is None]

    def counted(self, block: int) -> list[Trial]:
        """The answers that fill a block: of a warm-up that came again those since then, else all."""
        after = self.again.trials if self.again is not None and self.again.block == block else 0
        return [t for t in self.answers(block) if t.id > after]

    def warm_up(self, block: int) -> int | None:
        """The last warm-up among the blocks up to this one."""
        phases = [b.phase for b in self.header.blocks[: block + 1]]
        return max((i for i, phase in enumerate(phases) if phase == "warm-up"), default=None)

    def warms_up_again(self, at: float) -> bool:
        """Whether the study has the warm-up again after the pause that lasts until the time `at` (s)."""
        after, here = self.study.session.warm_up_after_pause, self.block
        if after is None or here is None or self.active is None or self.screen not in ("trial", "wait"):
            return False
        known = self.again is not None and self.again.time >= self.active
        return at - self.active >= after and not known and self.warm_up(here) is not None

    def quota(self, block: int) -> int:
        """How many trials of a block are needed."""
        return self.header.blocks[block].count + self.extra.get(block, 0)

    def stops(self, block: int) -> Counter[Any]:
        """How often the device stopped while a rendering was on: by the place in the plan, or, in a block that
        chooses, by the items of the rendering."""
        voided = ((t, t.voided) for t in self.trials if t.block == block)
        return Counter(stop_key(t, side) for t, why in voided if why is not None for side in why["sides"])

    def excluded(self, block: int) -> list[dict[str, float]]:
        """Renderings in which the device stopped twice, of a block that chooses them, those that stopped least often
        first; they are not proposed again while there are others."""
        if self.header.blocks[block].trials:
            return []
        return [dict(key) for key, count in sorted(self.stops(block).items(), key=itemgetter(1)) if count >= STOPS]

    def put_off(self, block: int) -> list[int]:
        """Planned trials without an answer that the device stopped twice; they come last."""
        if not self.header.blocks[block].trials:
            return []
        done = {t.planned for t in self.counted(block)} | set(self.skipped(block))
        return sorted(k for k, count in self.stops(block).items() if count >= STOPS and k not in done)

    def skipped(self, block: int) -> list[int]:
        """Planned trials without an answer that a person left out."""
        have = {t.planned for t in self.answers(block)}
        left_out = {t.planned for t in self.trials if t.block == block and t.status == "left out"}
        return sorted(k for k in left_out - have if k is not None)

    def _next_planned(self, block: int) -> int | None:
        """The next planned trial without an answer; None where the block has enough, or none is left."""
        if len(self.counted(block)) >= self.quota(block):
            return None
        done = {t.planned for t in self.counted(block)} | set(self.skipped(block))
        left = [i for i in range(len(self.header.blocks[block].trials)) if i not in done]
        stops = self.stops(block)
        return min(left, key=lambda i: (stops[i] if stops[i] >= STOPS else 0, i), default=None)

    def full(self, block: int) -> bool:
        """Whether a block has all its answers, or nothing more to ask."""
        if self.header.blocks[block].trials:
            return self._next_planned(block) is None
        return len(self.counted(block)) >= self.quota(block)

    @cached_property
    def block(self) -> int | None:
        """The first block that is not full; None after the last."""
        return next((i for i in range(len(self.header.blocks)) if not self.full(i)), None)

    def gate(self, block: int) -> Literal["ready", "rest"] | None:
        """What stands before a block until somebody goes on: the end of a warm-up, or a rest."""
        if block == 0 or block in self.passed:
            return None
        if self.again is not None and self.again.following == block:
            return "ready"
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
        warming = self.again is not None and self.again.block == self.block
        if self.wanted and not warming:
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

    def steps_of(self, trial: Trial) -> list[tuple[str, float]]:
        """What is felt and for how many seconds; a and b in the order of this trial."""
        steps = protocol(self.study.session, self.header.blocks[trial.block].phase).steps
        other = {"a": "b", "b": "a"} if trial.first == "b" else {}
        return [(other.get(step.show, step.show), step.seconds) for step in steps]

    @cached_property
    def skippable(self) -> Trial | None:
        """The trial that may be left out now."""
        trial = self.pending
        good = trial is not None and trial.repeats is None and trial.planned in self.put_off(trial.block)
        return trial if good else None

    @cached_property
    def last_answered(self) -> Trial | None:
        """The trial whose answer came last, of those that count: what `undo` takes back."""
        given = [t for t in self.trials if t.status == "answered"]
        return max(given, key=lambda t: t.answered["seq"] if t.answered else 0, default=None)

    @cached_property
    def voidable(self) -> Trial | None:
        """The trial that a person means who wants one void: the one being felt, or the newest answered one."""
        if self.pending is not None and self.pending.step is not None:
            return self.pending
        return next((t for t in reversed(self.trials) if t.status == "answered"), None)

    def with_trial(self, id: int, **changes) -> "LiveSession":
        """With one trial changed."""
        trials = list(self.trials)
        trials[id - 1] = replace(trials[id - 1], **changes)
        return replace(self, trials=tuple(trials))

    def dropped(self) -> "LiveSession":
        """Without the pending proposal: the answers that it was made from have changed. Repeats come from none."""
        trial = self.pending
        return self if trial is None or trial.repeats else self.with_trial(trial.id, status="dropped", on=None)
