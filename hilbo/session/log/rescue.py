"""Detection of a log that was deleted, moved, replaced or edited while it is open, and the copy of what it held.

An open descriptor survives whatever happens to the path: events would be acknowledged into a file that cannot be found
again. The path is therefore compared with the descriptor around each write. The copy is meant for a person to inspect:
its name is not that of a log, so that no command reads it as one.
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
    """How the file at `path` differs from the open `file` of `size` bytes, as the predicate of a sentence.

    "" if it does not."""
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
    """Write the lines of a log to a new file of mode 0600 beside it, and return its path. Raises OSError."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    copy = path.with_name(f"{path.name.split('.session')[0]}.{secrets.token_hex(4)}{RESCUED}")
    write_file(copy, b"".join(lines), replace=False)
    return copy
