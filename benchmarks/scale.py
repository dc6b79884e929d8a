"""`hilbo aggregate` of 1,000 to 100,000 people: seconds and memory of whole commands, and agreement of processes.

    python benchmarks/scale.py                              the figures
    python benchmarks/scale.py --write                      and these into docs/results/run_time.md
    python benchmarks/scale.py --people 1000 --rules bcm    other sizes and rules

Every command is a process of its own with an empty cache of programs. Memory is its largest resident set.
"""

import argparse
import json
import os
import platform
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pandas as pd
from pages import put

from hilbo.study.config import Study
from hilbo.study.tables.trials import write_trials

ROOT = Path(__file__).parents[1]
STUDY = ROOT / "hilbo" / "data" / "paper.toml"
TRIALS = 25
COMMAND = [sys.executable, "-c", "from hilbo.cli.main import main; main()", "aggregate"]


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--people", type=int, nargs="+", default=[1000, 10_000, 100_000])
    options.add_argument("--rules", nargs="+", default=["bcm", "learnt-2"])
    options.add_argument("--largest", type=int, default=10_000, help="people of a rule that learns")
    options.add_argument("--processes", type=int, nargs="+", default=[2, 4], help="that are to give the result of one")
    options.add_argument("--agree", type=int, default=1200, help="participants of that result; 0: not compared")
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        text = "\n".join([*sizes(chosen, Path(folder)), "", *agreement(chosen, Path(folder))])
    print(text)
    if chosen.write:
        put("results/run_time.md", "scale cpu", text)


def sizes(chosen, folder):
    """Lines of the table of whole commands."""
    yield "| rule | participants | s | ms each | peak MB |"
    yield "|---|--:|--:|--:|--:|"
    for rule in chosen.rules:
        for people in chosen.people:
            if rule.startswith("learnt") and people > chosen.largest:
                continue
            seconds, peak = measured(folder, people, rule)
            yield f"| {rule} | {people:,} | {seconds:.0f} | {1000 * seconds / people:.1f} | {peak:.0f} |"
    yield ""
    yield f"{len(os.sched_getaffinity(0))} cores ({platform.machine()}), Python {platform.python_version()}."


def measured(folder, people, rule):
    """Wall-clock seconds and largest resident set (MB) of one command."""
    begun = time.perf_counter()
    process = started(folder, people, rule, f"{rule}-{people}")
    _, status, usage = os.wait4(process.pid, 0)
    assert status == 0
    seconds = time.perf_counter() - begun
    print(f"{rule}, {people}: {seconds:.1f} s, {usage.ru_maxrss / 1000:.0f} MB", file=sys.stderr, flush=True)
    return seconds, usage.ru_maxrss / 1000


def agreement(chosen, folder):
    """Lines on how far the results of several processes, and of several devices, are from that of one."""
    if not chosen.agree:
        return
    columns = "rule", "largest difference of the map, of its scale", "of the optimum, of the ranges"
    yield f"| {chosen.agree:,} participants, against one process | {' | '.join(columns)} |"
    yield "|---|---|--:|--:|"
    for rule in chosen.rules:
        started(folder, chosen.agree, rule, "one").wait()
        one = result(folder, "one")
        for count in chosen.processes:
            together(folder, chosen.agree, rule, count)
            yield compared(f"{count} processes", rule, one, result(folder, f"together-{count}"))
        flags = "--xla_force_host_platform_device_count=4"
        started(folder, chosen.agree, rule, "devices", flags=flags).wait()
        yield compared("4 devices", rule, one, result(folder, "devices"))


def compared(words, rule, one, other):
    scale = np.abs(one[0]).max()
    return (
        f"| {words} | {rule} | {np.abs(one[0] - other[0]).max() / scale:.1e} | {np.abs(one[1] - other[1]).max():.1e} |"
    )


def result(folder, out):
    """The map's means and the optimum in the unit cube."""
    import xarray as xr

    content = json.loads((folder / out / "result.json").read_text())
    with xr.open_dataset(folder / out / "map.nc", engine="h5netcdf") as grid:
        return np.asarray(grid["mean"]), np.array(content["optimum"]["unit"])


def together(folder, people, rule, count):
    """Run `count` processes on this machine, which compute one result together."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    crew = [
        started(
            folder,
            people,
            rule,
            f"together-{count}",
            *("--distributed", "--coordinator", f"localhost:{port}", "--processes", count, "--process-id", rank),
        )
        for rank in range(count)
    ]
    assert [process.wait() for process in crew] == [0] * count


def started(folder, people, rule, out, *more, flags=""):
    """Start one `hilbo aggregate --no-individuals`; returns its process."""
    trials = folder / f"{people}.csv"
    if not trials.exists():
        write_trials(answers(Study.load(STUDY), people), trials)
    environment = os.environ | {"XDG_CACHE_HOME": tempfile.mkdtemp(dir=folder), "JAX_PLATFORMS": "cpu"}
    environment |= {"PYTHONPATH": str(ROOT), "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {flags}"}
    options = ["--study", STUDY, "--rule", rule, "--no-individuals", "--out", folder / out, "--force", *more]
    return subprocess.Popen(
        [*COMMAND, *map(str, (trials, *options))], env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )


def answers(study, people):
    """People whose favourite renderings scatter around one, with answers to random renderings."""
    rng = np.random.default_rng(0)
    candidates = study.space.candidates(8192, 0)
    x = candidates[rng.integers(0, len(candidates), people * TRIALS)]
    favourite = np.repeat(np.array([0.15, 0.18, 0.2]) + 0.1 * rng.normal(size=(people, 3)), TRIALS, axis=0)
    felt = np.linalg.norm((x - favourite) / np.array([0.24, 0.36, 0.09]), axis=1) + 0.9 * rng.normal(size=len(x))
    table = pd.DataFrame(np.asarray(study.space.to_physical(x.astype(float))), columns=list(study.space.names))
    table.insert(0, "response", np.array(study.responses)[(felt < 2.6).astype(int) + (felt < 1.8)])
    table.insert(0, "trial", np.tile(np.arange(1, TRIALS + 1), people))
    table.insert(0, "participant", np.repeat([f"P{i:06d}" for i in range(people)], TRIALS))
    return table


if __name__ == "__main__":
    main()
