"""A session on disk: JSON Lines, appended and synced one event at a time, read back whole or refused.

`hilbo.session.log.log_lines` defines the lines, and how damage is treated: when a log is opened for writing, a last
line without its newline gets it, and an incomplete one is cut off. Only one process writes a log, by a lock of the
operating system on the file, which ends with the process. Only the file's owner may read it.
"""

import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from hilbo.errors import InputError
from hilbo.session.log.header_check import check_new_header, own_study
from hilbo.session.log.log_lines import event_line, event_of, header_line, is_unbegun, read_lines
from hilbo.session.log.records import Event, Header
from hilbo.session.log.replay import check_types, replayed
from hilbo.session.log.rescue import fault_of, rescue
from hilbo.session.log.state import LiveSession
from hilbo.study.disk.lock import lock
from hilbo.study.disk.new_file import sync_folder
from hilbo.study.file.reading import StudyFile
from hilbo.study.formats.json_file import read_bytes

__all__ = ["EventLog", "LogError", "LogLostError", "read_log", "read_session"]

_MODE = 0o600
# Appended to: a write at the expected place would fill a file that was cut meanwhile with zeros, up to its old size.
_OPEN = os.O_RDWR | os.O_APPEND | getattr(os, "O_BINARY", 0)


class LogError(RuntimeError):
    """An event could not be written to the disk, and is not part of the session."""


class LogLostError(LogError):
    """The file at the log's path is no longer the open log; no event can be acknowledged any more."""


