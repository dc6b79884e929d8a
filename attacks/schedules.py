"""Two to eight commands at once on one study, killed at random changes of the disk and given again until all are done.

    python attacks/schedules.py --count 1000 --seed 0 --state schedules.json

Each command is a process of its own, forked from one that has imported hilbo; a preloaded library (kill_before.c) kills
it before its n-th change of the disk, in the middle of a write too. What was killed or refused is given again. When all
are done, nobody who withdrew is in any byte below the study, in the cache of compiled programs or in the temporary
folder; nobody else is missing; every file is whole; no half-written file stays; and every command runs (those that fit
models after each tenth schedule).
"""

import contextlib
import csv
import ctypes
import importlib
import io
import json
import os
import pkgutil
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT)]

from attacks.schedule_ground import PEOPLE, make_ground
from attacks.support import main, scratch
from hilbo.errors import InputError
from hilbo.session.log.event_log import read_log
from hilbo.study.disk.lock import JOURNAL, LOCK
from hilbo.study.results.listing import LIST, digest, listed

__all__ = ["schedule_case"]

QUICKLY = "--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1"
AGAIN = 12  # rounds after which a command counts as never done
KINDS = {"delete": 3, "add": 3, "export": 3, "plan": 2, "init": 2, "aggregate": 1, "report": 0.4}
DONE = ("nothing of participant", "exists already", "is there already", "exist already", "is there already")


class Command:
    """A command of the schedule, and what came of the last attempt."""

    def __init__(self, kind: str, words: list[str]) -> None:
        self.kind, self.words, self.is_done, self.said = kind, words, False, ""


def _delete(person: str, _: object) -> list[str]:
    return ["participants", "delete", ".", person, "--yes"]


def _add(_: str, out: object) -> list[str]:
    consent = ["--consent-time", "2026-05-04T10:00", "--protocol-number", "7"]
    return ["participants", "add", "participants.csv", f"Later{out}", *consent]


def _export(_: str, out: object) -> list[str]:
    return ["export", "logs", "--study", "study.toml", "--out", f"export{out}"]


def _plan(_: str, out: object) -> list[str]:
    return ["plan", "study.toml", "--names", f"N{out}a,N{out}b", "--out", f"plan{out}.json"]


def _init(_: str, out: object) -> list[str]:
    return ["init", f"study{out}.toml", "--parameter", "hue=0:360:deg"]


def _aggregate(_: str, out: object) -> list[str]:
    source = "trials.csv" if out in (0, 1) else "logs"
    return ["aggregate", source, "--study", "study.toml", "--out", f"map{out}"]


def _report(_: str, out: object) -> list[str]:
    return ["report", ".", "--no-compare", "--out", f"report{out}"]


WORDS: dict[str, Callable[[str, object], list[str]]] = {
    "delete": _delete,
    "add": _add,
    "export": _export,
    "plan": _plan,
    "init": _init,
    "aggregate": _aggregate,
    "report": _report,
}


def schedule_case() -> Callable[[random.Random, int], str]:
    """The attack's case, in a folder of this process with cache and temporary folder of its own."""
    root = scratch("schedules")
    for name in ("cache", "tmp"):
        (root / name).mkdir()
    os.environ |= {"XDG_CACHE_HOME": str(root / "cache"), "TMPDIR": str(root / "tmp"), "MPLBACKEND": "Agg"}
    os.environ.setdefault("XLA_FLAGS", QUICKLY)
    import_all()
    status, said = forked(lambda: make_ground(root / "whole"), root, None, root / "ground.txt")
    if status != 0:
        raise RuntimeError(said)

    def case(rng: random.Random, number: int) -> str:
        shutil.copytree(root / "whole", root / "study")
        try:
            wrong = Schedule(root, rng).run(models=number % 10 == 9)
        finally:
            shutil.rmtree(root / "study")
        return f"THROUGH: {'; '.join(wrong)}" if wrong else "all is done"

    return case


def import_all() -> None:
    """Import what commands import, before they are forked; no backend of JAX is begun."""
    for package in ("hilbo.cli", "hilbo.report", "hilbo.study", "hilbo.population", "hilbo.session"):
        for module in pkgutil.walk_packages(importlib.import_module(package).__path__, f"{package}."):
            importlib.import_module(module.name)
    for name in ("h5netcdf", "matplotlib.figure", "pandas", "xarray"):
        importlib.import_module(name)


