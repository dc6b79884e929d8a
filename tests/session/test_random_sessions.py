"""Random sessions of every protocol, in which everything goes wrong that can: each reaches its quota or was ended by a
person, replaying its events gives the live state, and no answer counts twice."""

import contextlib
import functools
import itertools
import json
import subprocess
import sys
import zlib
from collections import Counter
from pathlib import Path

import msgspec
import numpy as np
import pytest
from live import RAW, beginning

from hilbo import Study
from hilbo.app.pages.session_views import experimenter_view, participant_view
from hilbo.session.log import actions as live
from hilbo.session.log.header import header_for
from hilbo.session.log.header_check import protocol_of
from hilbo.session.log.records import RefusedError
from hilbo.session.log.state import LiveSession
from hilbo.session.plan.plan import make_plan, planned_header

MATERIALS = ("foam", "soft", "hard")
STUDY = Study.from_dict(
    RAW
    | {"materials": {name: {} for name in MATERIALS}, "selection": {"space_filling": 2, "trials": 4}}
    | {"session": {"warm_up": {"count": 2}, "validation": {"count": 1}, "aggregate_best": {"count": 1}}}
)
PEOPLE = ("P1", "P2", "P3")
KINDS = ("optimisation", "three materials", "validation", "own maps", "aggregate-best", "no warm-up")


@functools.cache
def header_of(kind, person):
    """The header of a planned session."""
    if kind == "no warm-up":
        return header_for(STUDY.file, person, materials=("foam",), warm=False)
    materials = (
        ("soft",) if kind in ("optimisation", "own maps") else MATERIALS[: 3 if kind == "three materials" else 2]
    )
    phase = {"optimisation": kind, "aggregate-best": kind, "three materials": "optimisation"}.get(kind, "validation")
    names = [f"{p}{role}" for p in ("", *(f"{p} " for p in PEOPLE)) for role in ("best", "mid", "worst")]
    names += ["aggregate", "individual:P8", "individual:P9"]
    sets = {m: {n: {"u": i / 40, "v": j / 4} for i, n in enumerate(names)} for j, m in enumerate(materials)}
    source = "individual" if kind == "own maps" else "aggregate"
    plan = make_plan(STUDY.file, PEOPLE, 5, phase, materials=materials, sets=sets, source=source)
    return planned_header(plan, STUDY.file, person)


class Drawing:
    """Draws renderings from the answers that count and those not to be shown, as a real choice depends on them: points
    that are known in advance first, those without an answer that counts, then one for each history."""

    def choose(self, state, need):
        if need.repeats is not None:
            data = state.trial(need.repeats).data
            return {key: data[key] for key in ("renderings", "sets", "first") if key in data}
        if need.planned is not None:
            planned = state.header.blocks[need.block].trials[need.planned]
            sets = {side: name for side, name in (("a", planned.a), ("b", planned.b)) if name}
            renderings = {side: state.header.sets[name] for side, name in sets.items()}
            return {"sets": sets, "first": planned.first, "renderings": renderings}
        told = [(t.renderings["a"], t.values) for t in state.answers(need.block)]
        gone = [point for point, _ in told] + state.excluded(need.block)
        histories = itertools.chain(("first", "second"), ([told, salt] for salt in itertools.count()))
        points = (self.point(need.block, history) for history in histories)
        return {"renderings": {"a": next(point for point in points if point not in gone)}}

    def point(self, block, history):
        drawn = np.random.Philox(zlib.crc32(json.dumps([block, history]).encode())).random_raw(2) / 2.0**64
        return dict(zip("uv", drawn.tolist(), strict=True))


