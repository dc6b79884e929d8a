"""Names of logs, and the logs of a folder."""

import contextlib
import hashlib
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path

from hilbo.errors import InputError
from hilbo.session.log.log_lines import FIRST, WHY_CUT, is_unbegun, read_lines
from hilbo.session.log.records import Header
from hilbo.session.log.rescue import RESCUED
from hilbo.study.disk.lock import lock

__all__ = ["begun", "check_alone", "check_new", "in_use", "is_log", "keys_path", "log_name", "log_paths"]

SUFFIX = ".session.jsonl"
_PLAIN = re.compile("[a-zA-Z0-9.-]+")


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
    """File name of a session's log, of no other session: the last "_" is before the label, and one with other
    characters than letters, digits, "." and "-" ends in a part of its SHA-256."""
    label = header.session
    if not _PLAIN.fullmatch(label):
        label = f"{re.sub(r'[^a-zA-Z0-9.-]', '-', label)}~{hashlib.sha256(label.encode()).hexdigest()[:8]}"
    return f"{re.sub(r'[^a-zA-Z0-9_.-]', '-', header.participant)}_{label}{SUFFIX}"


def check_new(path: Path, header: Header) -> None:
    """Refuse to begin a session at `path` that has been begun: there, or under another name in this folder. Raises
    InputError."""
    if begun(path):
        raise InputError(
            f"{path}: this session has been begun; add --resume to go on with it, or choose another --session."
        )
    for other, first in _theirs(path, header.participant):
        if first.session == header.session:
            raise InputError(
                f"{other}: is session {first.session} of {first.participant}; rename it to {path.name} and add --resume"
                " to go on with it, or choose another --session."
            )


def check_alone(path: Path, header: Header) -> None:
    """Refuse a session whose participant has another one that is running, from a log of the same folder: whoever it is
    whose id is wrong, the answers of two people would be one's. Dry runs are nobody's. Raises InputError."""
    for other, first in _theirs(path, header.participant):
        if not first.dry_run and not header.dry_run and in_use(other):
            raise InputError(
                f"{other}: session {first.session} of {first.participant} is running; end that one first, or correct"
                " --participant."
            )


def _theirs(path: Path, participant: str) -> Iterator[tuple[Path, Header]]:
    """The other logs of a participant in the folder of this one, with their headers."""
    for other in log_paths(path.parent):
        with contextlib.suppress(InputError, OSError), open(other, "rb") as file:  # a damaged log is nobody's
            header = read_lines(file.readline(), other).header
            if other != path and header.participant == participant:
                yield other, header


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
