"""What a person waits for: every command of the README on what is shipped, whole processes, beside `import jax`.

    python benchmarks/commands.py [--before CHECKOUT] [--rounds 5] [--write]

--write puts the table into docs/results/run_time.md.

Each round runs every command once with kept programs, once without and, with `--before`, once by another checkout of
hilbo (in the same environment); `import jax` stands between them. `empty` is one run with empty caches. Memory is
the process's largest.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from statistics import median

from pages import put

ROOT = Path(__file__).parents[1]
DATA = "hilbo/data"
HILBO = [sys.executable, "-c", "from hilbo.cli.main import main; main()"]
IMPORT = "import jax"
COMMANDS = {
    "passivity": "passivity --K1 5.58 --B1 7.88 --alpha 0.176",
    "plan": f"plan {DATA}/paper.toml --participants 24 --out OUT.json",
    "identify": f"identify {DATA}/memory_foam_simulated.csv --out OUT --damping 0.95",
    "aggregate": f"aggregate {DATA}/video_quality.csv --study {DATA}/video_quality.toml --out OUT",
    "robustness": f"robustness {DATA}/video_quality.csv --study {DATA}/video_quality.toml --out OUT",
    "simulate": "simulate --participants 24 --out OUT",
    "report": "report STUDY --out OUT",
    "demo": "demo --out OUT",
}
OPTIMUM = b"The population optimum"


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--before", type=Path, help="another checkout")
    options.add_argument("--rounds", type=int, default=5)
    options.add_argument("--only", default=",".join(COMMANDS))
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    names = chosen.only.split(",")
    with tempfile.TemporaryDirectory() as folder:
        text = document(table(names, chosen.rounds, chosen.before, Path(folder)), chosen.rounds)
    print(text)
    if chosen.write:
        put("results/run_time.md", "commands", text)


def table(names, rounds, before, folder):
    """Seconds, seconds to the optimum and MB of every run, by command and way."""
    study = ["simulate", "--participants", "10", "--out", str(folder / "study")]
    oldest = before or ROOT  # an older hilbo does not read every study file of a newer one
    process([*HILBO, *study], oldest, folder / "study's cache", True)
    ways = {"kept": (ROOT, "warm", True), "traced": (ROOT, "warm", False)}
    ways |= {} if before is None else {"before": (before, "before", False)}
    runs = defaultdict(list)
    for name in names:
        for way, (root, cache, keep) in ways.items():
            if way != "traced":
                runs[name, f"{way}, empty"].append(command(name, root, folder / f"empty {name} {cache}", keep, folder))
            for _ in range(1 + (way == "kept")):  # not counted: the caches
                command(name, root, folder / cache, keep, folder)
        for _ in range(rounds):
            for way, (root, cache, keep) in ways.items():
                runs[IMPORT, ""].append(process([sys.executable, "-c", IMPORT], ROOT, folder / "warm", True))
                runs[name, way].append(command(name, root, folder / cache, keep, folder))
    return runs


def command(name, root, cache, keep, folder):
    out = folder / f"out {time.perf_counter_ns()}"
    words = COMMANDS[name].split()
    words = [word.replace("OUT", str(out)).replace("STUDY", str(folder / "study")) for word in words]
    seconds, first, memory = process(HILBO + words, root, cache, keep)
    print(f"{name:12} {root.name} {cache.name} {keep:d}: {seconds:.1f} s, {memory:.0f} MB", file=sys.stderr)
    return seconds, first, memory


def process(words, root, cache, keep):
    """Seconds in all, seconds until the optimum is printed (NaN: it is not), and the largest memory in MB."""
    environment = os.environ | {
        "XDG_CACHE_HOME": str(cache),
        "HILBO_KEEP_PROGRAMS": str(int(keep)),
        "PYTHONPATH": str(root),
        "PYTHONDONTWRITEBYTECODE": "",  # as a person's Python, which does not parse sources twice
    }
    begin, first = time.perf_counter(), float("nan")
    ends = subprocess.PIPE
    with subprocess.Popen(words, cwd=root, env=environment, stdout=subprocess.DEVNULL, stderr=ends) as running:
        said = []
        for line in running.stderr:
            said.append(line)
            if line.startswith(OPTIMUM) and first != first:
                first = time.perf_counter() - begin
        _, status, usage = os.wait4(running.pid, 0)
        running.returncode = os.waitstatus_to_exitcode(status)
    if running.returncode:
        sys.exit(f"{words}: {b''.join(said).decode()}")
    return time.perf_counter() - begin, first, usage.ru_maxrss / 1024


def document(runs, rounds):
    unit = median(seconds for seconds, _, _ in runs[IMPORT, ""])
    lines = [
        f"Made by `python benchmarks/commands.py --write`: whole processes, medians of {rounds}, beside `import jax`,",
        f"which took {unit:.2f} s in the same run. Programs are kept from one command to the next (docs/design.md);",
        "*traced* is with HILBO_KEEP_PROGRAMS=0, *empty* the first run of all, *before* another checkout, if one was",
        "named.",
        "",
        "| command | way | s | of `import jax` | optimum printed after, s | of `import jax` | memory, MB |",
        "|---|---|---:|---:|---:|---:|---:|",
    ]
    for (name, way), values in runs.items():
        if name == IMPORT:
            continue
        seconds, first, memory = (median(column) for column in zip(*values, strict=True))
        early = ("", "") if first != first else (f"{first:.1f}", f"{first / unit:.1f}")
        cells = (name, way, f"{seconds:.1f}", f"{seconds / unit:.1f}", *early, f"{memory:.0f}")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join([*lines, ""])


if __name__ == "__main__":
    main()