class Lab:
    """A session, what happens in it, and what its rules are held against, counted here once more."""

    def __init__(self, kind, rng):
        self.rng, self.header = rng, header_of(kind, PEOPLE[rng.integers(3)])
        self.state, self.events, self.clock = LiveSession.start(STUDY.file, self.header), [], 0.0
        self.stops, self.wished = Counter(), Counter()
        self.left_out = set()  # trials that a person left out
        self.stubborn = 1 if rng.random() < 0.2 else None

    def log(self, event):
        assert event is not None and event.seq == len(self.events) + 1
        self.events.append(event)
        self.state = self.state.after(event)

    def any_trial(self):
        return 1 + int(self.rng.integers(max(len(self.state.trials), 1)))

    def happens(self, what):
        """Something happens, if it can; then the machine proposes, where that is due."""
        self.clock += 1.0
        with contextlib.suppress(RefusedError):
            getattr(self, what)()
        if self.state.need is not None:
            self.propose()

    def propose(self):
        need, state = self.state.need, self.state
        self.log(live.propose(state, DRAWING, self.clock))
        if need.repeats is not None:
            assert state.trial(need.repeats).status == "answered"
        elif need.planned is None:
            point = self.state.pending.renderings["a"]
            assert self.stops[need.block, tuple(point.items())] < 2
            assert point not in [t.renderings["a"] for t in state.answers(need.block)]

    def feel(self):
        """Some of the steps, or all."""
        trial = self.state.pending
        if trial is None:
            return
        steps = self.state.steps_of(trial)
        last = len(steps) if self.rng.random() < 0.7 else int(self.rng.integers(1, len(steps) + 1))
        for step in range(last):
            for event in beginning(self.state, trial.id, step, self.clock):
                self.log(event)
            if step + 1 < last or self.rng.random() < 0.6:
                self.log(live.present(self.state, trial.id, step, False, self.clock))

    def answer(self):
        whole = self.rng.random() < 0.3  # of a script nobody feels the steps
        if whole:
            self.feel()
        trial = self.state.pending
        if trial is None:
            return
        asks = protocol_of(STUDY.file, self.header.blocks[trial.block]).asks
        values = {ask: "a" if ask == "preferred" else STUDY.responses[self.rng.integers(3)] for ask in asks}
        client = f"c{len(self.events)}"
        self.log(live.answer(self.state, trial.id, client, values, self.clock, felt=whole))
        assert live.answer(self.state, trial.id, client, values, self.clock) is None

    def stop(self):
        """The device holds, in whatever is on."""
        self.feel()
        self.device_stops(self.state.pending)

    def stop_late(self):
        """What the device did is written down only when something else has happened to the trial."""
        if self.state.trials:
            self.device_stops(self.state.trials[-1])

    def device_stops(self, trial):
        condition = ("hold", "estop", "lost")[self.rng.integers(3)]
        self.log(live.device(self.state, condition, self.clock, trial=None if trial is None else trial.id))
        if trial is not None and trial.on in trial.renderings:
            key = tuple(trial.renderings[trial.on].items()) if trial.planned is None else trial.planned
            self.stops[trial.block, key] += 1

    def missed(self):
        """A program does not present what it is asked for: a stop in that rendering."""
        trial = self.state.pending
        if trial is None:
            return
        steps = self.state.steps_of(trial)
        show = steps[self.rng.integers(len(steps))][0]
        self.log(live.missed(self.state, trial.id, show, "late", self.clock))
        if show in trial.renderings:
            key = tuple(trial.renderings[show].items()) if trial.planned is None else trial.planned
            self.stops[trial.block, key] += 1

    def again(self):
        trial = self.any_trial()
        later = self.state.trials and self.state.trial(trial).status == "answered"
        self.log(live.repeat(self.state, self.clock, trial))
        self.wished[trial] += bool(later)

    def begin_again(self):
        self.log(live.repeat(self.state, self.clock))

    def undo(self):
        self.log(live.undo(self.state, self.clock))

    def void(self):
        self.log(live.void(self.state, self.any_trial(), "a cough", self.clock))

    def restore(self):
        voided = [t.id for t in self.state.trials if t.status == "void" and t.values is not None]
        trial = voided[self.rng.integers(len(voided))] if voided else self.any_trial()
        self.log(live.restore(self.state, trial, self.clock))

    def pause(self):
        self.log(live.pause(self.state, "participant", self.clock))

    def resume(self):
        self.log(live.resume(self.state, self.clock))

    def more(self):
        self.log(live.more(self.state, self.clock))

    def go_on(self):
        self.log(live.go_on(self.state, self.clock))

    def skip(self):
        trial = self.state.pending
        self.log(live.skip(self.state, "it always stops", self.clock))
        self.left_out.add(trial.id)

    def abort(self):
        if self.rng.random() < 0.1:
            self.log(live.abort(self.state, "fire alarm", self.clock))

    def killed(self):
        """The server is killed, and goes on from the log: with the same trial."""
        resumed = LiveSession.fold(STUDY.file, self.header, self.events)
        assert resumed == self.state
        self.state = resumed

    def usual(self):
        """What happens next if nothing comes between; in some sessions a planned trial never comes to its end."""
        trial, screen = self.state.pending, self.state.screen
        if screen != "trial":
            return {"ready": "go_on", "rest": "go_on", "paused": "resume"}[screen]
        if trial.planned is None or trial.planned != self.stubborn:
            return "answer"
        return "skip" if self.state.skippable and self.rng.random() < 0.5 else "stop"

    def finish(self):
        """What is asked is answered, and now and then the device stops; the session comes to its end."""
        for _ in range(600):
            if self.state.screen in ("done", "ended"):
                return
            self.happens("stop" if self.rng.random() < 0.1 else self.usual())
        raise AssertionError("the session does not come to its end")

    def check(self):
        state = self.state
        assert LiveSession.fold(STUDY.file, self.header, self.events) == state
        for number, block in enumerate(self.header.blocks):
            answers, skipped = state.answers(number), state.skipped(number)
            known = {key: count for (where, key), count in self.stops.items() if where == number}
            assert state.stops(number) == known
            left_out = {t.planned for t in state.trials if t.block == number and t.id in self.left_out}
            assert set(skipped) <= left_out and all(known[key] >= 2 for key in skipped)
            if state.aborted is None:
                most = len(block.trials) - len(skipped) if block.trials else state.quota(number)
                assert len(answers) == min(state.quota(number), most)
            places = [t.planned if block.trials else tuple(t.renderings["a"].items()) for t in answers]
            assert len(set(places)) == len(places) <= state.quota(number)
            assert all(t.values is not None and t.client for t in answers)
        repeats = Counter(t.repeats for t in state.trials if t.repeats and t.status == "answered")
        assert all(count <= self.wished[source] for source, count in repeats.items())
        counted = sum(len(state.answers(i)) for i in range(len(self.header.blocks))) + repeats.total()
        assert counted <= sum(event.kind == "answer" for event in self.events)
        assert state.aborted is not None or not state.wanted
        keys = [(t.data["phase"], t.data["material"], t.number) for t in state.trials]
        assert len(set(keys)) == len(keys)
        msgspec.json.encode([experimenter_view(state), participant_view(state)])


