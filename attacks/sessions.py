"""A real session for attacks: `hilbo session` as a process on a simulated device, with its own files and words."""

import contextlib
import json
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from hilbo.app.rehearsal.rehearsal import HILBO, fast_study
from hilbo.app.rehearsal.robot import Client

__all__ = ["Session", "session", "started"]

DATA = Path(__file__).parents[1] / "hilbo" / "data" / "paper.toml"


class Session(NamedTuple):
    """A running one. `words` is the file of what its process prints on stderr."""

    process: subprocess.Popen
    participant: Client
    experimenter: Client
    port: int
    words: Path


@contextlib.contextmanager
def started(folder: Path, *more: str, seconds: float = 0.05) -> Iterator[tuple[subprocess.Popen, dict[str, str], Path]]:
    """A session of short steps without consent, ended at the end: its process, unused links, the file of its words."""
    study = fast_study(DATA, folder / "study.toml", seconds, 2)
    given = (
        "--participant",
        "P01",
        "--logs",
        str(folder / "logs"),
        "--port",
        "0",
        "--pause",
        "0",
        "--dry-run",
        "--json",
    )
    with open(folder / "words", "w", encoding="utf-8") as words:
        process = subprocess.Popen(
            [*HILBO, "session", str(study), *given, *more], stdout=subprocess.PIPE, stderr=words, text=True
        )
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        if not line:
            raise RuntimeError((folder / "words").read_text(encoding="utf-8"))
        yield process, json.loads(line), folder / "words"
    finally:
        process.terminate()
        process.wait(60)
        if process.stdout is not None:
            process.stdout.close()


@contextlib.contextmanager
def session(folder: Path, *more: str, seconds: float = 0.05) -> Iterator[Session]:
    """A session as in `started`, with a program for each role."""
    with started(folder, *more, seconds=seconds) as (process, links, words):
        participant, experimenter = Client(links["participant"]), Client(links["experimenter"])
        yield Session(process, participant, experimenter, int(experimenter.address.rpartition(":")[2]), words)
