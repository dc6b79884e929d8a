"""Waiting times: every command of the README on the shipped data, whole processes, compared with `import jax`.

    python benchmarks/commands.py FILE [--before CHECKOUT] [--rounds 5] [--only NAME,NAME]
    python benchmarks/commands.py FILE --write

FILE (JSON Lines) collects a row for each command; a run that was stopped goes on at the first command without a row.
Each round runs the command once with cached programs and, with `--before`, once by another checkout of hilbo (in the
same environment); `import jax` stands between them. `empty` is one run with empty caches, `traced` one without kept
programs. Memory is the process's largest. --write puts the table into docs/results/run_time.md.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

from pages import put
from rows import Rows

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
    options.add_argument("file", type=Path)
    options.add_argument("--before", type=Path, help="another checkout")
    options.add_argument("--rounds", type=int, default=5)
    options.add_argument("--only", default=",".join(COMMANDS))
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    rows = Rows(chosen.file)
    if chosen.write:
        put("results/run_time.md", "commands", document(rows))
        return
    known = {row["command"] for row in rows}
    with tempfile.TemporaryDirectory() as folder:
        for name in chosen.only.split(","):
            if name not in known:
                rows.add({"command": name} | measured(name, chosen.rounds, chosen.before, Path(folder)))
    print(document(rows))


def measured(name, rounds, before, folder):
    """Seconds, seconds to the optimum and MB of every run of a command, by way; seconds of the imports between."""
    a_study(before or ROOT, folder)
    ways = {"cached": (ROOT, folder / f"cache {name}", True)}
    ways |= {} if before is None else {"before": (before, folder / f"cache {name} before", False)}
    runs = {f"{way}, empty": [command(name, *how, folder)] for way, how in ways.items()}
    for way, how in ways.items():  # not counted: the caches
        for _ in range(1 + (way == "cached")):
            command(name, *how, folder)
    imports = []
    for _ in range(rounds):
        for way, how in ways.items():
            imports.append(process([sys.executable, "-c", IMPORT], ROOT, folder / "import", True)[0])
            runs.setdefault(way, []).append(command(name, *how, folder))
    runs["traced"] = [command(name, ROOT, folder / f"cache {name}", False, folder)]
    return {"imports": imports, "runs": runs}


def a_study(root, folder):
    """The study that `report` reads, simulated by the older hilbo: it does not read every study file of a newer one."""
    if not (folder / "study").exists():
        words = ["simulate", "--participants", "10", "--out", str(folder / "study")]
        process([*HILBO, *words], root, folder / "study's cache", True)


def command(name, root, cache, keep, folder):
    out = folder / f"out {time.perf_counter_ns()}"
    words = COMMANDS[name].split()
    words = [word.replace("OUT", str(out)).replace("STUDY", str(folder / "study")) for word in words]
    seconds, first, memory = process(HILBO + words, root, cache, keep)
    print(f"{name:12} {root.name} {cache.name} {keep:d}: {seconds:.1f} s, {memory:.0f} MB", file=sys.stderr)
    return seconds, first, memory


def process(words, root, cache, keep):
    """Seconds in all, seconds until the optimum is printed (None: it is not), and the largest memory in MB."""
    environment = os.environ | {
        "XDG_CACHE_HOME": str(cache),
        "HILBO_KEEP_PROGRAMS": str(int(keep)),
        "PYTHONPATH": str(root),
        "PYTHONDONTWRITEBYTECODE": "",  # as a person's Python, which does not parse sources twice
    }
    begin, first = time.perf_counter(), None
    ends = subprocess.PIPE
    with subprocess.Popen(words, cwd=root, env=environment, stdout=subprocess.DEVNULL, stderr=ends) as running:
        said = []
        for line in running.stderr:
            said.append(line)
            if line.startswith(OPTIMUM) and first is None:
                first = time.perf_counter() - begin
        _, status, usage = os.wait4(running.pid, 0)
        running.returncode = os.waitstatus_to_exitcode(status)
    if running.returncode:
        sys.exit(f"{words}: {b''.join(said).decode()}")
    return time.perf_counter() - begin, first, usage.ru_maxrss / 1024


def document(rows):
    lines = [
        "Made by `python benchmarks/commands.py FILE --write`: whole processes, medians of five (*empty*, *traced*:",
        "one run), compared with `import jax` in the same minutes. Programs are cached between commands",
        "(docs/design.md). *traced* is with HILBO_KEEP_PROGRAMS=0, *empty* the first run of all, *before* the last",
        "commit at which every command traced and compiled for itself.",
        "",
        "| command | way | s | of `import jax` | optimum printed after, s | of `import jax` | memory, MB |",
        "|---|---|---:|---:|---:|---:|---:|",
    ]
    for row in rows:
        unit = median(row["imports"])
        lines += [line(row["command"], way, runs, unit) for way, runs in row["runs"].items()]
    return "\n".join([*lines, ""])


def line(name, way, runs, unit):
    seconds, first, memory = zip(*runs, strict=True)
    early = ("", "") if None in first else (f"{median(first):.1f}", f"{median(first) / unit:.1f}")
    cells = (name, way, f"{median(seconds):.1f}", f"{median(seconds) / unit:.1f}", *early, f"{median(memory):.0f}")
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