DRAWING = Drawing()
HAPPENINGS = (
    *("feel", "answer", "answer", "answer", "answer", "answer", "go_on", "go_on", "stop", "stop", "stop_late"),
    "missed",
    *("again", "begin_again", "undo", "void", "void", "restore", "restore", "pause", "resume", "resume", "more"),
    *("skip", "abort", "killed"),
)


def held(seed, longest=45):
    """A random session, to its end; so many things happen at most before it goes on as usual."""
    rng = np.random.default_rng(seed)
    lab = Lab(KINDS[seed % len(KINDS)], rng)
    lab.propose()
    for what in rng.choice(HAPPENINGS, int(rng.integers(5, longest))):
        lab.happens(what)
    lab.finish()
    lab.check()
    return lab


def test_random_sessions_reach_their_quota_or_were_ended_by_a_person():
    labs = [held(seed, longest=25) for seed in range(60)]
    ends = Counter(lab.state.screen for lab in labs)
    kinds = Counter(event.kind for lab in labs for event in lab.events)
    assert ends["done"] > 45 and ends["ended"] > 0
    assert min(kinds[kind] for kind in ("undo", "void", "restore", "repeat", "pause", "skip", "more", "device")) > 0


MANY = """
import sys
sys.path[:0] = {paths}
import test_random_sessions
for seed in range(1000, 21000):
    test_random_sessions.held(seed)
"""


@pytest.mark.deep
@pytest.mark.release
def test_twenty_thousand_random_sessions():
    """In a process that checks no shapes, which take most of the time here: a minute or two."""
    here = Path(__file__).parent
    code = MANY.format(paths=[str(here), str(here.parent / "support")])
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=here.parents[1])
    assert run.returncode == 0, run.stderr[-2000:]
