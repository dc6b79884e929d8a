"""Whether the content of a cache may be executed: only files that no other user can have written."""

import contextlib
import os
import stat
from pathlib import Path

__all__ = ["is_private", "private_folder"]


def is_private(path: Path) -> bool:
    """Whether a path belongs to this user, is no symbolic link, and is not writable for group or others.

    On Windows only symbolic links are refused. Raises `OSError` if there is nothing at this path.
    """
    status = path.lstat()
    if os.name == "nt":
        return not stat.S_ISLNK(status.st_mode)
    return status.st_uid == os.geteuid() and not status.st_mode & 0o022 and not stat.S_ISLNK(status.st_mode)


def private_folder(folder: Path) -> bool:
    """Create a folder for this user alone if there is none; return whether only this user can have written to it.

    False if the folder or an entry directly in it belongs to another user, or if others may write to the folder. An
    entry's mode is not checked, only its owner: what another user left there stays theirs. True if the folder cannot be
    created.
    """
    with contextlib.suppress(OSError):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not os.path.lexists(folder):  # on a disk that cannot be written: nothing is there
        return True
    if not is_private(folder):
        return False
    with os.scandir(folder) as entries:
        return os.name == "nt" or all(entry.stat(follow_symlinks=False).st_uid == os.geteuid() for entry in entries)
