"""Names of logs, and the logs of a folder."""

import os
import re
from collections.abc import Callable
from pathlib import Path

from hilbo.errors import InputError
from hilbo.session.log.log_lines import FIRST, WHY_CUT, is_unbegun
from hilbo.session.log.records import Header
from hilbo.session.log.rescue import RESCUED
from hilbo.study.disk.lock import lock

__all__ = ["begun", "in_use", "is_log", "keys_path", "log_name", "log_paths"]

SUFFIX = ".session.jsonl"


def begun(path: str | os.PathLike) -> bool:
    """Whether there is a session at this path, or another file: not where a log was killed within its first line."""
    try:
        with open(path, "rb") as file:
            return not is_unbegun(file.readline())
    except FileNotFoundError:
        return False


def in_use(path: str | os.PathLike) -> bool:
    """Whether somebody is writing this log."""
    file = os.open(path, os.O_RDWR)
    try:
        lock(file, Path(path))
    except InputError:
        return True
    finally:
        os.close(file)
    return False


def log_name(header: Header) -> str:
    """File name of a session's log."""
    parts = (header.participant, header.session)
    return "_".join(re.sub(r"[^\w.-]", "-", part) for part in parts) + SUFFIX


def keys_path(log: Path) -> Path:
    """The file beside a log that keeps the keys of its browsers. It has the log's own name, so that no other session
    can have it."""
    return log.with_name(f".{log.name.removesuffix(SUFFIX)}.keys")


def log_paths(folder: str | os.PathLike, note: Callable[[str], object] = lambda sentence: None) -> list[Path]:
    """The logs in a folder that were begun, in the order of their names. `note` gets a sentence on each log that is
    left out: without a whole first line, under another name, or a copy of a log that was lost."""
    whole = []
    for path in sorted(Path(folder).iterdir() if Path(folder).is_dir() else ()):
        if not path.is_file() or path.name.startswith("._"):  # AppleDouble files, which macOS writes on other disks
            continue
        if not path.name.endswith(SUFFIX):
            if is_log(path):
                note(_other_name(path))
        elif begun(path):
            whole.append(path)
        else:
            note(f"{path}: has no whole first line, and is left out; {WHY_CUT}")
    return whole


def is_log(path: str | os.PathLike) -> bool:
    """Whether a file begins as a session's log does, whatever its name."""
    try:
        with open(path, "rb") as file:
            return file.read(len(FIRST)) == FIRST
    except OSError:
        return False


def _other_name(path: Path) -> str:
    if path.name.endswith(RESCUED):
        return (
            f"{path}: is a copy of a session whose log was deleted, moved or changed while it ran, and is left out;"
            f" compare it with the session's log, and give it the name of that one (… {SUFFIX}) if it is the better."
        )
    return f"{path}: is a session's log under another name, and is left out; a log's name ends in {SUFFIX}."
