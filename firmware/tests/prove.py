"""Proves the contracts in the core: Frama-C/WP with z3 and cvc4, for the word sizes of a Cortex-M.

    python3 firmware/tests/prove.py [FILE.c...]

Prints the number of goals of each file; exit status 1 if one of them is not proved, 2 if a tool is missing. What was
proved is written into proved.json beside this file, with a fingerprint of the sources, so that minutes of proofs are
done when the sources change. Needs frama-c, why3, z3 and cvc4 (on Debian: frama-c-base why3 z3 cvc4).
docs/device/firmware.md says what the contracts say.
"""

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

__all__ = ["FILES", "TOOLS", "Outcome", "Proved", "missing", "prove", "recorded", "to_record"]

CORE = Path(os.environ.get("HILBO_FIRMWARE_CORE", Path(__file__).parents[1] / "core"))
RECORD = Path(__file__).with_name("proved.json")
TOOLS = ("frama-c", "why3", "z3", "cvc4")


class Plan(NamedTuple):
    """Functions of a file whose contracts are believed (docs/device/firmware.md says why), those with a goal that cvc4
    does not prove, and those for which WP first takes the goal apart: a strategy that would cost minutes elsewhere."""

    believed: tuple[str, ...] = ()
    z3: tuple[str, ...] = ()
    apart: tuple[str, ...] = ()
    strategy: str = ""


_SHIFTS = "wp:range,wp:bitshift"  # each value of a short range in turn, then shifts as products
FILES = {
    "hb_frame.c": Plan(apart=("take",), strategy=_SHIFTS),
    "hb_line.c": Plan(z3=("with_sensed",)),
    "hb_messages.c": Plan(z3=("hb_pack_limits",), apart=("get_u16", "get_u32"), strategy=_SHIFTS),
    "hb_passivity.c": Plan(),
    "hb_renderer.c": Plan(
        believed=("warm_ticks", "hb_renderer_prepare"),
        z3=("hb_renderer_rest", "short_push", "full_push", "hb_renderer_step"),
        apart=("hb_renderer_step",),
        strategy="wp:split",
    ),
}
FAST, BOTH = "cvc4", "z3,cvc4"  # most goals need cvc4 only, which takes a seventh of the time of both
OPTIONS = [
    "-machdep", "gcc_x86_32", "-warn-special-float", "none", "-warn-unsigned-overflow",
    "-wp", "-wp-rte", "-wp-par", "2", "-wp-cache", "none",
]  # fmt: skip


class Outcome(NamedTuple):
    """Goals of one file, and what the prover said of those that it did not prove."""

    proved: int
    goals: int
    report: str


class Proved(NamedTuple):
    """What was proved of a file: all of so many goals, of sources with this fingerprint."""

    goals: int
    sources: str


def recorded() -> dict[str, Proved]:
    """By file what stands in proved.json."""
    return {file: Proved(**proved) for file, proved in json.loads(RECORD.read_text(encoding="utf-8")).items()}


def to_record(file: str, goals: int) -> Proved:
    """`goals` of a file, with SHA-256 of what its proof is of: the file, the core's headers, and this program, which
    says what is believed."""
    parts = [CORE / file, *sorted(CORE.glob("*.h")), Path(__file__)]
    return Proved(goals, hashlib.sha256(b"\0".join(part.read_bytes() for part in parts)).hexdigest())


def missing() -> list[str]:
    """The tools that are not installed."""
    return [tool for tool in TOOLS if shutil.which(tool) is None]


def _run(path: Path, extra: list[str], provers: str, seconds: int) -> Outcome:
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {"HOME": folder, "WHY3CONFIG": f"{folder}/why3.conf"}
        subprocess.run(["why3", "config", "detect"], env=environment, capture_output=True, check=False)
        limits = ["-wp-prover", provers, "-wp-timeout", str(seconds), "-wp-session", folder]
        command = ["frama-c", f"-cpp-extra-args=-I{path.parent}", *OPTIONS, *extra, *limits, str(path)]
        run = subprocess.run(command, env=environment, cwd=folder, capture_output=True, text=True, check=False)
    found = re.search(r"Proved goals: +(\d+) / (\d+)", run.stdout)
    lines = [line for line in run.stdout.splitlines() if not re.search(r"Goal \S+ : Valid|annotating", line)]
    report = "\n".join([*lines, run.stderr])
    if found is None or run.returncode != 0:
        return Outcome(0, 1, report)
    return Outcome(int(found[1]), int(found[2]), report)


def prove(file: str, function: str = "", core: Path = CORE, seconds: int = 20) -> Outcome:
    """All goals of a file of the core, or of one of its functions; each prover has so many seconds for a goal."""
    plan, path = FILES[file], core / file
    if function:
        return _run(path, ["-wp-fct", function], BOTH, seconds)
    elsewhere = {*plan.believed, *plan.z3, *plan.apart}
    parts = [_run(path, ["-wp-skip-fct", ",".join(elsewhere)] if elsewhere else [], FAST, seconds)]
    if whole := [function for function in plan.z3 if function not in plan.apart]:
        parts.append(_run(path, ["-wp-fct", ",".join(whole)], BOTH, seconds))
    if plan.apart:
        provers = BOTH if set(plan.apart) & set(plan.z3) else FAST
        parts.append(_run(path, ["-wp-fct", ",".join(plan.apart), "-wp-auto", plan.strategy], provers, seconds))
    proved, goals, reports = zip(*parts, strict=True)
    return Outcome(sum(proved), sum(goals), "".join(reports))


def main(files: list[str]) -> int:
    """Prove these files, or all."""
    if missing():
        print("The proofs need " + ", ".join(missing()) + ": on Debian, apt install frama-c-base why3 z3 cvc4.")
        return 2
    total, good = 0, {}
    for file in files or FILES:
        outcome = prove(file)
        print(f"{file:16} {outcome.proved:4} of {outcome.goals:4} goals proved", flush=True)
        if outcome.proved == outcome.goals > 0:
            good[file] = to_record(file, outcome.goals)
        else:
            print(outcome.report)
        total += outcome.proved
    print(f"{total} goals proved")
    _record(good)
    return 0 if len(good) == len(files or FILES) else 1


def _record(good: dict[str, Proved]) -> None:
    """Writes what was proved beside what stood there of other files."""
    known = recorded() if RECORD.exists() else {}
    content = {file: proved._asdict() for file, proved in sorted((known | good).items())}
    RECORD.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
