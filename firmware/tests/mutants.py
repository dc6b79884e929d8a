"""Mutants of the state machine, drawn by a seed: how many of them the default firmware tests notice.

    python firmware/tests/mutants.py [--count 200] [--seed 0]

A mutant changes one place of the core: a comparison, a logical or arithmetic operator, a constant, a condition that is
negated, a statement that is left out. One that does not compile is drawn again. It prints a line for each survivor, and
at the end "N of M noticed". Survivors are argued one by one in docs/device/firmware.md.
"""

import argparse
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
CORE = ROOT / "firmware" / "core"
FILES = ("hb_motion.c", "hb_requests.c", "hb_device.c", "hb_staging.c", "hb_safety.c", "hb_drive.c", "hb_delay.c")
TESTS = ("edges", "protocol", "orders", "safety", "telemetry", "sets", "contact", "switching")
SWAPS = {
    "<=": "<", ">=": ">", "==": "!=", "!=": "==", "&&": "||", "||": "&&", " < ": " <= ", " > ": " >= ",
    " + ": " - ", " - ": " + ", " * ": " / ", " += ": " -= ", " -= ": " += ",
}  # fmt: skip
_SWAP = re.compile("|".join(re.escape(old) for old in sorted(SWAPS, key=len, reverse=True)))
_STATEMENT = re.compile(r"^    +[^/\n{}]*[^=!<>]=[^=][^\n{}]*;$|^    +(?:\(void\))?hb_\w+\([^\n{}]*\);$", re.M)
_CONDITION = re.compile(r"\bif \((.*)\) \{$", re.M)
_NUMBER = re.compile(r"(?<![\w.])(\d+)U\b")


class Mutant(NamedTuple):
    """Text `new` in place of `file`'s characters from `start` to `end`."""

    file: str
    start: int
    end: int
    new: str

    def words(self) -> str:
        """Text for a survivor: file, line, the old code and the new."""
        text = (CORE / self.file).read_text(encoding="utf-8")
        line = text.count("\n", 0, self.start) + 1
        return f"{self.file}:{line}: {text[self.start : self.end].strip()!r} -> {self.new.strip()!r}"


def _code(text: str) -> str:
    """The C text with comments and preprocessor lines replaced by blanks, so that positions stay the same."""

    def blank(found: re.Match) -> str:
        return re.sub(r"[^\n]", " ", found[0])

    return re.sub(r"^#.*$", blank, re.sub(r"/\*.*?\*/", blank, text, flags=re.S), flags=re.M)


def places(file: str) -> Iterator[Mutant]:
    """Yield every mutant of a file: operators swapped, statements left out, conditions negated, numbers + 1."""
    code = _code((CORE / file).read_text(encoding="utf-8"))
    for found in _SWAP.finditer(code):
        line = code[: found.start()].rsplit("\n", 1)[-1]
        if "static inline" not in line and "_Static_assert" not in line:  # the latter is for the compiler to notice
            yield Mutant(file, found.start(), found.end(), SWAPS[found[0]])
    for found in _STATEMENT.finditer(code):
        if not re.match(r"\s*(?:const |static |struct |float |bool |u?int\w* |size_t |enum |return|for)", found[0]):
            yield Mutant(file, found.start(), found.end(), "    ;")
    for found in _CONDITION.finditer(code):
        yield Mutant(file, found.start(1), found.end(1), f"!({found[1]})")
    for found in _NUMBER.finditer(code):
        if "_Static_assert" in code[: found.start()].rsplit("\n", 1)[-1]:
            continue
        yield Mutant(file, found.start(1), found.end(1), str(int(found[1]) + 1))


def verdict(mutant: Mutant) -> str:
    """Run the default firmware tests on a copy of the core with this mutant.

    Returns "noticed" (a test failed, or all took longer than 120 s), "survives" or "does not compile".
    """
    with tempfile.TemporaryDirectory() as folder:
        core = Path(folder) / "core"
        shutil.copytree(CORE, core)
        text = (core / mutant.file).read_text(encoding="utf-8")
        (core / mutant.file).write_text(text[: mutant.start] + mutant.new + text[mutant.end :], encoding="utf-8")
        environment = os.environ | {"HILBO_FIRMWARE_CORE": str(core), "HILBO_FIRMWARE_FLAGS": "-Wno-error -w"}
        names = ("passivity", *TESTS) if mutant.file == "hb_delay.c" else TESTS
        tests = [str(ROOT / "tests" / "firmware" / f"test_{name}.py") for name in names]
        options = ["-x", "-q", "-n", "0", "-m", "not deep", "--noconftest", "-p", "no:cacheprovider", "--tb=line"]
        command = [sys.executable, "-m", "pytest", *options, *tests]
        try:
            done = subprocess.run(
                command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120, check=False
            )
        except subprocess.TimeoutExpired:
            return "noticed"
    if "-std=c11" in done.stdout:
        return "does not compile"
    return "noticed" if done.returncode else "survives"


def main() -> None:
    """Draw and test mutants as the command line asks; print the survivors and the number noticed.

    Exits with a message if the tests fail on the unchanged core.
    """
    parser = argparse.ArgumentParser()
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    if verdict(Mutant("hb_delay.c", 0, 0, "")) != "survives":
        sys.exit("The tests fail on the core as it is; mend that first.")
    drawn = [mutant for file in FILES for mutant in places(file)]
    random.Random(asked.seed).shuffle(drawn)
    noticed = tried = 0
    for mutant in drawn:
        if tried == asked.count:
            break
        found = verdict(mutant)
        if found == "does not compile":
            continue
        tried, noticed = tried + 1, noticed + (found == "noticed")
        if found == "survives":
            print(f"survives  {mutant.words()}", flush=True)
    print(f"{noticed} of {tried} noticed (of {len(drawn)} places, seed {asked.seed})")


if __name__ == "__main__":
    main()