def forked(function: Callable[[], object], folder: Path, kill: int | None, said: Path) -> tuple[int, str]:
    """Run a function in a forked process: its exit status, negative for a signal, and what it printed."""
    child = begun(function, folder, kill, said)
    return ended(child), said.read_text(errors="replace")


def begun(function: Callable[[], object], folder: Path, kill: int | None, said: Path) -> int:
    """The pid of a forked process that runs a function in `folder`, and is killed before change number `kill`."""
    child = os.fork()
    if child:
        return child
    status = 70
    try:
        file = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(file, 1)
        os.dup2(file, 2)
        sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
        os.chdir(folder)
        tempfile.tempdir = None
        if kill is not None:
            ctypes.CDLL(None).hilbo_kill_before(ctypes.c_long(kill))
        function()
        status = 0
    except SystemExit as stopped:
        status = stopped.code if isinstance(stopped.code, int) else int(stopped.code is not None)
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(status)
    raise AssertionError


def ended(child: int) -> int:
    """The exit status of a process, negative for a signal."""
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def hilbo(words: list[str]) -> Callable[[], None]:
    """A command of hilbo as a function."""

    def run() -> None:
        from hilbo.cli.main import main as hilbo_main

        sys.argv = ["hilbo", *words]
        hilbo_main()

    return run


class Schedule:
    """One schedule in the study of `root`: commands at once, then whatever was not done again and again."""

    def __init__(self, root: Path, rng: random.Random) -> None:
        self.root, self.study, self.rng = root, root / "study", rng
        count = rng.randint(2, 8)
        kinds = ["delete", *rng.choices(list(KINDS), list(KINDS.values()), k=count - 1)]
        people = rng.sample(PEOPLE, len(PEOPLE))
        made = [(kind, WORDS[kind](people[i % (len(people) - 1)], i % 3)) for i, kind in enumerate(kinds)]
        self.gone = {words[3] for kind, words in made if kind == "delete"}
        self.commands = [Command(kind, words) for kind, words in made]
        self.left: set[str] = set()
        self.tracebacks: list[str] = []

    def run(self, *, models: bool) -> list[str]:
        """What is wrong when all is done. `models`: also run the commands that fit models afterwards."""
        for attempt in range(AGAIN):
            self._round([c for c in self.commands if not c.is_done], at_once=attempt < 2)
        wrong = [f"never done: {c.words}: {c.said[-300:]}" for c in self.commands if not c.is_done]
        wrong += self.tracebacks
        return wrong or [*self._faults(), *self._afterwards(models)]

    def _round(self, commands: list[Command], *, at_once: bool) -> None:
        """Give commands, at once with kills, or one after the other without."""
        self.rng.shuffle(commands)
        running = []
        for number, command in enumerate(commands):
            kill = int(10 ** self.rng.uniform(0, 2.7)) if at_once and self.rng.random() < 0.6 else None
            said = self.root / f"said{number}.txt"
            running.append((command, begun(hilbo(command.words), self.study, kill, said), said))
            if not at_once:
                self._take(*running.pop())
            elif self.rng.random() < 0.5:
                time.sleep(self.rng.random() * 0.4)
        for one in running:
            self._take(*one)

    def _take(self, command: Command, child: int, said: Path) -> None:
        status = ended(child)
        command.said = said.read_text(errors="replace")
        said.unlink()
        if "Traceback" in command.said:
            self.tracebacks.append(f"{' '.join(command.words)}: {command.said[-2000:]}")
        command.is_done = status == 0 or (status == 2 and any(words in command.said for words in DONE))
        if command.kind == "delete":
            self.left |= {line.split(": LEFT; ")[0].strip() for line in command.said.splitlines() if ": LEFT; " in line}

    def _afterwards(self, models: bool) -> Iterator[str]:
        """Which command does not run on the study now."""
        for kind in KINDS:
            if kind == "delete" or (kind in ("aggregate", "report") and not models):
                continue
            words = WORDS[kind]("", "-afterwards")
            status, said = forked(hilbo(words), self.study, None, self.root / "said.txt")
            if status != 0:
                yield f"afterwards {' '.join(words)}: {status}: {said[-600:]}"
        yield from self._traces()

    def _faults(self) -> Iterator[str]:
        """What is wrong with the files."""
        yield from self._traces()
        yield from self._lost_rows()
        there = set(PEOPLE) - self.gone
        added = {c.words[3] for c in self.commands if c.kind == "add"}
        listed_people = {row["participant"] for row in _table(self.study / "participants.csv")}
        yield from (f"{person} is not in the list" for person in added - listed_people)
        logs = {read_log(path)[0].participant for path in (self.study / "logs").glob("*.session.jsonl")}
        yield from (f"the log of {person} is missing" for person in there - logs)
        planned = [row["participant"] for row in json.loads((self.study / "plan.json").read_text())["participants"]]
        yield from (f"{person} is missing in the plan" for person in there - set(planned))
        yield from self._damages()

    def _lost_rows(self) -> Iterator[str]:
        """Tables that lack rows of somebody who is still in the study."""
        for name in ("participants.csv", "trials.csv"):
            now, before = _table(self.study / name), _table(self.root / "whole" / name)
            for person in set(PEOPLE) - self.gone:
                if _rows_of(person, now) != _rows_of(person, before):
                    yield f"{name} has lost rows of {person}"

    def _damages(self) -> Iterator[str]:
        """Files that are not whole, and those that should not be there."""
        for path in sorted(self.study.rglob("*")):
            name = path.relative_to(self.study)
            if path.name in (JOURNAL, LOCK) or path.suffix in (".part", ".old"):  # of files and of folders
                yield f"{name} stays"
            elif path.suffix == ".json":
                try:
                    json.loads(path.read_text())
                except ValueError as error:
                    yield f"{name}: {error}"
            elif path.suffix == ".csv" and any(None in row or None in row.values() for row in _table(path)):
                yield f"{name} has a row that is not whole"
            elif path.name.endswith(".session.jsonl"):
                try:
                    read_log(path)
                except InputError as error:
                    yield str(error)
        for path in self.study.rglob(LIST):
            for name, was in listed(path.parent).files.items():
                if not (path.parent / name).exists() or digest(path.parent / name) != was:
                    yield f"{path.parent.name}/{name} is not as listed"
        yield from (f"{path} stays in the temporary folder" for path in (self.root / "tmp").rglob("*"))

    def _traces(self) -> Iterator[str]:
        """Where somebody who withdrew still is."""
        word = re.compile("|".join(sorted(self.gone)).encode())
        for folder in (self.study, self.root / "cache", self.root / "tmp"):
            for path in folder.rglob("*"):
                name = path.relative_to(folder).as_posix()
                if name not in self.left and word.search(name.encode() + (_bytes(path) if path.is_file() else b"")):
                    yield f"{name} names one of {sorted(self.gone)}"


