"""Atomic writing of a folder: a temporary folder next to it is filled and renamed; an existing one is moved aside until
then.

`.NAME-….part` is the folder being filled, locked by the process that fills it; `.NAME-….old` is the previous one, moved
aside. Leftovers of killed processes are recovered or removed by the next process that makes a folder there, and by a
withdrawal.
"""

import contextlib
import itertools
import os
import re
import secrets
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

from hilbo.errors import InputError
from hilbo.study.disk.lock import LOCK, held, locked_folder, withdrawal_above
from hilbo.study.disk.new_file import sync_folder

__all__ = ["LEFTOVER", "new_folder", "recover"]

LEFTOVER = re.compile(r"\.(.+)-[0-9a-f]{8}\.(part|old)")
"""Pattern of the names of folders that are unfinished, or moved aside."""


@contextlib.contextmanager
def new_folder(out: Path, check: Callable[[], None]) -> Iterator[Path]:
    """Context manager that gives an empty temporary folder; on success it becomes `out`, on an exception it is deleted.

    Its files and folders are made accessible to their owner only and synced. `check` raises InputError if `out` may not
    be replaced; it is called before and after the block. If it fails after, `out` stays, the new folder becomes `OUT-2`
    (or the next free number), and InputError says so. Raises InputError for a folder that cannot be written, locked, or
    is in a withdrawal, and OSError.
    """
    try:
        made, filling = _create_unfinished(out, check)
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror}); choose another folder.") from error
    try:
        if withdrawal_above(out.parent):  # it has begun since, and may have looked for folders like this one before
            raise InputError(f"{out}: a withdrawal is going on there; wait for it, and give this command again.")
        yield made
        _seal(made)
        with locked_folder(out.parent, in_withdrawal=True):  # a withdrawal refuses until this one is done
            os.close(filling)
            filling = -1
            (made / LOCK).unlink()
            _publish(made, out, check)
    finally:
        if filling >= 0:
            os.close(filling)
        shutil.rmtree(made, ignore_errors=True)


def recover(folder: Path) -> list[Path]:
    """Clean up leftovers of killed processes in a folder, whose lock the caller holds: a folder moved aside is restored
    if its place is empty, otherwise deleted; unfinished ones are deleted. Returns the temporary folders that are still
    being filled. Raises OSError."""
    filled = []
    for path in sorted(path for path in folder.iterdir() if LEFTOVER.fullmatch(path.name)):
        name, kind = LEFTOVER.fullmatch(path.name).groups()  # type: ignore[union-attr]
        if kind == "old" and not (folder / name).exists():
            path.rename(folder / name)
        elif kind == "part" and _is_filled(path):
            filled.append(path)
        else:
            _remove(path)
    return filled


def _create_unfinished(out: Path, check: Callable[[], None]) -> tuple[Path, int]:
    """Create the temporary folder of `out`, and missing parents; returns its path and the descriptor of its lock.
    Leftovers are recovered and `check` is called first. Raises InputError and OSError."""
    out.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    with locked_folder(out.parent):
        recover(out.parent)
        check()
        made = _beside(out, "part")
        made.mkdir(mode=0o700)
        filling = held(made / LOCK)
        assert filling is not None  # other processes need the lock of the folder before they lock it
    return made, filling


def _is_filled(path: Path) -> bool:
    """Whether a process holds the lock of this temporary folder, or has just renamed it."""
    try:
        file = held(path / LOCK)
    except FileNotFoundError:
        return True
    if file is not None:
        os.close(file)
    return file is None


def _remove(folder: Path) -> None:
    """Delete a folder and its content, even while another process deletes it too."""
    while folder.exists():
        with contextlib.suppress(FileNotFoundError):  # the process that filled it is removing it too
            shutil.rmtree(folder)


def _beside(out: Path, kind: str) -> Path:
    """Hidden path next to `out` with a random part: `.NAME-….kind`. Nothing is created."""
    return out.with_name(f".{out.name}-{secrets.token_hex(4)}.{kind}")


def _seal(folder: Path) -> None:
    """Restrict all folders (0700) and files (0600) of a folder to their owner, and sync them to disk."""
    for place, _, names in os.walk(folder):
        os.chmod(place, 0o700)
        for path in (Path(place, name) for name in names):
            os.chmod(path, 0o600)
            with open(path, "rb+") as file:
                os.fsync(file)
        sync_folder(Path(place))


def _publish(made: Path, out: Path, check: Callable[[], None]) -> None:
    """Rename `made` to `out`; an existing `out` is moved aside first and deleted afterwards.

    If `check` raises InputError, `made` gets the next free name `OUT-2`, `OUT-3`, …, and InputError with that name is
    raised.
    """
    try:
        check()
    except InputError as error:
        beside = next(path for n in itertools.count(2) if not (path := out.with_name(f"{out.name}-{n}")).exists())
        made.rename(beside)
        raise InputError(f"{error} It came while this was computed; these results are in {beside}.") from None
    aside = _beside(out, "old")
    if out.exists():
        out.rename(aside)
    made.rename(out)
    sync_folder(out.parent)
    if aside.exists():
        shutil.rmtree(aside)
