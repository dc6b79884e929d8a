"""How long a participant waits: from a response to the next active parameters on the device, through the real server.

    python benchmarks/live.py --trials 500 --write      # into docs/guides/live.md

Sessions of the paper's study follow each other, each a process of its own as `hilbo session` starts it, with short
steps, on the simulated device (host port); a program answers. Times are parts of the server's own clock: the answer's
arrival, on the disk (fsync), next proposal looked up, on the disk, conversation with the device (serial). Beside them,
in the same run: the choice as it is without looking ahead, a session's bare step, and starts beside `import jax`.
"""

import argparse
import json
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from pages import put

from hilbo.app.rehearsal.rehearsal import Decider, fast_study, server
from hilbo.app.rehearsal.robot import Client
from hilbo.cli.terminal.console import start
from hilbo.session.choose.ask_tell import Session
from hilbo.session.choose.look_ahead import LiveChooser
from hilbo.session.log.actions import answer, present, propose
from hilbo.session.log.header import header_for
from hilbo.session.log.state import LiveSession
from hilbo.simulation.presets import preset_of
from hilbo.study.config import Study

ROOT = Path(__file__).parents[1]
PAPER = ROOT / "hilbo" / "data" / "paper.toml"


def one_session(file: Path, study: Study, folder: Path, number: int) -> tuple[list[dict], float, int]:
    """Delays of a whole session (s), the time from its start to the first Begin, and fits that somebody waited for."""
    arguments = [str(file), "--participant", f"P{number:02d}", "--logs", str(folder), "--port", "0", "--pause", "0"]
    decide, begun = Decider(study, preset_of("paper"), number), time.perf_counter()
    with server(*arguments, "--seed", str(number), "--dry-run", "--sim", "finger=none") as (_, links):
        person, watch = Client(links["participant"]), Client(links["experimenter"])
        ready = None
        while True:
            view = person.get("/api/participant")
            if view["may"]["begin"]:
                ready = ready or time.perf_counter() - begun
                person.post("/api/participant/begin", {})
            elif view["questions"]:
                whole = watch.get("/api/experimenter")["whole"]
                trial = next(t for t in whole["trials"] if t["id"] == whole["pending"])
                answers = {q["name"]: decide(trial, q["name"]) for q in view["questions"]}
                person.post(
                    "/api/participant/answer", {"trial": view["trial"]["id"], "client": "c", "answers": answers}
                )
            elif view["phase"] == "done":
                break
            time.sleep(0.01)
        seen = watch.get("/api/experimenter")
    return seen["all_delays"], ready or 0.0, seen["fits_after_an_answer"]


def choices(study: Study, seed: int) -> tuple[list[float], list[float]]:
    """Times (s) of proposals without looking ahead, and of `Session.tell`, for the same answers; compiled before."""
    chooser, bare = (
        LiveChooser(LiveSession.start(study.file, header_for(study.file, "P", seed=seed, warm=False))),
        Session.start(study, seed),
    )
    chooser.warm()
    bare.warm().join()
    state, decide = (
        LiveSession.start(study.file, header_for(study.file, "P", seed=seed, warm=False)),
        Decider(study, preset_of("paper"), seed),
    )
    proposed, told = [], []
    while state.screen != "done":
        begun = time.perf_counter()
        event = propose(state, chooser, 0.0)
        proposed.append(time.perf_counter() - begun)
        state = state.after(event)
        trial = state.trials[-1]
        state = state.after(present(state, trial.id, 1, True, 0.0))
        label = decide({"renderings": trial.renderings}, "class_a")
        begun = time.perf_counter()
        bare = bare.tell(label)
        told.append(time.perf_counter() - begun)
        answered = answer(state, trial.id, "c", {"class_a": label}, 0.0)
        assert answered is not None
        state = state.after(answered)
    fitted = study.file.selection.space_filling
    return proposed[fitted:], told[fitted - 1 : -1]


def import_times(count: int) -> list[float]:
    """Of `import jax` in a fresh interpreter, s."""
    times = []
    for _ in range(count):
        begun = time.perf_counter()
        subprocess.run([sys.executable, "-c", "import jax"], check=True)
        times.append(time.perf_counter() - begun)
    return times


def quantiles(values) -> str:
    """Median, 99 % and largest, ms."""
    milliseconds = 1000 * np.quantile(np.asarray(values), [0.5, 0.99, 1.0])
    return " | ".join(f"{value:.1f}" for value in milliseconds)


def table(delays, ready, imports, proposed, told, fits) -> str:
    """Markdown."""
    parts = {
        "response to active parameters": "total",
        "… of which the response's fsync": "fsync",
        "… the response acknowledged after": "acknowledged",
        "… the next proposal looked up": "chosen",
        "… conversation with the device": "serial",
    }
    rows = [f"| {name} | {quantiles([d[key] for d in delays])} |" for name, key in parts.items()]
    rows.append(f"| the choice without looking ahead, {len(proposed)} trials | {quantiles(proposed)} |")
    rows.append(f"| a session's bare step (`Session.tell`), the same trials | {quantiles(told)} |")
    rows.append(f"| start of the command to the first Begin, {len(ready)} starts, warm cache | {quantiles(ready)} |")
    rows.append(f"| `import jax` alone, {len(imports)} starts | {quantiles(imports)} |")
    head = (
        f"{len(delays)} answers, {fits} fits after an answer. Python {platform.python_version()}, {platform.system()}."
    )
    return "\n".join(["| ms | median | 99 % | largest |", "|---|---:|---:|---:|", *rows, "", head])


def main() -> None:
    """Run, print, and with --write put the table into docs/guides/live.md."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=500)
    parser.add_argument("--seconds", type=float, default=0.25, help="of each step")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    start()
    with tempfile.TemporaryDirectory() as name:
        file = fast_study(PAPER, Path(name) / "study.toml", options.seconds, 1)
        study = Study.load(file)
        delays, ready, imports, fits, number = [], [], [], 0, 0
        while len(delays) < options.trials:
            session_delays, first, waited = one_session(file, study, Path(name) / "logs", number)
            delays += session_delays
            ready.append(first)
            imports += import_times(1)
            fits, number = fits + waited, number + 1
            print(json.dumps({"answers": len(delays), "ready_s": round(first, 2)}), file=sys.stderr, flush=True)
        proposed, told = choices(study, 0)
    text = table(delays, ready[1:] or ready, imports, proposed, told, fits)
    print(text)
    if options.write:
        put("guides/live.md", "times", text)


if __name__ == "__main__":
    main()
