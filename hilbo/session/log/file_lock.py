"""A lock of the operating system on an open file; it goes with the process that holds it."""

import contextlib
import os
import time
from collections.abc import Iterator
from pathlib import Path

from hilbo.errors import InputError

__all__ = ["lock", "lock_name", "locked_beside"]

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


def lock_name(path: Path) -> str:
    """The name of the empty file beside a file that is replaced, by which one is alone with it."""
    return f".{path.name}.lock"


@contextlib.contextmanager
def locked_beside(path: Path, patience: float = _PATIENCE) -> Iterator[None]:
    """Be alone with a file that is replaced, by an empty file beside it, which stays. Raises InputError if another is
    not done within `patience` (s), and OSError."""
    beside = path.with_name(lock_name(path))
    file = os.open(beside, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        with contextlib.suppress(OSError):  # somebody else's, who has done so
            os.chmod(beside, 0o666)
        deadline = time.monotonic() + patience
        while True:
            try:
                lock(file, path)
                break
            except InputError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(_PAUSE)
        yield
    finally:
        os.close(file)
