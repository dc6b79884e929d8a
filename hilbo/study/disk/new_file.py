"""A file that is written beside its place, forced to the disk, and put there whole.

What is being written has a random name that no other process can have made (`.hilbo-….part`), is its owner's alone to
read, and is locked, so that what a killed process left behind is known and removed.
"""

import contextlib
import errno
import os
import secrets
import stat
from collections.abc import Iterator
from pathlib import Path

from hilbo.study.disk.lock import held

__all__ = ["UNFINISHED", "new_file", "remove_unfinished", "rewrite_file", "sync_folder", "write_file"]

UNFINISHED = ".hilbo-*.part"
_OWNER_ONLY = 0o600
_NO_LINKS = {errno.EPERM, errno.EOPNOTSUPP, errno.ENOTSUP, errno.ENOSYS, errno.EINVAL}


@contextlib.contextmanager
def new_file(path: Path, *, replace: bool, mode: int = _OWNER_ONLY) -> Iterator[Path]:
    """A path beside `path` to write to, which takes its place when the block ends well; a link there is replaced, not
    followed. Without `replace` raises FileExistsError where something has the name by then. Raises OSError."""
    remove_unfinished(path.parent)
    unfinished, file = _begun(path.parent)
    try:
        yield unfinished
        if mode != _OWNER_ONLY:
            os.chmod(unfinished, mode)
        os.fsync(file)
        if os.name == "nt":  # which renames no open file
            os.close(file)
            file = -1
        _put(unfinished, path, replace)
        sync_folder(path.parent)
    finally:
        if file >= 0:
            os.close(file)
        with contextlib.suppress(OSError):
            unfinished.unlink(missing_ok=True)


def write_file(path: Path, content: str | bytes, *, replace: bool, mode: int = _OWNER_ONLY) -> None:
    """Write a whole file, as `new_file` does; text in UTF-8. Raises OSError."""
    with new_file(path, replace=replace, mode=mode) as unfinished:
        unfinished.write_bytes(content.encode() if isinstance(content, str) else content)


def rewrite_file(path: Path, content: str | bytes) -> None:
    """Replace what a file holds; its rights stay. For a file that several write, under the lock of its folder. Raises
    OSError."""
    mode = stat.S_IMODE(path.stat().st_mode) if path.exists() else _OWNER_ONLY
    write_file(path, content, replace=True, mode=mode)


def remove_unfinished(folder: Path) -> None:
    """Remove what killed processes were writing in a folder."""
    for path in folder.glob(UNFINISHED):
        with contextlib.suppress(OSError):  # its writer was done just now, or is another user
            if (file := held(path, 0)) is not None:
                os.close(file)
                path.unlink()


def sync_folder(folder: Path) -> None:
    """Force the names in a folder to the disk; where folders cannot be opened, the system sees to that."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _begun(folder: Path) -> tuple[Path, int]:
    while True:
        path = folder / UNFINISHED.replace("*", secrets.token_hex(8))
        if (file := held(path, os.O_CREAT | os.O_EXCL)) is not None:
            return path, file


def _put(unfinished: Path, path: Path, replace: bool) -> None:
    if not replace:
        try:
            os.link(unfinished, path)
            return
        except OSError as error:
            if error.errno not in _NO_LINKS:
                raise
        os.close(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, _OWNER_ONLY))  # a disk without hard links
    os.replace(unfinished, path)
