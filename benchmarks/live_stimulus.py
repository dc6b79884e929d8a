"""How long a program that presents waits: from an answer's acknowledgement to the next parameters at the client.

    python benchmarks/live_stimulus.py --trials 500 --write      # into docs/guides/stimulus.md

Sessions of a study with two parameters follow each other, each a server of its own as `hilbo session` starts it; the
shipped Python client presents, and a program answers as soon as it is asked. A trial is one step, of the test alone, so
that nothing but hilbo stands between an answer and the next parameters. Both ends are of this process's clock.
"""

import argparse
import json
import platform
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
from pages import put

from hilbo.app.rehearsal.rehearsal import server
from hilbo.app.rehearsal.robot import Client
from hilbo.cli.terminal.console import start
from hilbo.study.template import NewStudy, parameter_of, study_text

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "clients"))

from hilbo_stimulus import Stimulus  # noqa: E402  (as its users have it: a file beside their program)

PARAMETERS = ("hue=140:260:deg", "light=20:80:%")
BEST = {"hue": 140.0, "light": 45.0}


def study_file(folder: Path, trials: int, seconds: float) -> Path:
    """A study as `hilbo init` writes it, whose trials are one step of the test."""
    text = study_text(NewStudy("latency", tuple(map(parameter_of, PARAMETERS)), trials=trials))
    steps = 'steps = [{show = "reference", seconds = 2}, {show = "a", seconds = 2}]'
    assert text.count(steps) == 2
    file = folder / "study.toml"
    file.write_text(
        text.replace(steps, f'steps = [{{show = "a", seconds = {seconds}}}]').replace("count = 3", "count = 1")
    )
    return file


def answer_to(values: dict[str, float]) -> str:
    """By the distance from what seems best."""
    far = abs(values["hue"] - BEST["hue"]) / 360 + abs(values["light"] - BEST["light"]) / 60
    return ("close", "similar", "different")[int(np.searchsorted([0.15, 0.4], far))]


class Presenting:
    """The client in a thread; when it was last given parameters, and which."""

    def __init__(self, link: str):
        self.at, self.values = 0.0, {}
        self.stimulus = Stimulus(link, "benchmark", "1")
        self.thread = threading.Thread(target=self._run)
        self.thread.start()

    def _run(self) -> None:
        for order in self.stimulus:
            if order.do == "present":
                self.at, self.values = time.perf_counter(), dict(order.values)
                self.stimulus.presented()
            else:
                self.stimulus.neutral()

    def close(self) -> None:
        """Leave the session."""
        self.stimulus.close()
        self.thread.join()


def one_session(file: Path, folder: Path, number: int) -> tuple[list[float], int]:
    """s from each answer's acknowledgement to the next parameters, of trials that are chosen; fits waited for."""
    arguments = [str(file), "--participant", f"P{number:03d}", "--logs", str(folder), "--port", "0", "--pause", "0"]
    delays = []
    with server(*arguments, "--seed", str(number), "--dry-run") as (_, links):
        person, watch, program = (
            Client(links["participant"]),
            Client(links["experimenter"]),
            Presenting(links["stimulus"]),
        )
        acknowledged = None
        while True:
            view = person.get("/api/participant")
            if acknowledged is not None and program.at > acknowledged:
                delays.append(program.at - acknowledged)
                acknowledged = None
            if view["may"]["begin"]:
                acknowledged = None
                person.post("/api/participant/begin", {})
            elif view["questions"]:
                given = {q["name"]: answer_to(program.values) for q in view["questions"]}
                before = program.at
                person.post("/api/participant/answer", {"trial": view["trial"]["id"], "client": "c", "answers": given})
                acknowledged = time.perf_counter()
                if program.at > before:  # it was there before the acknowledgement was
                    delays.append(program.at - acknowledged)
                    acknowledged = None
            elif view["phase"] == "done":
                break
            time.sleep(0.002)
        fits = watch.get("/api/experimenter")["fits_after_an_answer"]
        program.close()
    return delays, fits


def main() -> None:
    """Run, print, and with --write put the table into docs/guides/stimulus.md."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=500, help="in all")
    parser.add_argument("--session", type=int, default=25, help="trials of one session")
    parser.add_argument("--seconds", type=float, nargs="+", default=[2.0, 0.2], help="of each step")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    start()
    rows = []
    for seconds in options.seconds:
        delays, fits, number = [], 0, 0
        with tempfile.TemporaryDirectory() as name:
            file = study_file(Path(name), options.session, seconds)
            while len(delays) < options.trials:
                session_delays, waited = one_session(file, Path(name) / "logs", number)
                delays, fits, number = delays + session_delays, fits + waited, number + 1
                print(json.dumps({"trials": len(delays), "fits": fits}), file=sys.stderr, flush=True)
        middle, late, worst = 1000 * np.quantile(delays, [0.5, 0.99, 1.0])
        rows.append(f"| {seconds:g} | {len(delays)} | {middle:.0f} | {late:.0f} | {worst:.0f} | {fits} |")
    head = "| a step of, s | trials | median, ms | 99 % | largest | fits waited for |\n|---:|---:|---:|---:|---:|---:|"
    text = "\n".join(
        [head, *rows, "", f"Python {platform.python_version()}, {platform.system()}, two busy processors."]
    )
    print(text)
    if options.write:
        put("guides/stimulus.md", "times", text)


if __name__ == "__main__":
    main()