def _table(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV file; none where it is not there."""
    return list(csv.DictReader(io.StringIO(path.read_text()))) if path.exists() else []


def _rows_of(person: str, rows: list[dict[str, str]]) -> list[dict[str, str]]:
    """The rows of one participant."""
    return [row for row in rows if row["participant"] == person]


def _bytes(path: Path) -> bytes:
    """The bytes of a file, and of what it compresses."""
    content = path.read_bytes()
    if path.suffix == ".nc":
        import h5py

        with h5py.File(path) as file:
            found: list[bytes] = []
            file.visititems(lambda _, node: found.append(_node(node)))
        return content + b"".join(found)
    if path.suffix == ".parquet":
        import pandas as pd

        return content + pd.read_parquet(path).to_csv().encode()
    return content


def _node(node) -> bytes:
    import h5py

    values = str(node[()].tolist()) if isinstance(node, h5py.Dataset) and node.size and node.size < 1e4 else ""
    return f"{dict(node.attrs)} {values}".encode()


def _preloaded() -> None:
    """Begin this process again with kill_before.c before the system's own functions."""
    if "kill_before" in (loaded := os.environ.get("LD_PRELOAD", "")):
        del os.environ["LD_PRELOAD"]
        shutil.rmtree(Path(loaded).parent)  # the processes that are forked have it in memory
        return
    library = Path(tempfile.mkdtemp(prefix="hilbo-preloaded-")) / "kill_before.so"
    source = Path(__file__).with_name("kill_before.c")
    subprocess.run(["gcc", "-O1", "-shared", "-fPIC", "-o", library, source, "-ldl"], check=True)
    os.execve(sys.executable, [sys.executable, *sys.argv], os.environ | {"LD_PRELOAD": str(library)})


if __name__ == "__main__":
    _preloaded()
    main(schedule_case, __doc__ or "", 1000, every=5)
