"""Whatever a program with the stimulus's key sends, or without: the server goes on, no trial is answered without a
confirmation in force, nothing that was acknowledged is lost, and the participant is sent no parameter.

A participant takes part meanwhile. `HILBO_FUZZ=2000` is how many messages are sent in each deep run.
"""

import contextlib
import json
import os
import random
import threading
import time
import urllib.error
import urllib.request

import pytest
from live_server import PATIENCE, check_blinding, listen
from live_stimulus import SETS, ByHand, LiveStimulus

from hilbo.session.log.event_log import read_log
from hilbo.session.log.state import LiveSession
from hilbo.study.file.plan_file import Block, Planned

MANY = int(os.environ.get("HILBO_FUZZ", "500"))
REFUSALS = {400, 401, 403, 404, 405, 409, 413}
ODD = [
    None,
    True,
    -1,
    0,
    2**70,
    1e308,
    "",
    "x",
    "\x00",
    "é" * 300,
    [],
    {},
    [[]] * 50,
    {"hue": {"hue": 1}},
    "NaN",
    "present",
]
HELLO = {"name": "fuzz", "version": "1", "force": False, "neutral_within_s": 1.0}


class Fuzz:
    """A program that says whatever its random numbers tell it, more often than not what is right."""

    def __init__(self, live, rng):
        self.rng, self.live = rng, live
        self.program = ByHand(live.link())
        self.keys = [self.program._key, live.participant._key, "a" * 32, "", "é"]
        self.order, self.run, self.said = self.program.order, self.program.run, {}
        self.trials = ["tag:1.1"]  # of which it has heard

    def act(self):
        """One message, or a flood of it."""
        kinds = (self.right, self.right, self.right, self.changed, self.nonsense, self.hello, self.form)
        path, body, kind = self.rng.choice(kinds)()
        key = self.keys[0] if self.rng.random() < 0.9 else self.rng.choice(self.keys)
        for _ in range(self.rng.choice((1,) * 30 + (20,))):
            self.send(path, body, kind, key)

    def send(self, path, body, kind, key):
        headers = {"Content-Type": kind, "Authorization": f"Bearer {key}".encode()}
        request = urllib.request.Request(self.program.address + path, data=body, headers=headers)
        try:
            with urllib.request.urlopen(request, timeout=PATIENCE) as reply:
                status, text = 200, reply.read()
        except urllib.error.HTTPError as error:
            status, text = error.code, error.read()
        self.said[status] = self.said.get(status, 0) + 1
        if kind.startswith("application/x-www") and not body.lstrip().startswith(b"{"):
            assert status == 200 and text.startswith(b"status\t"), text  # lines, with the status in them
            return
        content = json.loads(text)
        assert status == 200 or (status in REFUSALS and content["error"].endswith(".")), (status, body, content)
        self.order = content if "order" in content else self.order
        self.run = content.get("run", self.run)

    def report(self):
        """The right one for the newest order that is known."""
        order = self.order
        report = {"run": self.run, "order": order["order"], "state": "neutral", "wait_s": 0.0}
        if order["do"] != "present":
            return report
        off = self.rng.uniform(-1, 1) * (3.0 if self.rng.random() < 0.2 else 0.4)
        values = {name: value + off * (name == "hue") for name, value in order["values"].items()}
        return report | {"state": "presented", "trial": order["trial"]} | ({"values": values} if values else {})

    def right(self):
        return "/api/stimulus", json.dumps(self.report()).encode(), "application/json"

    def changed(self):
        """With one thing that is wrong, odd, missing, or of another time."""
        report, rng = self.report(), self.rng
        values = self.order.get("values") or {}
        self.trials.append(self.order.get("trial", "tag:1.1"))
        name = rng.choice([*report, "values", "values", "trial", "contact", "why", "other"])
        odd = [*ODD, "busy", "failed", "presented", report["order"] - 1, report["order"] + 1]
        if name == "trial":
            odd += [rng.choice(self.trials) for _ in odd]
        if name == "values" and values:
            off = values["hue"] + rng.uniform(-3, 3)
            odd += [values | {"hue": rng.choice([off, off, 1e999, 400.0, "red"])} for _ in odd]
        report[name] = rng.choice(odd)
        if rng.random() < 0.2:
            del report[name]
        return "/api/stimulus", json.dumps(report).encode(), "application/json"

    def nonsense(self):
        rng = self.rng
        made = [bytes(rng.randrange(256) for _ in range(rng.randrange(60))), json.dumps(rng.choice(ODD)).encode()]
        made += [b"[" * rng.choice([5, 5000]), self.right()[1][: rng.randrange(80)], b'{"run": NaN}', b" " * 20_000]
        path = rng.choice(
            ["/api/stimulus", "/api/stimulus/hello", "/api/preparer", "/api/experimenter/estop", "/api/join"]
        )
        return path, rng.choice(made), "application/json"

    def hello(self):
        said = HELLO | ({self.rng.choice([*HELLO, "more"]): self.rng.choice(ODD)} if self.rng.random() < 0.7 else {})
        return "/api/stimulus/hello", json.dumps(said).encode(), "application/json"

    def form(self):
        fields = [f"{name}={value}" for name, value in self.report().items() if not isinstance(value, dict)]
        fields += self.rng.choice([[], ["value.hue=NaN"], ["value.hue=1", "value.hue=1"], ["=", "%ff"], ["value.=x"]])
        return "/api/stimulus", "&".join(fields).encode(), "application/x-www-form-urlencoded"


