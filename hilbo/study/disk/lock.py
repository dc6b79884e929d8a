"""Locks of the operating system, which end with the process that holds them: on an open file, and on a folder.

A folder is locked by a file in it, `.hilbo.lock`, which is removed with the lock. Every command that reads a shared
file, changes it and writes it back does so under the lock of the file's folder. A withdrawal of a participant keeps a
journal in the folder that it works on; while the journal exists, other commands can lock neither that folder nor one
below it.
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
_PATIENCE = 10.0  # s; a table is rewritten in far less
_PAUSE = 0.01  # s


def lock(file: int, path: Path) -> None:
    """Lock an open file (a descriptor) exclusively, without waiting; `path` is for the message. Raises InputError if
    another process holds the lock."""
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
    """Open and lock a file; returns its descriptor, or None if another process holds the lock or has removed the file
    meanwhile.

    `flags` are added to O_RDWR; by default a missing file is created, readable by its owner only. Symbolic links are
    not followed. Raises OSError.
    """
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
    """The innermost of this folder and its parents that has the journal of a running or interrupted withdrawal; None if
    none."""
    return next((place for place in (folder, *folder.parents) if (place / JOURNAL).exists()), None)


@contextlib.contextmanager
def locked_folder(folder: Path, patience: float = _PATIENCE, *, in_withdrawal: bool = False) -> Iterator[None]:
    """Context manager that holds the lock of a folder. `in_withdrawal`: ignore a withdrawal's journal.

    Retries until `patience` (s) is over, then raises InputError if the folder is still locked or in a withdrawal;
    raises it at once if a withdrawal was interrupted there or above, or the lock file cannot be opened.
    """
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
        if place is not None and _is_interrupted(place):
            raise InputError(
                f"{place}: a withdrawal was interrupted there; give its command (hilbo participants delete) again"
                " first."
            )
        if time.monotonic() > deadline:
            doing = "is being changed by another hilbo" if place is None else "a withdrawal is going on there"
            raise InputError(f"{place or folder}: {doing}; wait until that one is done.")
        time.sleep(_PAUSE)
    try:
        yield
    finally:
        _release(file, path)


def _is_interrupted(place: Path) -> bool:
    """Whether the withdrawal that has its journal in this folder was killed: the lock is free."""
    try:
        file = held(place / LOCK)
    except OSError:
        return False
    if file is None:
        return False
    is_left = (place / JOURNAL).exists()
    _release(file, place / LOCK)
    return is_left


def _release(file: int, path: Path) -> None:
    """Remove the lock file and close its descriptor, which ends the lock."""
    with contextlib.suppress(OSError):  # Windows removes no open file; the next one to lock it finds it there
        path.unlink()
    os.close(file)
