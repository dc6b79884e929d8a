"""kill -9 of the server at random moments: no acknowledged answer is lost, none is doubled, the next trial is the same.

`HILBO_KILLS=200 pytest tests/app/test_kills.py` kills so often; by default a few times, for the sake of the clock.
"""

import contextlib
import json
import multiprocessing
import os
import random
import signal
import socket
import sys
import time
import urllib.error
from pathlib import Path

import pytest
from live_server import DATA, PATIENCE, until_held

from hilbo.app.rehearsal import example_sets, fast_study
from hilbo.app.robot import Client
from hilbo.device.simulator import Simulator
from hilbo.session.event_log import read_log
from hilbo.session.plan import make_plan
from hilbo.study.config import Study

KILLS = int(os.environ.get("HILBO_KILLS", "8"))
LABELS = ("different", "similar", "close")
pytestmark = [pytest.mark.deep, pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals and SIGKILL")]

# Forked from a process that has imported everything and computed nothing: a start costs a second instead of several.
SERVERS = multiprocessing.get_context("forkserver")
SERVERS.set_forkserver_preload(["hilbo.app.opening", "hilbo.app.server", "hilbo.app.serve", "uvicorn", "pandas"])


def run_server(arguments, out):
    """`hilbo session`, its links in the file `out`."""
    from hilbo.cli.main import main

    with open(out, "w", buffering=1) as file, open(f"{out}.err", "w") as words:
        os.dup2(file.fileno(), 1)
        os.dup2(words.fileno(), 2)
        sys.stdout, sys.stderr = os.fdopen(1, "w", buffering=1), os.fdopen(2, "w", buffering=1)
        sys.argv = ["hilbo", "session", *arguments]
        main()


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Session:
    """A session that is killed and resumed, and the program that is its participant."""

    def __init__(self, folder, arguments, seed=0):
        folder.mkdir()
        self.folder, self.out = folder, folder / "links"
        self.arguments = [
            *arguments,
            "--logs",
            str(folder / "logs"),
            "--port",
            str(free_port()),
            "--gap",
            "0",
            "--dry-run",
            "--json",
        ]
        self.rng, self.process, self.client = random.Random(seed), None, None
        self.acknowledged: dict[str, dict] = {}
        self.waiting: dict | None = None
        self.proposed: dict[int, dict] = {}
        self.dropped, self.phase = 0, ""

    def start(self):
        """A new server; it resumes where there is a log."""
        self.out.unlink(missing_ok=True)
        resume = ["--resume"] if list((self.folder / "logs").glob("*.jsonl")) else []
        self.process = SERVERS.Process(target=run_server, args=([*self.arguments, *resume], str(self.out)))
        self.process.start()

    def ready(self):
        """Whether the server has given its links; a participant keeps the first one's key."""
        assert self.process.is_alive(), Path(f"{self.out}.err").read_text()
        if not self.out.exists() or "\n" not in self.out.read_text():
            return False
        if self.client is None:
            self.client = Client(json.loads(self.out.read_text())["participant"])
        return True

    def kill(self):
        os.kill(self.process.pid, signal.SIGKILL)
        self.process.join()

    def act(self):
        """One look at the view, and what a participant would do; the phase. An answer is kept until acknowledged."""
        try:
            if self.waiting is not None:
                self.send()
            view = self.client.get("/api/participant")
            self.phase = view["phase"]
            if view["may"]["begin"]:
                self.client.post("/api/participant/begin", {})
            elif view["questions"]:
                self.waiting = self.answer_to(view)
                self.send()
            return view["phase"]
        except urllib.error.HTTPError as error:
            error.close()
            if error.code not in (409, 503):
                raise
            return "again"
        except (OSError, ValueError):  # no server, or one that died while it spoke
            return "nobody"

    def answer_to(self, view):
        number = int(view["trial"]["id"].split(":")[1].split(".")[0])
        options = {"preferred": ("a", "b")}
        answers = {
            q["name"]: options.get(q["name"], LABELS)[number % len(options.get(q["name"], LABELS))]
            for q in view["questions"]
        }
        return {"trial": view["trial"]["id"], "client": "program", "answers": answers}

    def send(self):
        if self.rng.random() < 0.2:  # the network goes away between click and acknowledgement
            self.dropped += 1
            self.send_and_hang_up()
            return
        self.client.post("/api/participant/answer", self.waiting)
        self.acknowledged[self.waiting["trial"]] = self.waiting["answers"]
        self.waiting = None

    def send_and_hang_up(self):
        body = json.dumps(self.waiting).encode()
        host, port = self.client.address.removeprefix("http://").split(":")
        head = f"POST /api/participant/answer HTTP/1.1\r\nHost: {host}:{port}\r\nContent-Length: {len(body)}\r\n"
        head += f"Authorization: Bearer {self.client._key}\r\nContent-Type: application/json\r\n\r\n"
        with socket.create_connection((host, int(port)), timeout=5) as line:
            line.sendall(head.encode() + body)

    def log(self, study):
        (path,) = (self.folder / "logs").glob("*.jsonl")
        return read_log(path, study)[1]

    def check(self, study):
        """What was acknowledged is in the log, once; and no proposal was ever made twice, or differently."""
        if not list((self.folder / "logs").glob("*.jsonl")):
            return
        given = {}
        for event in self.log(study):
            if event.kind == "answer":
                assert event.data["id"] not in given
                given[event.data["id"]] = event.data["values"]
            elif event.kind == "propose":
                known = self.proposed.setdefault(event.data["id"], event.data)
                assert known == event.data
        for name, answers in self.acknowledged.items():
            assert given[int(name.split(":")[1].split(".")[0])] == answers

    def until(self, done, seconds=PATIENCE):
        end = time.monotonic() + seconds
        while not done():
            assert time.monotonic() < end, Path(f"{self.out}.err").read_text()
            time.sleep(0.005)


def finished(study, folder, arguments, kills, most):
    """The log of a session that was killed so often, each time `most` s after its start, or before it was there."""
    session, amid = Session(folder, arguments), 0
    for number in range(kills):
        session.start()
        if number % 10 == 9:  # in the middle of starting
            time.sleep(session.rng.uniform(0, 1.0))
        else:
            session.until(session.ready)
            end = time.monotonic() + session.rng.uniform(0, most)
            while time.monotonic() < end and session.act() != "done":
                time.sleep(session.rng.uniform(0, 0.01))
        session.kill()
        session.check(study)
        amid += session.phase not in ("done", "ended")
    session.start()
    session.until(session.ready)
    session.until(lambda: session.act() == "done", 20 * PATIENCE)
    session.kill()
    session.check(study)
    print(
        f"{kills} kills, {amid} of them amid the session, {len(session.acknowledged)} answers acknowledged,"
        f" {session.dropped} times hung up"
    )
    return session.log(study)


def essence(events):
    """Proposals and answers, without their times."""
    kept = []
    for event in events:
        if event.kind in ("propose", "answer", "go_on"):
            kept.append((event.kind, {k: v for k, v in event.data.items() if k != "browser"}))
    return kept


@pytest.mark.parametrize(("phase", "share"), [("validation", 1.0), ("optimisation", 0.25)])
def test_killed_servers_lose_and_double_nothing(tmp_path, phase, share):
    text = DATA.read_text(encoding="utf-8").replace("trials = 25", "trials = 9")
    (tmp_path / "base.toml").write_text(text)
    file = fast_study(tmp_path / "base.toml", tmp_path / "study.toml", 0.05, 2)
    kills = max(2, round(share * KILLS))
    if phase == "validation":
        text = file.read_text().replace(
            "[session.validation]\n", f"[session.validation]\ncount = {max(4, kills // 2)}\n"
        )
        file.write_text(text)
    study = Study.load(file)
    arguments = [str(file), "--participant", "P01"]
    if phase == "validation":
        plan = make_plan(study, ["P01"], 0, phase, sets={"": example_sets(study)}, source="aggregate")
        (tmp_path / "plan.json").write_text(json.dumps(plan))
        arguments += ["--plan", str(tmp_path / "plan.json")]
    logs = [finished(study, tmp_path / name, arguments, n, 0.8) for name, n in (("killed", kills), ("whole", 0))]
    assert essence(logs[0]) == essence(logs[1])


def test_a_kill_while_a_device_of_its_own_renders_loses_not_even_the_click(tmp_path):
    file = fast_study(DATA, tmp_path / "study.toml", 0.05, 2)
    study = Study.load(file)
    plan = make_plan(study, ["P01"], 0, "validation", sets={"": example_sets(study)}, source="aggregate")
    (tmp_path / "plan.json").write_text(json.dumps(plan))
    with contextlib.closing(Simulator(finger="none")) as device:
        arguments = [str(file), "--participant", "P01", "--plan", str(tmp_path / "plan.json"), "--device", device.port]
        session = Session(tmp_path / "killed", arguments)
        session.start()
        session.until(session.ready)
        experimenter = Client(json.loads(session.out.read_text())["experimenter"])

        def asked():
            view = session.client.get("/api/participant")
            if view["may"]["begin"]:
                session.client.post("/api/participant/begin", {})
            if view["phase"] == "answer":
                session.waiting = session.answer_to(view)  # clicked, and kept by the browser
            return session.waiting

        session.until(asked)
        session.kill()
        until_held(device.port)
        session.start()
        session.until(session.ready)
        clicked = session.waiting
        assert not session.client.post("/api/participant/answer", clicked)["again"]
        session.waiting = None
        experimenter.post("/api/experimenter/clear", {})
        session.until(asked)
        assert session.waiting["trial"] != clicked["trial"]
        session.kill()
    events = session.log(study)
    assert [e.data["condition"] for e in events if e.kind == "device"] == ["ready", "stopped", "ready"]
    assert [e.data["id"] for e in events if e.kind == "answer"] == [1]
