"""The state of a live session, computed from its events: pure, without files, clock or device.

`LiveSession.fold(study, header, events)` is the state after a log. A session that is resumed is computed event by
event, each checked against the state before it (`replay.replayed`). Renderings are in the events, so no fit is
computed. `hilbo.session.log.transitions` defines the effect of each event.

Stops of the device count while a rendering is on, for that rendering only; what a person voids never counts. After two
stops: in a block that chooses its renderings, that rendering is not proposed again, and another one takes its place; in
a planned block, where stops count per planned trial, the trial is put off to the end of its block, and asked there
until it is answered, left out by a person (`skip`), or the session ends. So every block reaches its quota, except for
what a person left out or ended.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from operator import itemgetter
from typing import Any, Literal

from hilbo.errors import InputError
from hilbo.session.log.header_check import protocol_of
from hilbo.session.log.records import PAUSE, Event, Header, Need, Pause, RefusedError, Trial, WarmUp
from hilbo.session.log.transitions import APPLY, STOPS, stop_key
from hilbo.study.file.reading import StudyFile

__all__ = ["LiveSession", "Screen"]

Screen = Literal["wait", "trial", "ready", "rest", "paused", "done", "ended"]


@dataclass(frozen=True)
class LiveSession:
    """The state of a session, immutable; created by `start`, `after` and `fold`."""

    study: StudyFile = field(repr=False)
    header: Header
    seq: int = 0
    trials: tuple[Trial, ...] = ()
    extra: Mapping[int, int] = field(default_factory=dict)  # block -> stimuli requested by "another one"
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
        """State before the first event. Raises InputError if the header belongs to another study."""
        if header.study != study.hash:
            raise InputError(
                f"this session belongs to a study of hash {header.study}, the study file has {study.hash}; use the file"
                " that the session was started with."
            )
        return cls(study, header)

    @classmethod
    def fold(cls, study: StudyFile, header: Header, events: Iterable[Event]) -> "LiveSession":
        """State after these events, which are not checked beyond `after`. Raises InputError."""
        state = cls.start(study, header)
        for event in events:
            state = state.after(event)
        return state

    def after(self, event: Event) -> "LiveSession":
        """Next state, after an event. Raises InputError for an event whose number does not follow, or of an unknown
        kind."""
        if event.seq != self.seq + 1:
            raise InputError(f"event {event.seq} does not follow event {self.seq}; the log is not in order.")
        apply = APPLY.get(event.kind)
        if apply is None:
            raise InputError(f'event {event.seq} is of the kind "{event.kind}", which this hilbo does not know.')
        following = apply(self, event)
        began = event.time if self.began is None else self.began
        return replace(following, seq=event.seq, began=began, last=event.time, **self._activity(event))

    def _activity(self, event: Event) -> dict[str, Any]:
        """Changed fields `active` and `pauses` after an event of a presentation or an answer; empty for other events. A
        time of at least `PAUSE` since the last activity, with no step on, is recorded as a pause."""
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
        """The trial that is being presented or waits for its answer; None if there is none."""
        return next((t for t in reversed(self.trials) if t.status == "pending"), None)

    def answers(self, block: int) -> list[Trial]:
        """Answered trials of a block, in their order; without repetitions."""
        return [t for t in self.trials if t.block == block and t.status == "answered" and t.repeats is None]

    def counted(self, block: int) -> list[Trial]:
        """The answered trials that count towards a block's quota: of a repeated warm-up only those since then."""
        after = self.again.trials if self.again is not None and self.again.block == block else 0
        return [t for t in self.answers(block) if t.id > after]

    def warm_up(self, block: int) -> int | None:
        """Index of the last warm-up among the blocks up to this one; None if there is none."""
        phases = [b.phase for b in self.header.blocks[: block + 1]]
        return max((i for i, phase in enumerate(phases) if phase == "warm-up"), default=None)

    def warms_up_again(self, at: float) -> bool:
        """Whether the study repeats the warm-up now, after a pause that lasts until the time `at` (s since the
        epoch)."""
        after, here = self.study.session.warm_up_after_pause, self.block
        if after is None or here is None or self.active is None or self.screen not in ("trial", "wait"):
            return False
        known = self.again is not None and self.again.time >= self.active
        return at - self.active >= after and not known and self.warm_up(here) is not None

    def quota(self, block: int) -> int:
        """Number of answers that a block needs, including those added by "another one"."""
        return self.header.blocks[block].count + self.extra.get(block, 0)

    def stops(self, block: int) -> Counter[Any]:
        """Number of stops while a rendering was on, and of missed stimuli: by planned trial (index), or in a block that
        chooses by rendering (items)."""
        voided = ((t, t.voided) for t in self.trials if t.block == block)
        return Counter(stop_key(t, side) for t, why in voided if why is not None for side in why["sides"])

    def excluded(self, block: int) -> list[dict[str, float]]:
        """Renderings of a block that chooses, in which the device stopped twice or more, fewest stops first; empty for
        a planned block. They are not proposed again while there are others."""
        if self.header.blocks[block].trials:
            return []
        return [dict(key) for key, count in sorted(self.stops(block).items(), key=itemgetter(1)) if count >= STOPS]

    def put_off(self, block: int) -> list[int]:
        """Indices of planned trials without an answer that the device stopped twice, and that come last in their block;
        empty for a block that chooses."""
        if not self.header.blocks[block].trials:
            return []
        done = {t.planned for t in self.counted(block)} | set(self.skipped(block))
        return sorted(k for k, count in self.stops(block).items() if count >= STOPS and k not in done)

    def skipped(self, block: int) -> list[int]:
        """Indices of planned trials that a person left out and that have no answer, sorted."""
        have = {t.planned for t in self.answers(block)}
        left_out = {t.planned for t in self.trials if t.block == block and t.status == "left out"}
        return sorted(k for k in left_out - have if k is not None)

    def _next_planned(self, block: int) -> int | None:
        """Index of the next planned trial of a block that is neither answered nor skipped, those put off last; None if
        the block has enough answers, or none is left."""
        if len(self.counted(block)) >= self.quota(block):
            return None
        done = {t.planned for t in self.counted(block)} | set(self.skipped(block))
        left = [i for i in range(len(self.header.blocks[block].trials)) if i not in done]
        stops = self.stops(block)
        return min(left, key=lambda i: (stops[i] if stops[i] >= STOPS else 0, i), default=None)

    def full(self, block: int) -> bool:
        """Whether a block has all its answers, or no more trials to ask."""
        if self.header.blocks[block].trials:
            return self._next_planned(block) is None
        return len(self.counted(block)) >= self.quota(block)

    @cached_property
    def block(self) -> int | None:
        """Index of the first block that is not full; None after the last."""
        return next((i for i in range(len(self.header.blocks)) if not self.full(i)), None)

    def gate(self, block: int) -> Literal["ready", "rest"] | None:
        """Screen that is shown before a block until it is continued: "ready" after a warm-up, "rest" before a block
        with a rest; None for the first block, and once it was passed."""
        if block == 0 or block in self.passed:
            return None
        if self.again is not None and self.again.following == block:
            return "ready"
        if self.header.blocks[block].rest > 0:
            return "rest"
        return "ready" if self.header.blocks[block - 1].phase == "warm-up" else None

    @cached_property
    def screen(self) -> Screen:
        """The screen that the participant page shows."""
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
        """The proposal that is due, wanted repetitions first; None while a trial is pending or nothing is to be
        asked."""
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
        """The trial with this id (from 1). Raises RefusedError if there is none."""
        if not 1 <= id <= len(self.trials):
            raise RefusedError("old-trial", f"there is no trial {id} in this session.")
        return self.trials[id - 1]

    def steps_of(self, trial: Trial) -> list[tuple[str, float]]:
        """Steps of a trial: (stimulus, duration in s); a and b are swapped if b is presented first."""
        steps = protocol_of(self.study, self.header.blocks[trial.block]).steps
        other = {"a": "b", "b": "a"} if trial.first == "b" else {}
        return [(other.get(step.show, step.show), step.seconds) for step in steps]

    @cached_property
    def skippable(self) -> Trial | None:
        """The pending trial, if it may be left out (`actions.skip`): planned, and stopped twice; else None."""
        trial = self.pending
        good = trial is not None and trial.repeats is None and trial.planned in self.put_off(trial.block)
        return trial if good else None

    @cached_property
    def last_answered(self) -> Trial | None:
        """The trial that was answered last, among those that count, also repetitions: `undo` takes it back. None if
        there is none."""
        given = [t for t in self.trials if t.status == "answered"]
        return max(given, key=lambda t: t.answered["seq"] if t.answered else 0, default=None)

    @cached_property
    def voidable(self) -> Trial | None:
        """The trial that an experimenter's "void" refers to: the pending one if its presentation has begun, else the
        newest answered one; None if there is neither."""
        if self.pending is not None and self.pending.step is not None:
            return self.pending
        return next((t for t in reversed(self.trials) if t.status == "answered"), None)

    def with_trial(self, id: int, **changes) -> "LiveSession":
        """Copy of the state in which trial `id` has these fields changed."""
        trials = list(self.trials)
        trials[id - 1] = replace(trials[id - 1], **changes)
        return replace(self, trials=tuple(trials))

    def dropped(self) -> "LiveSession":
        """Copy of the state without the pending proposal, since the answers that it was based on have changed; a
        pending repetition stays."""
        trial = self.pending
        return self if trial is None or trial.repeats else self.with_trial(trial.id, status="dropped", on=None)
