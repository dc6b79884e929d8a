"""Populations of 100 to 100,000 people refitted and merged: time per participant, memory, and agreement of processes.

    python benchmarks/scale.py                     the figures, on this machine's CPU
    python benchmarks/scale.py --write             and these into docs/results/run_time.md
    python benchmarks/scale.py --device gpu        participants and map points per second where JAX finds a GPU
    python benchmarks/scale.py --people 100 1000   other sizes

Every size runs in a process of its own, so that the peak of memory (largest resident set) is its own. The map is merged
at 2,000 points. A first pass over a few people compiles and is not in the times, which are said beside it.
"""

import argparse
import json
import os
import platform
import resource
import socket
import subprocess
import sys
import time
from pathlib import Path

from pages import put

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))
POINTS, TRIALS = 2000, 25
HEAD = (
    "| participants | read, µs each | refit + aggregate, µs each | and optimum, µs each | own optima, µs each"
    " | peak MB |"
)


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--people", type=int, nargs="+", default=[100, 1000, 10_000, 100_000])
    options.add_argument("--device", choices=["cpu", "gpu"], default="cpu")
    options.add_argument("--processes", type=int, nargs="+", default=[1, 2, 4], help="that are to give one map")
    options.add_argument("--agree", type=int, default=1000, help="participants of that map")
    options.add_argument("--write", action="store_true")
    options.add_argument("--run", help=argparse.SUPPRESS)
    chosen = options.parse_args()
    if chosen.run:
        print(json.dumps(globals()[f"run_{chosen.device}"](**json.loads(chosen.run))))
        return
    if chosen.device == "cpu":
        os.environ["JAX_PLATFORMS"] = "cpu"
    text = cpu_report(chosen) if chosen.device == "cpu" else gpu_report(chosen)
    print(text)
    if chosen.write:
        put("results/run_time.md", f"scale {chosen.device}", text)


def cpu_report(chosen):
    rows = [measured("cpu", people=people) for people in chosen.people]
    lines = [HEAD, "|--:|--:|--:|--:|--:|--:|"]
    for row in rows:
        cells = [f"{row['people']:,}", *(f"{row[name]:.0f}" for name in ("read", "merge", "optimum", "own", "peak"))]
        lines.append(f"| {' | '.join(cells)} |")
    lines += [
        "",
        f"Compiling, or reading it from the cache, took {rows[0]['compiled']:.0f} s besides. {machine()}.",
        "",
        *agreement(chosen),
    ]
    return "\n".join(lines)


def gpu_report(chosen):
    rows = [measured("gpu", people=people) for people in chosen.people]
    lines = ["| participants | participants/s | map points/s | peak GPU MB |", "|--:|--:|--:|--:|"]
    lines += [f"| {r['people']:,} | {r['rate']:,.0f} | {r['points']:,.0f} | {r['peak']:.0f} |" for r in rows]
    return "\n".join(
        [*lines, "", f"On {rows[0]['device']}, float64; a map point is one participant's say at one point."]
    )


def agreement(chosen):
    """Lines on how far the maps of several processes are from that of one."""
    import numpy as np

    maps, lines = (
        {},
        [f"| processes, {chosen.agree:,} participants | largest difference of the map, of its scale | s |"],
    )
    lines.append("|--:|--:|--:|")
    for count in chosen.processes:
        result = distributed(chosen.agree, count)
        maps[count] = np.array(result["map"])
        first = maps[chosen.processes[0]]
        apart = np.abs(maps[count] - first).max() / np.abs(first).max()
        lines.append(f"| {count} | {apart:.1e} | {result['seconds']:.1f} |")
    return lines


