"""What the attacks share: a seeded case for each number, counts, a state file to go on from, and ways to damage bytes.

An attack is a function `case(rng, number) -> str`, the word under which its outcome is counted; words that begin with
"THROUGH" are what must not be.
"""

import argparse
import atexit
import json
import random
import shutil
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

__all__ = ["HOSTILE", "begin_at", "damaged", "main", "mutated", "run", "scratch"]

Case = Callable[[random.Random, int], str]

HOSTILE: tuple[Any, ...] = (
    *(None, True, False, 0, -1, -3, 1, 2, 7, 10**6, 2**31, 2**63, -(2**63), 10**30),
    *(0.5, -0.0, 1e308, -1e308, 5e-324, 1e-9, 3.0000000001),
    *("", "x", "a", "b", "NaN", "1", "-1", "=1+1", "@SUM(A1)", "..", ".", "-x", "../../etc/passwd", "P01", "close"),
    *("\x00", "\u202e", "é", "x" * 5000, [], {}, [[]], {"a": 1}, [1, 2, 3], {"a": {}}, [None]),
)
"""Values to put in the place of others."""


def damaged(rng: random.Random, content: bytes) -> bytes:
    """Bytes as a disk, a copy or an editor may leave them; never the same ones."""
    while True:
        made = bytearray(content)
        at, size = rng.randrange(len(made) + 1), rng.choice((1, 1, 1, 4, 64, 512))
        match rng.choice(("flip", "byte", "cut", "insert", "delete", "double", "zero", "swap", "lines")):
            case "flip" if at < len(made):
                made[at] ^= 1 << rng.randrange(8)
            case "byte" if at < len(made):
                made[at] = rng.randrange(256)
            case "cut":
                del made[at:]
            case "insert":
                made[at:at] = rng.randbytes(size)
            case "delete":
                del made[at : at + size]
            case "double":
                made[at:at] = made[at : at + size]
            case "zero":
                made[at : at + size] = bytes(len(made[at : at + size]))
            case "swap":
                made[:] = made[at:] + made[:at]
            case "lines":
                lines = bytes(made).splitlines(keepends=True)
                rng.shuffle(lines)
                made[:] = b"".join(lines[: rng.randrange(len(lines) + 1)])
        if bytes(made) != content:
            return bytes(made)


def mutated(rng: random.Random, tree: Any) -> Any:
    """Parsed JSON with one thing in it changed, taken out, doubled or renamed."""
    tree = json.loads(json.dumps(tree))
    places = list(_places(tree))
    parent, key = rng.choice(places)
    kind = rng.choice(("set", "set", "set", "remove", "double", "rename", "near"))
    value = parent[key]
    if kind == "near" and isinstance(value, int | float) and not isinstance(value, bool):
        parent[key] = value + rng.choice((-1, 1, 0.5, -0.5, 1e-6, value, -2 * value))
    elif kind == "remove":
        del parent[key]
    elif kind == "double" and isinstance(parent, list):
        parent.insert(key, value)
    elif kind == "rename" and isinstance(parent, dict):
        parent[rng.choice((f"{key}x", "K1", "a", ""))] = parent.pop(key)
    else:
        parent[key] = rng.choice(HOSTILE)
    return tree


def _places(tree: Any):
    """Every (container, key or index) of a tree."""
    pairs = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in pairs:
        yield tree, key
        yield from _places(value)


def scratch(name: str) -> Path:
    """A folder for this process, which goes with it."""
    folder = Path(tempfile.mkdtemp(prefix=f"hilbo-{name}-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def begin_at(state: Path | None, seed: int) -> tuple[int, Counter[str]]:
    """The number to go on from, and the counts so far."""
    if state is None or not state.exists():
        return 0, Counter()
    kept = json.loads(state.read_text(encoding="utf-8"))
    if kept["seed"] != seed:
        raise SystemExit(f"{state}: is of seed {kept['seed']}; give that one, or another --state.")
    return kept["next"], Counter(kept["counts"])


def run(case: Case, count: int, seed: int, state: Path | None = None, every: int = 50) -> Counter[str]:
    """Cases up to `count`, each from its own seed; the counts. The state file is written every so many cases."""
    begin, counts = begin_at(state, seed)
    for number in range(begin, count):
        try:
            outcome = case(random.Random(f"{seed}/{number}"), number)
        except Exception:
            outcome = "THROUGH: traceback"
            print(f"case {number}:\n{traceback.format_exc()}", file=sys.stderr)
        if outcome.startswith("THROUGH"):
            print(f"case {number}: {outcome}", file=sys.stderr)
        counts[outcome] += 1
        if state is not None and ((number + 1) % every == 0 or number + 1 == count):
            kept = {"seed": seed, "next": number + 1, "counts": counts}
            state.with_suffix(".new").write_text(json.dumps(kept), encoding="utf-8")
            state.with_suffix(".new").replace(state)
    return counts


def main(make: Callable[[], Case], words: str, count: int, every: int = 50) -> None:
    """The command line of an attack; exit code 1 if something got through. `make` prepares it; the state is kept after
    `every` so many cases."""
    parser = argparse.ArgumentParser(description=words)
    parser.add_argument("--count", type=int, default=count)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--state", type=Path, default=None, help="File to go on from after a stop.")
    given, begun = parser.parse_args(), time.perf_counter()
    counts = run(make(), given.count, given.seed, given.state, every)
    for outcome, number in sorted(counts.items()):
        print(f"{number:>10,}  {outcome}")
    print(f"{sum(counts.values()):>10,}  in all, {time.perf_counter() - begun:.0f} s in this run")
    raise SystemExit(any(outcome.startswith("THROUGH") for outcome in counts))
