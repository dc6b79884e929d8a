"""Kills (SIGKILL) of a session's server, its device, its heartbeat helper, and of the participant's program.

    python attacks/kills.py --count 1000 --seed 0 --state kills.json

Each at a chosen moment (an answer on its way, a proposal just made, Begin, a start) or a random one. After each the log
is read: what was acknowledged is in it, once and as it was sent, and no proposal was made twice, or differently. The
session then goes on, and when it is done another one begins. The state file goes on with the next number.
"""

import contextlib
import json
import os
import random
import signal
import socket
import struct
import sys
import tempfile
import time
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[1] / "tests" / "support")]

from killed_session import PATIENCE, Session

from attacks.support import main
from hilbo.app.rehearsal.rehearsal import fast_study
from hilbo.session.log.event_log import read_log
from hilbo.session.log.state import LiveSession
from hilbo.study.config import Study

__all__ = ["Kills"]

DATA = Path(__file__).parents[1] / "hilbo" / "data" / "paper.toml"
VICTIMS = ("server", "device", "helper", "participant")
MOMENTS = ("answer", "proposal", "begin", "start", "random")
_PROGRAMS = {"device": "hilbo-device", "helper": "heartbeat.py"}


def children(pid: int) -> dict[int, str]:
    """A process's children and their command lines (Linux)."""
    commands = {}
    for tasks in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in tasks.read_text().split():
            with contextlib.suppress(OSError):
                commands[int(child)] = Path(f"/proc/{child}/cmdline").read_bytes().replace(b"\0", b" ").decode()
    return commands


class Kills:
    """One session after the other, in a folder of its own; a call is one kill."""

    def __init__(self, folder: Path, trials: int = 60):
        self.folder, self._begun, self.session = folder, 0, None
        text = DATA.read_text(encoding="utf-8").replace("trials = 25", f"trials = {trials}")
        (folder / "base.toml").write_text(text, encoding="utf-8")
        self._file = fast_study(folder / "base.toml", folder / "study.toml", 0.05, 2)
        self.study = Study.load(self._file)

    def __call__(self, rng: random.Random, number: int) -> str:
        """The word under which a kill counts. Raises what a check finds."""
        victim, moment = VICTIMS[number % 4], rng.choice(MOMENTS)
        session = self._session(number)
        moment = self._until(moment, rng)
        if victim == "participant":
            self._hang_up(rng)
        elif victim == "server":
            self._kill_server(moment, rng)
        else:  # after the kill before, it may still be being started
            session.until(lambda: self._kill_child(_PROGRAMS[victim]) or not self._act())
        words = Path(f"{session.out}.err").read_text(encoding="utf-8") if session.out.exists() else ""
        if "Traceback" in words:
            return f"THROUGH: traceback of the server\n{words}"
        session.check(self.study.file)
        return f"{victim}, {moment}"

    def close(self) -> None:
        """End the session that runs, and read its log a last time."""
        if self.session is not None:
            self.session.kill()
            self.session.check(self.study.file)
            self.session = None

    def _session(self, seed: int) -> Session:
        """The one that runs; a new one when it is done."""
        if self.session is not None and self.session.phase in ("done", "ended"):
            self.close()
            (log,) = (self.folder / f"session{self._begun}" / "logs").glob("*.jsonl")
            header, events, _ = read_log(log, self.study.file)
            assert LiveSession.fold(self.study.file, header, events).screen == "done"
        if self.session is None:
            self._begun += 1
            arguments = [str(self._file), "--participant", "P01", "--device", "sim"]
            self.session = Session(self.folder / f"session{self._begun}", arguments, seed)
            self._start()
        return self.session

    def _start(self) -> None:
        self.session.start()
        self.session.until(self.session.ready)

    def _act(self) -> str:
        """What participant and experimenter would do now; the phase."""
        phase = self.session.act()
        if phase in ("wait", "hello", "paused", "ready", "trouble"):
            with contextlib.suppress(OSError, ValueError):
                if "clear" in self.session.experimenter.get("/api/experimenter")["may"]:
                    self.session.experimenter.post("/api/experimenter/clear", {})
        return phase

    def _until(self, moment: str, rng: random.Random) -> str:
        """Acts until a moment has come; which one it was."""
        session, end = self.session, time.monotonic() + PATIENCE
        answered = len(session.acknowledged)
        random_end = time.monotonic() + rng.uniform(0, 0.5)
        while session.phase not in ("done", "ended"):
            assert time.monotonic() < end, f"nothing goes on: {self._seen()}"
            if moment == "answer" and session.waiting is None:
                with contextlib.suppress(OSError, ValueError):
                    view = session.client.get("/api/participant")
                    if view["questions"]:
                        session.waiting = session.answer_to(view)
                        session.send_and_hang_up()
                        time.sleep(rng.uniform(0, 0.004))
                        return moment
            phase = self._act()
            if moment == "proposal" and len(session.acknowledged) > answered:
                time.sleep(rng.uniform(0, 0.03))
                return moment
            if moment == "begin" and phase in ("hello", "ready", "paused"):
                time.sleep(rng.uniform(0, 0.1))
                return moment
            if moment in ("random", "start", "begin") and time.monotonic() > random_end:
                return "random" if moment == "begin" else moment
            time.sleep(0.005)
        return "end"

    def _seen(self) -> str:
        """What both roles are shown, and what the server has said: why nothing goes on."""
        session = self.session
        words = Path(f"{session.out}.err").read_text(encoding="utf-8")
        with contextlib.suppress(OSError, ValueError):
            view = session.experimenter.get("/api/experimenter")
            may = session.client.get("/api/participant")["may"]
            return (
                f"{view['phase']}, {may}, {view['device']}, {view['alert']}, {view['may']}, {view['log'][:8]}\n{words}"
            )
        return f"{session.phase}, no server\n{words}"

    def _kill_server(self, moment: str, rng: random.Random) -> None:
        self.session.kill()
        if moment == "start":
            self.session.start()
            time.sleep(rng.uniform(0, 1.0))
            self.session.kill()
        self._start()

    def _kill_child(self, program: str) -> bool:
        for pid, line in children(self.session.process.pid).items():
            if program in line:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
                    return True
        return False

    def _hang_up(self, rng: random.Random) -> None:
        """The participant's program ends in mid-request; its answer, if it has one, is kept and sent again later."""
        session = self.session
        body = json.dumps(session.waiting or {"trial": "x", "client": "program", "answers": {}}).encode()
        host, port = session.client.address.removeprefix("http://").split(":")
        lines = ("POST /api/participant/answer HTTP/1.1", f"Host: {host}:{port}", f"Content-Length: {len(body)}")
        lines += (f"Authorization: Bearer {session.client._key}", "", "")
        whole = "\r\n".join(lines).encode() + body
        with contextlib.suppress(OSError), socket.create_connection((host, int(port)), timeout=5) as line:
            line.sendall(whole[: rng.randrange(len(whole) + 1)])
            if rng.random() < 0.5:  # reset instead of ended
                line.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))


def prepared() -> None:
    """The command line."""
    with tempfile.TemporaryDirectory() as folder:
        kills = Kills(Path(folder))
        try:
            main(lambda: kills, __doc__.partition("\n")[0], 1000)
        finally:
            kills.close()


if __name__ == "__main__":
    prepared()