class EventLog:
    """An open, locked log: `create` a new one or `resume` one, then `append` events. `state`: session after all events
    of the file.

    `dropped`: sentence on an incomplete last line when the log was opened, or "". `sync_s`: duration of the last write
    with its fsync (s). `before`: the events that were in it when it was opened.

    A log that was deleted, moved, replaced or edited while it is open raises `LogLostError` from then on; the events
    that were acknowledged are written once to a copy next to it.
    """

    def __init__(
        self,
        path: Path,
        file: int,
        state: LiveSession,
        lines: list[bytes],
        dropped: str,
        before: Sequence[Event] = (),
    ) -> None:
        self.path, self.state, self.dropped, self.before = path, state, dropped, before
        self.sync_s = 0.0
        self._file, self._lines, self._size = file, lines, sum(map(len, lines))
        self._torn, self._fault, self._copy = False, "", None

    @classmethod
    def create(cls, path: str | os.PathLike, study: StudyFile, header: Header) -> "EventLog":
        """Create the log of a new session, with its folder, write and sync the header line, and lock the file. The
        header that is written contains the study file.

        A file with nothing but an incomplete header line is overwritten. Raises InputError for a header that is not
        valid, and if there is a log already, it is locked, or it cannot be created; LogError if the header cannot be
        written.
        """
        path = Path(path)
        header = replace(header, study_tables=study.tables)
        state = LiveSession.start(study, header)
        check_new_header(study, header)
        try:
            path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            flags = _OPEN | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0)
            file = os.open(path, flags, _MODE)
        except OSError as error:
            raise InputError(f"{path}: cannot be written ({error.strerror}); choose another folder.") from error
        log = cls(path, file, state, [], "")
        try:
            lock(file, path)
            if not is_unbegun(_content(file)):
                raise InputError(f"{path}: exists already; resume it, or choose another session.")
            _cut(file, 0)
            line = header_line(header)
            log._write(line)
            log._lines.append(line)
        except (LogError, InputError):
            log.close()
            raise
        sync_folder(path.parent)
        return log

    @classmethod
    def resume(cls, path: str | os.PathLike, study: StudyFile) -> "EventLog":
        """Open and lock an existing log to append to it, and check all of its events. The session goes on with the
        study file that it was begun with (`LiveSession.study`).

        An incomplete last line is cut off the file, a missing last newline is added. Raises InputError if there is no
        log, or it is locked, damaged, or its responses mean something else than those of `study`.
        """
        path = Path(path)
        try:
            file = os.open(path, _OPEN)
        except FileNotFoundError:
            raise InputError(f"{path}: is not there, no such session was begun; begin it without --resume.") from None
        except OSError as error:
            raise InputError(f"{path}: cannot be opened ({error.strerror}); check the path.") from error
        try:
            lock(file, path)
            content = _content(file)
            header, events, lines, dropped = read_lines(content, path)
            state = _folded(path, study, header, events)
            _repair_end(file, path, content, sum(map(len, lines)))
        except BaseException:
            os.close(file)
            raise
        return cls(path, file, state, lines, dropped, events)

    def append(self, event: Event) -> LiveSession:
        """Write and sync an event, and only then apply it to `state`, which is returned.

        Raises LogError, LogLostError or InputError; `state` is then unchanged.
        """
        line = self._line(event)
        state = self.state.after(event)
        self.check()
        self._write(line)
        self.check()
        self._lines.append(line)
        self.state = state
        return state

    def check(self) -> None:
        """Raise LogLostError if the file at the log's path is not this log as it was written, now or at an earlier
        check.

        Before it is raised, the acknowledged events are copied to a new file next to it; if that fails, each call tries
        again. The file is not compared while part of a failed write cannot be cut off.
        """
        if not self._torn:
            self._fault = self._fault or fault_of(self.path, self._file, self._size)
        if not self._fault:
            return
        answers = sum(trial.status == "answered" for trial in self.state.trials)
        acknowledged = f"Acknowledged so far: {answers} answer{'' if answers == 1 else 's'}"
        try:
            self._copy = self._copy or rescue(self.path, self._lines)
        except OSError as error:
            raise LogLostError(
                f"{self.path}: {self._fault}. {acknowledged}, which could not be copied ({error.strerror}) and would be"
                " lost; make the folder writable, and leave this server running until this message changes."
            ) from error
        raise LogLostError(
            f"{self.path}: {self._fault}, and the session has stopped. {acknowledged}, in {self._copy}; end this"
            " server, compare the two files, give one of them the name of the log, and go on with --resume."
        )

    def _line(self, event: Event) -> bytes:
        """Return the event's line, after a check that a reader would accept it. Raises LogError if not. Writes
        nothing."""
        line = event_line(event, self._lines[-1])
        try:
            check_types(event_of(line, self.path))
        except InputError as error:
            raise LogError(f"{self.path}: nothing was written, because it could not be read again: {error}") from error
        return line

    def _write(self, line: bytes) -> None:
        """Append the bytes `line` to the file and sync it; update the expected size and `sync_s`.

        If that fails, the file is cut back to its former size, now or before the next write, and LogError is raised.
        """
        begun = time.perf_counter()
        try:
            if self._torn:
                _cut(self._file, self._size)
                self._torn = False
            left = memoryview(line)
            while left:
                left = left[os.write(self._file, left) :]
            os.fsync(self._file)
        except OSError as error:
            try:
                _cut(self._file, self._size)
            except OSError:  # the next reader drops the torn line; the next event waits until it can be cut off
                self._torn = True
            raise LogError(
                f"{self.path}: cannot be written ({error.strerror}); free some space on the disk and try again,"
                " everything acknowledged so far is safe."
            ) from error
        self._size += len(line)
        self.sync_s = time.perf_counter() - begun

    def close(self) -> None:
        """Close the file, which ends its lock; a second call does nothing."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def __enter__(self) -> "EventLog":
        return self

    def __exit__(self, *_) -> None:
        self.close()


def read_log(path: str | os.PathLike, study: StudyFile | None = None) -> tuple[Header, list[Event], str]:
    """Read the header and the events of a log, and a sentence on an incomplete last line ("" if there is none).

    Takes no lock. Checks the lines and, if `study` is given, that responses mean the same in both, but not whether the
    events fit the state: see `read_session`. Raises InputError.
    """
    header, events, _, dropped = read_lines(read_bytes(path), path)
    if study is not None:
        _own_study(path, study, header)
    return header, events, dropped


def read_session(
    path: str | os.PathLike, study: StudyFile, note: Callable[[str], Any] = lambda sentence: None
) -> LiveSession:
    """Read a log and return the state after its events, each of them checked, with the study file that the session was
    begun with; takes no lock.

    `note` is called with the sentence on an incomplete last line, if there is one. Raises InputError if the file cannot
    be read, is damaged, or its responses mean something else than those of `study`.
    """
    header, events, dropped = read_log(path)
    if dropped:
        note(dropped)
    return _folded(path, study, header, events)


def _repair_end(file: int, path: str | os.PathLike, content: bytes, size: int) -> None:
    """Make an open log end with its last complete line. `content`: bytes of the file; `size`: bytes of its complete
    lines, with their newlines. Cuts off what follows, or adds the missing newline. Raises InputError if that fails."""
    if size == len(content):
        return
    try:
        if size < len(content):
            os.ftruncate(file, size)
        else:
            os.write(file, b"\n")
        os.fsync(file)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); free some space and try again.") from error


def _own_study(path: str | os.PathLike, study: StudyFile, header: Header) -> StudyFile:
    """The study file that the log at `path` was begun with (`own_study`). Raises InputError, with `path`."""
    try:
        return own_study(study, header)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _folded(path: str | os.PathLike, study: StudyFile, header: Header, events: Sequence[Event]) -> LiveSession:
    """Return the state after the events, each of them checked, with the log's own study file. Raises InputError, with
    `path`, also if responses mean something else than those of `study`."""
    begun_with = _own_study(path, study, header)
    try:
        return replayed(begun_with, header, events)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _cut(file: int, size: int) -> None:
    """Cut an open file to `size` bytes and sync it; a shorter file stays as it is. Raises OSError."""
    if os.fstat(file).st_size > size:
        os.ftruncate(file, size)
        os.fsync(file)


def _content(file: int) -> bytes:
    """Read all bytes of an open file, given by its descriptor."""
    os.lseek(file, 0, os.SEEK_SET)
    pieces = []
    while piece := os.read(file, 2**20):
        pieces.append(piece)
    return b"".join(pieces)
