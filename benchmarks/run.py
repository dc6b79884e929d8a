"""Run time against the textbook NumPy form (benchmarks/reference_numpy.py), as ratios within one run.

    python benchmarks/run.py            one core, one BLAS thread, for both
    python benchmarks/run.py --cores 2  both may use two cores
    python benchmarks/run.py --write    both of these, and what limits them, into docs/results/run_time.md

The two take turns, round by round, hilbo once with Laplace and once with expectation propagation; a row is the median
over the rounds and the ratio of medians. The live step is repeated many times, for its 99th percentile; it and the
session are timed in loops of their own as well. What is timed is in run_tasks.py, what no program could do without in
run_floors.py.
"""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

from pages import put
from run_document import document, floor_text, table

ROOT = Path(__file__).parents[1]
SHORT = ("live step", "session")  # so short that it matters whether caches still hold their code
sys.path.insert(0, str(ROOT))


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--cores", type=int, default=1)
    options.add_argument("--rounds", type=int, default=15)
    options.add_argument("--json", action="store_true")
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    if chosen.write:
        runs = [measured_elsewhere(cores, chosen.rounds) for cores in (1, 2)]
        put("results/run_time.md", "run", document(runs, chosen.rounds))
        return
    limit_cores(chosen.cores)
    run = measure(chosen.rounds)
    print(json.dumps(run) if chosen.json else table(run) + floor_text(run))


def limit_cores(cores):
    """Before NumPy and JAX are imported."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[name] = str(cores)
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[-cores:])
    if cores == 1:
        os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false " + os.environ.get("XLA_FLAGS", "")


def measured_elsewhere(cores, rounds):
    command = [sys.executable, "-W", "ignore", __file__, "--json", "--cores", str(cores), "--rounds", str(rounds)]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout.splitlines()[-1])


def measure(rounds):
    """Seconds of every task, and of what it cannot do without."""
    import numpy as np
    from run_floors import floors
    from run_tasks import data, once, tasks

    scene = data()
    run = {"tasks": {}, "floors": floors(rounds, scene)}
    for name, (ours, theirs) in tasks(scene).items():
        for function in (*ours, theirs):
            once(function)
        count = 40 * rounds if name == "live step" else max(rounds // 5, 3) if name == "hyperparameters" else rounds
        run["tasks"][name] = quantiles([[once(function) for function in (*ours, theirs)] for _ in range(count)])
        if name in SHORT:
            loops = [[once(function) for _ in range(count)] for function in (*ours, theirs)]
            run["tasks"][f"{name}, alone"] = quantiles(np.transpose(loops))
        print(name, run["tasks"][name], file=sys.stderr)
    return run


def quantiles(times):
    """Median and 99th percentile (s) of columns."""
    import numpy as np

    return {"median": np.median(times, axis=0).tolist(), "p99": np.quantile(times, 0.99, axis=0).tolist()}


if __name__ == "__main__":
    main()
