"""Atomic writing of a file: a temporary file in the same folder is written, synced to disk, and renamed.

The temporary file has a random name (`.hilbo-….part`), is readable by its owner only, and is locked while it is
written, so that leftovers of killed processes can be recognised and removed.
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
    """Context manager that gives the path of a temporary file; on success it is synced and becomes `path`, on an
    exception it is deleted and `path` is unchanged.

    `replace`: overwrite an existing file; a symbolic link is replaced, not followed. Otherwise raises FileExistsError,
    at the end, if `path` exists by then. `mode`: permissions of the file. Also removes leftovers of killed processes
    from the folder. Raises OSError.
    """
    remove_unfinished(path.parent)
    unfinished, file = _create_unfinished(path.parent)
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
    """Write a whole file atomically (text in UTF-8): after an error `path` is unchanged. `mode`: its permissions.
    Raises OSError, and FileExistsError if `path` exists, unless `replace`."""
    with new_file(path, replace=replace, mode=mode) as unfinished:
        unfinished.write_bytes(content.encode() if isinstance(content, str) else content)


def rewrite_file(path: Path, content: str | bytes) -> None:
    """Replace a file's content atomically and keep its permissions; a missing file is created for its owner only. The
    caller holds the lock of the folder. Raises OSError."""
    mode = stat.S_IMODE(path.stat().st_mode) if path.exists() else _OWNER_ONLY
    write_file(path, content, replace=True, mode=mode)


def remove_unfinished(folder: Path) -> None:
    """Delete the temporary files of `new_file` in a folder that no process has locked. Files that cannot be opened or
    deleted stay, without an error."""
    for path in folder.glob(UNFINISHED):
        with contextlib.suppress(OSError):  # its writer was done just now, or is another user
            if (file := held(path, 0)) is None:
                continue
            try:
                if os.name != "nt":  # deleted while locked: its writer may have just created it, and would lose it
                    path.unlink()
            finally:
                os.close(file)
            if os.name == "nt":  # which deletes no open file, and so none that a writer has just created
                path.unlink()


def sync_folder(folder: Path) -> None:
    """Sync a folder's entries to disk (fsync); does nothing where the system cannot open folders. Raises OSError if the
    sync fails."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _create_unfinished(folder: Path) -> tuple[Path, int]:
    """Create and lock a temporary file with a new random name; returns its path and descriptor."""
    while True:
        path = folder / UNFINISHED.replace("*", secrets.token_hex(8))
        if (file := held(path, os.O_CREAT | os.O_EXCL)) is not None:
            return path, file


def _put(unfinished: Path, path: Path, replace: bool) -> None:
    """Move the finished temporary file to `path`. Without `replace` raises FileExistsError if `path` exists, also on
    disks without hard links."""
    if not replace:
        try:
            os.link(unfinished, path)
            return
        except OSError as error:
            if error.errno not in _NO_LINKS:
                raise
        os.close(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, _OWNER_ONLY))  # a disk without hard links
    os.replace(unfinished, path)
