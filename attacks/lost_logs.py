"""Logs that are deleted, moved, replaced, cut or refused by the disk while their session runs.

    python attacks/lost_logs.py --count 500 --seed 0 --state lost_logs.json

A case writes a session's events into a log, and meanwhile another thread does one thing to the file at a random moment.
Afterwards every event that was acknowledged is in the file, or in the copy that the refusal names.
"""

import os
import random
import shutil
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[1] / "tests" / "support")]

from live import STUDY, Driver

from attacks.support import main, scratch
from hilbo.errors import InputError
from hilbo.session.log.event_log import EventLog, LogError, LogLostError, read_log
from hilbo.session.log.log_files import log_name

__all__ = ["lost_log_case"]


def _replace(path: Path) -> None:
    shutil.copy(path, path.with_name("save"))
    os.replace(path.with_name("save"), path)


def _copy_back(path: Path) -> None:
    path.rename(path.with_name("moved"))
    shutil.copy(path.with_name("moved"), path)


def _append(path: Path) -> None:
    with open(path, "ab") as file:
        file.write(b"{}\n")


FAULTS: dict[str, Callable[[Path], object]] = {
    "deleted": Path.unlink,
    "moved": lambda path: path.rename(path.with_name("moved")),
    "replaced": _replace,
    "moved and copied back": _copy_back,
    "cut": lambda path: os.truncate(path, path.stat().st_size // 2),
    "lengthened": _append,
    "folder renamed": lambda path: path.parent.rename(path.parent.with_name("renamed")),
    "read-only": lambda path: path.chmod(0o400),
    "nothing": lambda path: None,
}


def lost_log_case() -> Callable[[random.Random, int], str]:
    """The attack's case, with one session's events for all of them."""
    driver = Driver()
    driver.step()
    for number in range(9):
        driver.do("go" if driver.state.screen == "ready" else "answer", number)
    root = scratch("lost-logs")

    def case(rng: random.Random, number: int) -> str:
        name = list(FAULTS)[number % len(FAULTS)]
        folder = root / str(number)
        path = folder / "logs" / log_name(driver.header)
        with EventLog.create(path, STUDY.file, driver.header) as log:
            fault = threading.Timer(rng.random() * 0.02, FAULTS[name], [path])
            fault.start()
            acknowledged, error = _appended(log, driver.events, fault)
        kept = _kept(folder)
        shutil.rmtree(folder)
        if max(kept) < acknowledged:
            return f"THROUGH {name}: {acknowledged} acknowledged, {kept} in files"
        if error is None and name not in ("read-only", "nothing"):
            return f"THROUGH {name}: no refusal"
        return f"{name}: {'refused' if error else 'went on'}"

    return case


def _appended(log: EventLog, events: list, fault: threading.Timer) -> tuple[int, LogError | None]:
    """Number of events that were acknowledged, and the refusal; after the fault the log is checked as a server does."""
    for count, event in enumerate(events):
        try:
            log.append(event)
        except LogError as error:
            return count, error
        time.sleep(1e-3)
    fault.join()
    try:
        log.check()
    except LogLostError as error:
        return len(events), error
    return len(events), None


def _kept(folder: Path) -> list[int]:
    """Number of events of each file below the folder that reads as a log."""
    found = [0]
    for path in folder.rglob("*"):
        if path.is_file():
            try:
                found.append(len(read_log(path, STUDY.file)[1]))
            except InputError:
                continue
    return found


if __name__ == "__main__":
    main(lost_log_case, __doc__.partition("\n")[0], 500)
