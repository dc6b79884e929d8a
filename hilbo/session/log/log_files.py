"""File names of logs, and the logs in a folder."""

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
    """Whether there is a file at this path with anything but an empty or incomplete first line of a log."""
    try:
        with open(path, "rb") as file:
            return not is_unbegun(file.readline())
    except FileNotFoundError:
        return False


def in_use(path: str | os.PathLike) -> bool:
    """Whether another process has locked this log to write it. Raises OSError if it cannot be opened."""
    file = os.open(path, os.O_RDWR)
    try:
        lock(file, Path(path))
    except InputError:
        return True
    finally:
        os.close(file)
    return False


def log_name(header: Header) -> str:
    """File name of a session's log, PARTICIPANT_LABEL.session.jsonl, different for every session. A label with other
    characters than letters, digits, "." and "-" gets them replaced by "-", and a part of its SHA-256 appended."""
    label = header.session
    if not _PLAIN.fullmatch(label):
        label = f"{re.sub(r'[^a-zA-Z0-9.-]', '-', label)}~{hashlib.sha256(label.encode()).hexdigest()[:8]}"
    return f"{re.sub(r'[^a-zA-Z0-9_.-]', '-', header.participant)}_{label}{SUFFIX}"


def check_new(path: Path, header: Header) -> None:
    """Raise InputError if the session to be begun at `path` exists: there is a file, or another log in its folder has
    the same participant and label."""
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
    """Raise InputError if another log in the folder of `path`, of the same participant, is being written: one of the
    two ids must be wrong. Dry runs are not considered."""
    for other, first in _theirs(path, header.participant):
        if not first.dry_run and not header.dry_run and in_use(other):
            raise InputError(
                f"{other}: session {first.session} of {first.participant} is running; end that one first, or correct"
                " --participant."
            )


def _theirs(path: Path, participant: str) -> Iterator[tuple[Path, Header]]:
    """Yield the path and the header of each other log of a participant in the folder of `path`; unreadable logs are
    left out."""
    for other in log_paths(path.parent):
        with contextlib.suppress(InputError, OSError), open(other, "rb") as file:  # a damaged log has no owner
            header = read_lines(file.readline(), other).header
            if other != path and header.participant == participant:
                yield other, header


def keys_path(log: Path) -> Path:
    """Path of the file next to a log that contains the keys of its browsers: .PARTICIPANT_LABEL.keys."""
    return log.with_name(f".{log.name.removesuffix(SUFFIX)}.keys")


def log_paths(folder: str | os.PathLike, note: Callable[[str], object] = lambda sentence: None) -> list[Path]:
    """Paths of the logs in a folder, sorted by name; empty if there is no such folder.

    `note` is called with a sentence on each log that is left out: without a complete first line, under a name that does
    not end in .session.jsonl, or a copy of a lost log.
    """
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
    """Whether a file begins like a session's log, whatever its name; False if it cannot be read."""
    try:
        with open(path, "rb") as file:
            return file.read(len(FIRST)) == FIRST
    except OSError:
        return False


def _other_name(path: Path) -> str:
    """Sentence on a log that `log_paths` leaves out because of its name: a copy of a lost log, or a log that was
    renamed."""
    if path.name.endswith(RESCUED):
        return (
            f"{path}: is a copy of a session whose log was deleted, moved or changed while it ran, and is left out;"
            f" compare it with the session's log, and give it the name of that one (… {SUFFIX}) if it is the better."
        )
    return f"{path}: is a session's log under another name, and is left out; a log's name ends in {SUFFIX}."
