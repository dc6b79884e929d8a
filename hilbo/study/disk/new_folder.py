"""A folder that is filled beside its place and put there whole; the one that it replaces is set aside until then.

`.NAME-….part` is being filled, and locked by the process that does so; `.NAME-….old` is set aside. What a killed
process left of both is dealt with by whoever makes a folder there next, and by a withdrawal.
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
"""The name of a folder that is not finished, or set aside."""


@contextlib.contextmanager
def new_folder(out: Path, check: Callable[[], None]) -> Iterator[Path]:
    """A folder to fill, which becomes `out` when the block ends well; all in it is its owner's alone. `check` raises
    InputError where `out` may not be replaced; what came there meanwhile stays, and the new folder gets another name.
    Raises InputError and OSError."""
    try:
        made, filling = _begun(out, check)
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
    """Deal with what killed processes left in a folder, whose lock is held: old ones come back where no new one is in
    their place, all else is removed. Returns the folders that are still being filled. Raises OSError."""
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


def _begun(out: Path, check: Callable[[], None]) -> tuple[Path, int]:
    """The folder to fill, and the lock that says so."""
    out.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    with locked_folder(out.parent):
        recover(out.parent)
        check()
        made = _beside(out, "part")
        made.mkdir(mode=0o700)
        filling = held(made / LOCK)
        assert filling is not None  # whoever else would lock it needs the lock of the folder first
    return made, filling


def _is_filled(path: Path) -> bool:
    """Whether a process fills this folder now, or has just put it in its place."""
    try:
        file = held(path / LOCK)
    except FileNotFoundError:
        return True
    if file is not None:
        os.close(file)
    return file is None


def _remove(folder: Path) -> None:
    while folder.exists():
        with contextlib.suppress(FileNotFoundError):  # whoever filled it is removing it too
            shutil.rmtree(folder)


def _beside(out: Path, kind: str) -> Path:
    return out.with_name(f".{out.name}-{secrets.token_hex(4)}.{kind}")


def _seal(folder: Path) -> None:
    """Make all in a folder its owner's alone, and force it to the disk."""
    for place, _, names in os.walk(folder):
        os.chmod(place, 0o700)
        for path in (Path(place, name) for name in names):
            os.chmod(path, 0o600)
            with open(path, "rb+") as file:
                os.fsync(file)
        sync_folder(Path(place))


def _publish(made: Path, out: Path, check: Callable[[], None]) -> None:
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
