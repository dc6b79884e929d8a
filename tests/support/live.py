"""What tests of live sessions share: a small study, a chooser without fits, and a driver of all that can be done."""

import contextlib
import hashlib
import itertools
import json

from hilbo import Study
from hilbo.session.log import actions as live
from hilbo.session.log.records import Header, RefusedError
from hilbo.session.log.state import LiveSession
from hilbo.study.file.plan_file import Block, Planned

RAW = {
    "schema": 1,
    "study": {"name": "plain", "responses": ["different", "similar", "close"]},
    "parameters": {n: {"low": 0.0, "high": 1.0, "unit": ""} for n in ("u", "v")},
    "gp": {"theta": 10.0, "variance": 1.0, "thresholds": [-0.5, 0.5], "noise": 0.5},
    "selection": {"space_filling": 2, "trials": 6},
}
STUDY = Study.from_dict(RAW)
SETS = {name: {"u": 0.123456789 + i / 10, "v": 0.987654321 - i / 10} for i, name in enumerate("ABCDEF")}


def header(kind="optimisation", count=6, warm=2):
    warm_up = Block("warm-up", warm, tuple(Planned(name) for name in "ABCD"))
    if kind == "optimisation":
        block = Block("optimisation", count)
    else:
        pairs = [Planned(*pair, first) for pair in itertools.combinations("DEF", 2) for first in ("a", "b")]
        block = Block("validation", len(pairs), tuple(pairs), rest=0.0)
    study = {"study": STUDY.file.hash, "study_tables": STUDY.file.tables}
    return Header(**study, participant="P01", session="1", seed=0, blocks=(warm_up, block), sets=SETS)


class FakeChooser:
    """A point that depends on what a real choice depends on, and on nothing else; never an excluded one."""

    def choose(self, state, need):
        if need.repeats is not None:
            data = state.trial(need.repeats).data
            return {key: data[key] for key in ("renderings", "sets", "first") if key in data}
        if need.planned is not None:
            planned = state.header.blocks[need.block].trials[need.planned]
            sets = {"a": planned.a} | ({"b": planned.b} if planned.b else {})
            renderings = {side: state.header.sets[name] for side, name in sets.items()}
            return {"sets": sets, "first": planned.first, "renderings": renderings}
        gone = state.excluded(need.block)
        told = [(t.renderings["a"], t.values["class_a"]) for t in state.answers(need.block)]
        told.append(state.header.seed)
        for salt in itertools.count():
            text = json.dumps([told, salt, need.block])
            u = int(hashlib.sha256(text.encode()).hexdigest()[:8], 16) / 2**32
            point = {"u": u, "v": 1 - u}
            if point not in gone:
                return {"renderings": {"a": point}}


CHOOSER = FakeChooser()


def beginning(state, id, step, at, values=None):
    """The events with which a step begins: what it renders is confirmed, and then it is on."""
    trial, events = state.trial(id), []
    show = state.steps_of(trial)[step][0]
    if show in trial.renderings:
        confirmed = values or {name: trial.renderings[show][name] for name in state.study.space.names}
        events.append(live.sent(state, id, show, at, values=confirmed))
        state = state.after(events[0])
    return [*events, live.present(state, id, step, True, at)]


KINDS = (
    "go",
    "feel",
    "feel",
    "answer",
    "answer",
    "answer",
    "twice",
    "undo",
    "void",
    "void old",
    "restore",
    "repeat",
    "again",
    "pause",
    "resume",
    "note",
    "more",
    "hold",
    "hold early",
    "lost",
    "abort",
)


class Driver:
    """Does things to a session, as far as they can be done; keeps the events."""

    def __init__(self, kind="optimisation"):
        self.header = header(kind)
        self.state, self.events, self.clock = LiveSession.start(STUDY.file, self.header), [], 0.0
        self.accepted = {}

    def log(self, event):
        if event is not None:
            self.events.append(event)
            self.state = self.state.after(event)

    def step(self):
        """What the machine does by itself: a proposal where one is due."""
        if self.state.need is not None:
            self.log(live.propose(self.state, CHOOSER, self.clock))

    def do(self, kind, number):
        self.clock += 1.0
        with contextlib.suppress(RefusedError):
            self._do(kind, number)
        self.step()

    def _do(self, kind, number):
        state, at, pending = self.state, self.clock, self.state.pending
        if kind == "go":
            self.log(live.go_on(state, at))
        elif kind == "feel" and pending:
            self.feel(pending)
        elif kind == "answer" and pending:
            values = self.values(pending, number)
            flags = {"samples": 8} | ({"slewed": 1, "saturated": 2} if number % 2 else {})
            telemetry = None if number % 3 == 1 else flags
            client = f"c{len(self.events)}"
            self.log(live.answer(state, pending.id, client, values, at, telemetry=telemetry, felt=False))
            self.accepted[pending.id] = values
        elif kind == "twice" and self.accepted:
            trial = list(self.accepted)[number % len(self.accepted)]
            client = state.trial(trial).client
            assert live.answer(state, trial, client, self.accepted[trial], at) is None
        elif kind == "undo":
            self.log(live.undo(state, at))
        elif kind == "void" and pending:
            self.log(live.void(state, pending.id, "noise", at))
        elif kind in ("void old", "restore", "again") and state.trials:
            trial = 1 + number % len(state.trials)
            act = {"void old": lambda: live.void(state, trial, "late", at)}
            act["restore"] = lambda: live.restore(state, trial, at)
            act["again"] = lambda: live.repeat(state, at, trial)
            self.log(act[kind]())
        elif kind == "repeat":
            self.log(live.repeat(state, at))
        elif kind == "hold" and pending:
            self.feel(pending, off=False)
            self.log(live.device(self.state, "hold", at, reason="speed"))
        elif kind in ("hold early", "lost"):
            self.log(live.device(state, kind.split()[0], at))
        elif kind == "abort" and number % 7 == 0:
            self.log(live.abort(state, "fire alarm", at))
        elif kind == "pause":
            self.log(live.pause(state, "participant", at))
        elif kind == "resume":
            self.log(live.resume(state, at))
        elif kind == "note":
            self.log(live.note(state, "a door", at))
        elif kind == "more":
            self.log(live.more(state, at))

    def values(self, trial, number):
        labels = STUDY.responses
        if "b" not in trial.renderings:
            return {"class_a": labels[number % 3]}
        return {"class_a": labels[number % 3], "class_b": labels[number // 3 % 3], "preferred": "ab"[number % 2]}

    def begin(self, trial, step):
        for event in beginning(self.state, trial.id, step, self.clock):
            self.log(event)

    def feel(self, trial, off=True):
        for step in range(len(self.state.steps_of(trial))):
            self.begin(trial, step)
            if off:
                self.log(live.present(self.state, trial.id, step, False, self.clock))

    def finish(self):
        """Answer whatever is asked, to the end."""
        self.step()
        for number in range(200):
            if self.state.screen in ("done", "ended"):
                return
            kind = {"ready": "go", "rest": "go", "paused": "resume", "trial": "answer"}[self.state.screen]
            self.do(kind, number)
        raise AssertionError("the session does not come to its end")
