"""Locks of the operating system, which end with the process that holds them: on an open file, and on a folder.

A folder is locked by a file in it, `.hilbo.lock`, which is removed with the lock. Every command that reads a shared
file, changes it and writes it again does so under the lock of the file's folder. A withdrawal keeps its journal in the
folder that it was given, and as long as the journal is there, no folder below is locked by another command.
"""

import contextlib
import os
import time
from collections.abc import Iterator
from pathlib import Path

from hilbo.errors import InputError

__all__ = ["JOURNAL", "LOCK", "held", "lock", "locked_folder", "withdrawal_above"]

LOCK = ".hilbo.lock"
JOURNAL = ".hilbo-withdrawal.json"
_PATIENCE = 10.0  # s; a table is written anew in far less
_PAUSE = 0.01  # s


def lock(file: int, path: Path) -> None:
    """Lock an open file, at once. Raises InputError if another holds it."""
    try:
        if os.name == "nt":
            import msvcrt

            os.lseek(file, 2**30, os.SEEK_SET)  # a byte that no log has: readers are not to be locked out
            msvcrt.locking(file, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        raise InputError(f"{path}: is being written by another hilbo; close that one first.") from None


def held(path: Path, flags: int = os.O_CREAT) -> int | None:
    """A file opened and locked, for its owner alone where it is new; None if another holds it, or removed it meanwhile.
    A link is not followed. Raises OSError."""
    file = os.open(path, os.O_RDWR | flags | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0), 0o600)
    try:
        lock(file, path)
        if os.path.samestat(os.fstat(file), os.lstat(path)):
            return file
    except (InputError, FileNotFoundError):
        pass
    os.close(file)
    return None


def withdrawal_above(folder: Path) -> Path | None:
    """The folder, of this one and those above it, in which a withdrawal is going on or was interrupted."""
    return next((place for place in (folder, *folder.parents) if (place / JOURNAL).exists()), None)


@contextlib.contextmanager
def locked_folder(folder: Path, patience: float = _PATIENCE, *, in_withdrawal: bool = False) -> Iterator[None]:
    """Hold the lock of a folder. `in_withdrawal`: although a withdrawal's journal is there. Raises InputError if the
    folder is not free within `patience` (s), or cannot be written to."""
    folder, deadline = Path(os.path.realpath(folder)), time.monotonic() + patience
    path = folder / LOCK
    while True:
        try:
            file = held(path)
        except OSError as error:
            raise InputError(f"{path}: cannot be opened for a lock ({error.strerror}); check the folder.") from error
        place = None if in_withdrawal else withdrawal_above(folder)
        if file is not None and place is None:
            break
        if file is not None:
            _release(file, path)
        if time.monotonic() > deadline:
            raise InputError(
                f"{folder}: is being changed by another hilbo; wait until that one is done."
                if place is None
                else f"{place}: a withdrawal is going on there or was interrupted; wait for it, or give its command"
                " (hilbo participants delete) again."
            )
        time.sleep(_PAUSE)
    try:
        yield
    finally:
        _release(file, path)


def _release(file: int, path: Path) -> None:
    with contextlib.suppress(OSError):  # Windows removes no open file; the next one to lock it finds it there
        path.unlink()
    os.close(file)