def take_part(live, ended, acknowledged):
    """Begins and answers whatever is asked, and tries to answer before, until the session or the test ends."""
    asked = None
    while not ended.is_set():
        view = live.view()
        asked = view["questions"] or asked
        with contextlib.suppress(urllib.error.HTTPError):  # it is not asked yet, or what was asked is void by now
            if view["may"]["begin"]:
                live.participant.post("/api/participant/begin", {})
            elif view["trial"] and asked:
                live.answer(view | {"questions": asked})
                acknowledged.append(int(view["trial"]["id"].split(":")[1].split(".")[0]))
        time.sleep(0.002)


def check_confirmed(live):
    """At each answer in the log all that it is about had been confirmed in this presentation, near what was asked for;
    the state that the log ends in."""
    header, events, _ = read_log(live.path, live.study.file)
    state = LiveSession.start(live.study.file, header)
    for event in events:
        if event.kind == "answer":
            trial = state.trial(event.data["id"])
            assert set(trial.confirmed) == trial.felt == {"a"}
            off = {name: abs(trial.presented["a"][name] - value) for name, value in trial.renderings["a"].items()}
            assert off["hue"] <= 0.5 and off["light"] <= 6e-5
        state = state.after(event)
    return state


def attacked(folder, seed, messages):
    """How many answers were acknowledged, of how many trials; after all that must hold was seen to."""
    block = Block("warm-up", 400, tuple(Planned(name) for name in SETS) * 134)
    with LiveStimulus(folder, within=0.2, silence=0.3, seconds=0.01, blocks=(block,)) as live:
        heard, acknowledged, ended, own = [], [], threading.Event(), live.participant._ask
        live.participant._ask = lambda request: heard.append(json.dumps(reply := own(request))) or reply
        threads = [threading.Thread(target=listen, args=(live, heard))]
        threads += [threading.Thread(target=take_part, args=(live, ended, acknowledged))]
        for thread in threads:
            thread.start()
        try:
            fuzz = Fuzz(live, random.Random(seed))
            for _ in range(messages):
                fuzz.act()
        finally:
            ended.set()
            threads[1].join(PATIENCE)
        assert live.whole()["whole"]["header"]["participant"] == "P01" and not live.failed
    threads[0].join(PATIENCE)
    state = check_confirmed(live)
    answered = {trial.id for trial in state.trials if trial.answered is not None}
    assert set(acknowledged) <= answered and len(set(acknowledged)) == len(acknowledged)
    check_blinding("\n".join(heard), state, "hue", "light")
    print(f"seed {seed}: {fuzz.said}, {len(acknowledged)} answers acknowledged in {len(state.trials)} trials")
    return len(acknowledged), len(state.trials)


def test_a_program_may_send_anything(tmp_path):
    assert attacked(tmp_path, 0, 40)[1]


@pytest.mark.deep
@pytest.mark.parametrize("seed", [1, 2, *(pytest.param(s, marks=pytest.mark.release) for s in range(3, 11))])
def test_a_program_may_send_anything_for_long(tmp_path, seed):
    answers, trials = attacked(tmp_path, seed, MANY)
    assert 0 < answers < trials