def measured(device, **settings):
    command = [sys.executable, __file__, "--device", device, "--run", json.dumps(settings)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    result = json.loads(done.stdout.splitlines()[-1])
    print(result, file=sys.stderr, flush=True)
    return result


def distributed(people, count):
    """What process 0 of `count` found."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    settings = [{"people": people, "agree": [f"localhost:{port}", count, rank]} for rank in range(count)]
    command = [sys.executable, __file__, "--device", "cpu", "--run"]
    crew = [subprocess.Popen([*command, json.dumps(s)], stdout=subprocess.PIPE, text=True) for s in settings]
    said = [process.communicate()[0] for process in crew]
    return json.loads(said[0].splitlines()[-1])


def cohort_of_people(study, people):
    """People whose favourite renderings scatter around one, with answers to random renderings."""
    import numpy as np
    import pandas as pd

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


def run_cpu(people, agree=None):
    """One size in this process, or one process's part of an agreement."""
    from hilbo.cli.terminal.console import start

    start()
    from hilbo.study.estimate.distributed import crew

    with crew(agree is not None, *(agree or ())) as team:
        return agreed(team, people) if agree else sized(team, people)


def agreed(team, people):
    import numpy as np

    from hilbo.study.cohort import cohort_of
    from hilbo.study.config import Study
    from hilbo.study.estimate import batch

    study = Study.load(ROOT / "hilbo" / "data" / "paper.toml")
    table = cohort_of_people(study, people)
    table["category"] = table["response"].map({label: i for i, label in enumerate(study.responses)})
    population, points = batch.population_of(study, cohort_of(table, study), team), study.space.candidates(POINTS, 0)
    batch.refit(population, points)
    begun = time.perf_counter()
    mean, variance = batch.refit(population, points).sums.merge(float(study.gp.kernel.variance), people)
    return {"map": np.concatenate([mean, variance]).tolist(), "seconds": time.perf_counter() - begun}


def sized(team, people):
    import tempfile

    import numpy as np

    from hilbo.study.cohort import cohort_of
    from hilbo.study.config import Study
    from hilbo.study.estimate import batch
    from hilbo.study.estimate.batch_optimum import optima_from
    from hilbo.study.formats.csv_file import cell_pieces
    from hilbo.study.tables.trials import trial_table

    study = Study.load(ROOT / "hilbo" / "data" / "paper.toml")
    points = study.space.candidates(POINTS, 0)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "trials.csv"
        making = [sys.executable, "-c", MAKE.format(root=str(ROOT), people=people, path=str(path))]
        subprocess.run(making, check=True)  # in a process of its own: this one's memory is measured
        begun = time.perf_counter()
        cohort = cohort_of(trial_table(cell_pieces(path), study.file, source=str(path), others=False), study)
        read = time.perf_counter() - begun
    population = batch.population_of(study, cohort, team)
    few = population if people <= 1000 else population.every(2 * population.block)
    begun = time.perf_counter()
    fitted = batch.refit(few, points)
    optima_from(fitted.population, points, fitted.sums)
    compiled = time.perf_counter() - begun

    begun = time.perf_counter()
    fitted = batch.refit(population, points)
    merge = time.perf_counter() - begun
    begun = time.perf_counter()
    optima_from(fitted.population, points, fitted.sums)
    optimum = time.perf_counter() - begun
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000
    some = population.every(min(people, 1000))
    batch.refit(few, points, individuals=True)
    begun = time.perf_counter()
    batch.refit(some, points, individuals=True)
    own = (time.perf_counter() - begun) / some.people - merge / people
    assert np.all(fitted.certificate["converged"])
    micro = 1e6 / people
    return {
        "people": people,
        "read": read * micro,
        "merge": merge * micro,
        "optimum": optimum * micro,
        "own": own * 1e6,
        "peak": peak,
        "compiled": compiled,
    }


MAKE = """
import sys
sys.path[:0] = ["{root}", "{root}/benchmarks"]
import jax; jax.config.update("jax_enable_x64", True)
import scale
from hilbo.study.config import Study
from hilbo.study.tables.trials import write_trials
write_trials(scale.cohort_of_people(Study.load("{root}/hilbo/data/paper.toml"), {people}), "{path}")
"""


def run_gpu(people):
    """Refit and merge on the GPU: no line here says that it is one, but for its memory."""
    import jax

    from hilbo.cli.terminal.console import start

    start()
    from hilbo.study.cohort import cohort_of
    from hilbo.study.config import Study
    from hilbo.study.estimate import batch, distributed

    device = jax.devices()[0]
    if device.platform == "cpu":
        sys.exit("JAX finds no GPU: install a build of it for one, jax[cuda12] or jax[rocm], and see jax.devices().")
    study = Study.load(ROOT / "hilbo" / "data" / "paper.toml")
    table = cohort_of_people(study, people)
    table["category"] = table["response"].map({label: i for i, label in enumerate(study.responses)})
    population, points = (
        batch.population_of(study, cohort_of(table, study), distributed.alone()),
        study.space.candidates(POINTS, 0),
    )
    fitted = batch.refit(population, points)
    batch.sums(fitted.population, points)
    begun = time.perf_counter()
    fitted = batch.refit(population, points)
    whole = time.perf_counter() - begun
    begun = time.perf_counter()
    batch.sums(fitted.population, points)
    again = time.perf_counter() - begun
    peak = (device.memory_stats() or {}).get("peak_bytes_in_use", 0) / 1e6
    return {
        "people": people,
        "rate": people / whole,
        "points": people * POINTS / again,
        "peak": peak,
        "device": device.device_kind,
    }


def machine():
    return f"{len(os.sched_getaffinity(0))} cores ({platform.machine()}), Python {platform.python_version()}"


if __name__ == "__main__":
    main()
