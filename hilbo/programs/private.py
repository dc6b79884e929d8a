"""Whether what is in a cache may be executed: only what no other user can have written."""

import os
import stat
from pathlib import Path

__all__ = ["is_private"]


def is_private(path: Path) -> bool:
    """Whether a path belongs to this user and nobody else may write to it.

    On Windows only symbolic links are refused. Raises `OSError` if there is nothing at this path.
    """
    status = path.lstat()
    if os.name == "nt":
        return not stat.S_ISLNK(status.st_mode)
    return status.st_uid == os.geteuid() and not status.st_mode & 0o022 and not stat.S_ISLNK(status.st_mode)
