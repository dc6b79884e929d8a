"""A session on disk: JSON Lines, appended and forced to the disk one event at a time, read back whole or refused.

What a line is, and what of a damaged file counts, is in `hilbo.session.log.log_lines`; a last line that lacks its
newline gets it when the log is opened for writing, and one that is cut off within goes. One writer at a time, by a
lock of the operating system on the file, which goes with the process that holds it. A log is its owner's alone to read.
"""

import os
import re
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from hilbo.errors import InputError
from hilbo.session.log.header_check import check_new_header
from hilbo.session.log.log_lines import WHY_CUT, event_line, header_line, is_unbegun, read_lines
from hilbo.session.log.records import Event, Header
from hilbo.session.log.replay import replayed
from hilbo.session.log.state import LiveSession
from hilbo.study.disk.lock import lock
from hilbo.study.disk.new_file import sync_folder
from hilbo.study.file.reading import AnyStudy
from hilbo.study.formats.json_file import read_bytes

__all__ = ["EventLog", "LogError", "begun", "in_use", "keys_path", "log_name", "log_paths", "read_log", "read_session"]

_SUFFIX = ".session.jsonl"
_MODE = 0o600


class LogError(RuntimeError):
    """An event could not be written; the log is as it was before, and everything acknowledged is in it."""


class EventLog:
    """An open log: `create` a new one or `resume` one, then `append` events; `state` is always the fold of the file.

    `dropped`: what was wrong with the last line when the log was opened, or "". `sync_s`: the time the last fsync took.
    `before`: the events that were in it when it was opened.
    """

    def __init__(
        self,
        path: Path,
        file: int,
        state: LiveSession,
        previous: bytes,
        size: int,
        dropped: str,
        before: Sequence[Event] = (),
    ) -> None:
        self.path, self.state, self.dropped, self.before = path, state, dropped, before
        self.sync_s = 0.0
        self._file, self._previous, self._size = file, previous, size

    @classmethod
    def create(cls, path: str | os.PathLike, study: AnyStudy, header: Header) -> "EventLog":
        """Begin a log. Raises InputError if there is one already, or it cannot be written."""
        path = Path(path)
        state = LiveSession.start(study, header)
        check_new_header(study, header)
        try:
            path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)
            file = os.open(path, flags, _MODE)
        except OSError as error:
            raise InputError(f"{path}: cannot be written ({error.strerror}); choose another folder.") from error
        log = cls(path, file, state, b"", 0, "")
        try:
            lock(file, path)
            if not is_unbegun(_content(file)):
                raise InputError(f"{path}: exists already; resume it, or choose another session.")
            _cut(file, 0)
            log._write(header_line(header))
        except (LogError, InputError):
            log.close()
            raise
        sync_folder(path.parent)
        return log

    @classmethod
    def resume(cls, path: str | os.PathLike, study: AnyStudy) -> "EventLog":
        """Open a log to go on with it; a last line that is not whole is cut off. Raises InputError."""
        path = Path(path)
        try:
            file = os.open(path, os.O_RDWR | getattr(os, "O_BINARY", 0))
        except FileNotFoundError:
            raise InputError(f"{path}: is not there, no such session was begun; begin it without --resume.") from None
        except OSError as error:
            raise InputError(f"{path}: cannot be opened ({error.strerror}); check the path.") from error
        try:
            lock(file, path)
            content = _content(file)
            header, events, lines, dropped = read_lines(content, path)
            state = _folded(path, study, header, events)
            size = _ended(file, path, content, sum(map(len, lines)))
        except BaseException:
            os.close(file)
            raise
        return cls(path, file, state, lines[-1], size, dropped, events)

    def append(self, event: Event) -> LiveSession:
        """Put an event on the disk, and only then into the state, which is returned. Raises LogError."""
        state = self.state.after(event)
        self._write(event_line(event, self._previous))
        self.state = state
        return state

    def _write(self, line):
        begun = time.perf_counter()
        try:
            os.lseek(self._file, self._size, os.SEEK_SET)
            left = memoryview(line)
            while left:
                left = left[os.write(self._file, left) :]
            os.fsync(self._file)
        except OSError as error:
            _cut(self._file, self._size)
            raise LogError(
                f"{self.path}: cannot be written ({error.strerror}); free some space on the disk and try again,"
                " everything acknowledged so far is safe."
            ) from error
        self._previous, self._size = line, self._size + len(line)
        self.sync_s = time.perf_counter() - begun

    def close(self) -> None:
        """Let others write."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def __enter__(self) -> "EventLog":
        return self

    def __exit__(self, *_) -> None:
        self.close()


def read_log(path: str | os.PathLike, study: AnyStudy | None = None) -> tuple[Header, list[Event], str]:
    """Header, events, and what was dropped at the end; for readers, without a lock. Raises InputError."""
    header, events, _, dropped = read_lines(read_bytes(path), path)
    if study is not None:
        _check_study(path, study, header)
    return header, events, dropped


def read_session(
    path: str | os.PathLike, study: AnyStudy, note: Callable[[str], Any] = lambda sentence: None
) -> LiveSession:
    """The session of a log, every event checked; for readers, without a lock. `note` is told of what was dropped at the
    end. Raises InputError."""
    header, events, dropped = read_log(path, study)
    if dropped:
        note(dropped)
    return _folded(path, study, header, events)


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
    return "_".join(re.sub(r"[^\w.-]", "-", part) for part in parts) + _SUFFIX


def keys_path(log: Path) -> Path:
    """The file beside a log that keeps the keys of its browsers. It has the log's own name, so that no other session
    can have it."""
    return log.with_name(f".{log.name.removesuffix(_SUFFIX)}.keys")


def log_paths(folder: str | os.PathLike, note: Callable[[str], Any] = lambda sentence: None) -> list[Path]:
    """The logs in a folder that were begun, in the order of their names; `note` is told of others."""
    whole = []
    for path in sorted(Path(folder).glob("*" + _SUFFIX)):
        if begun(path):
            whole.append(path)
        else:
            note(f"{path}: has no whole first line, and is left out; {WHY_CUT}")
    return whole


def _ended(file, path, content, size) -> int:
    """Bring a log to the end of its last good line: what is torn off goes, a newline that is missing comes. The size.
    Raises InputError."""
    if size == len(content):
        return size
    try:
        if size < len(content):
            os.ftruncate(file, size)
        else:
            os.lseek(file, len(content), os.SEEK_SET)
            os.write(file, b"\n")
        os.fsync(file)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); free some space and try again.") from error
    return size


def _check_study(path, study, header):
    if header.study != study.hash:
        raise InputError(
            f"{path}: is the log of another study ({header.study}, not {study.hash}); use the study file that it was"
            " started with."
        )


def _folded(path, study, header, events) -> LiveSession:
    _check_study(path, study, header)
    try:
        return replayed(study, header, events)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _cut(file, size):
    """Take back what was half written; if even that fails, the next reader drops it as a torn line."""
    try:
        os.ftruncate(file, size)
        os.fsync(file)
    except OSError:
        pass


def _content(file) -> bytes:
    os.lseek(file, 0, os.SEEK_SET)
    pieces = []
    while piece := os.read(file, 2**20):
        pieces.append(piece)
    return b"".join(pieces)
