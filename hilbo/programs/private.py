"""Whether what is in a cache may be executed: only what no other user can have written."""

import contextlib
import os
import stat
from pathlib import Path

__all__ = ["is_private", "private_folder"]


def is_private(path: Path) -> bool:
    """Whether a path belongs to this user and nobody else may write to it.

    On Windows only symbolic links are refused. Raises `OSError` if there is nothing at this path.
    """
    status = path.lstat()
    if os.name == "nt":
        return not stat.S_ISLNK(status.st_mode)
    return status.st_uid == os.geteuid() and not status.st_mode & 0o022 and not stat.S_ISLNK(status.st_mode)


def private_folder(folder: Path) -> bool:
    """Whether a folder and its entries belong to this user, and nobody else may write to it.

    It is created so if there is none. Entries are checked by their owner: one that another user has left there while
    they could stays, whatever mode the folder has got since.
    """
    with contextlib.suppress(OSError):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not os.path.lexists(folder):  # on a disk that cannot be written: nothing is there
        return True
    if not is_private(folder):
        return False
    with os.scandir(folder) as entries:
        return os.name == "nt" or all(entry.stat(follow_symlinks=False).st_uid == os.geteuid() for entry in entries)
