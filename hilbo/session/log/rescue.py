"""Detection of a log that was deleted, moved, replaced or edited while it is open, and a copy of its content.

An open descriptor survives whatever happens to the path: events would be acknowledged into a file that cannot be found
again. The path is therefore compared with the descriptor around each write. The copy is meant for a person to inspect;
it has no log's name, so that no command reads it as a log.
"""

import os
import secrets
from collections.abc import Sequence
from pathlib import Path

from hilbo.study.disk.new_file import write_file

__all__ = ["RESCUED", "fault_of", "rescue"]

RESCUED = ".rescued.jsonl"
"""Suffix of copies."""


def fault_of(path: Path, file: int, size: int) -> str:
    """Compare the file at `path` with the open file descriptor `file`, expected to have `size` bytes.

    Returns the difference (gone, replaced or changed) as the predicate of a sentence, or "" if there is none.
    """
    try:
        at_path = os.stat(path, follow_symlinks=False)
    except OSError as error:
        return f"is gone ({error.strerror}): it was deleted, moved or renamed"
    if not os.path.samestat(at_path, os.fstat(file)):
        return "was replaced by another file"
    if at_path.st_size != size:
        return f"was changed by another program ({at_path.st_size} bytes in place of {size})"
    return ""


def rescue(path: Path, lines: Sequence[bytes]) -> Path:
    """Write the lines of a log to a new file of mode 0600 next to `path`, and return the new file's path. Raises
    OSError."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    copy = path.with_name(f"{path.name.split('.session')[0]}.{secrets.token_hex(4)}{RESCUED}")
    write_file(copy, b"".join(lines), replace=False)
    return copy
