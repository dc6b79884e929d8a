"""A session whose server is killed and resumed, the program that is its participant, and what must be in its log."""

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

from hilbo.app.rehearsal.robot import Client
from hilbo.session.log.event_log import read_log

__all__ = ["PATIENCE", "Session"]

LABELS = ("different", "similar", "close")
PATIENCE = 120.0  # s: how long what must come is waited for; no test asserts a time

# Forked from a process that has imported everything and computed nothing: a start costs a second instead of several.
SERVERS = multiprocessing.get_context("forkserver")
SERVERS.set_forkserver_preload(
    ["hilbo.app.hub.opening", "hilbo.app.server.server", "hilbo.app.server.serve", "uvicorn", "pandas"]
)


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
            "--pause",
            "0",
            "--dry-run",
            "--json",
        ]
        self.rng, self.process, self.client, self.experimenter = random.Random(seed), None, None, None
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
            links = json.loads(self.out.read_text())
            self.client, self.experimenter = Client(links["participant"]), Client(links["experimenter"])
        return True

    def kill(self):
        os.kill(self.process.pid, signal.SIGKILL)
        self.process.join()

    def close(self):
        """No server is left, whatever a test has found: it would take the next device by its name."""
        if self.process is not None and self.process.is_alive():
            self.kill()

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
            self._forget_what_is_asked_no_more()
            return "again"
        except (OSError, ValueError):  # no server, or one that died while it spoke
            return "nobody"

    def _forget_what_is_asked_no_more(self):
        """An answer that was not acknowledged, to a trial that has been begun anew, is refused, and rightly."""
        try:
            trial = self.client.get("/api/participant")["trial"]
        except (OSError, ValueError):
            return
        if self.waiting is not None and trial is not None and trial["id"] != self.waiting["trial"]:
            self.waiting = None

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
