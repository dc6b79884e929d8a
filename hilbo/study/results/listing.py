"""The list in every results folder, `.hilbo.json`: its files with their digests, and the command that made them.

From it `--force` knows which files hilbo wrote and may replace, and a withdrawal which results must be made again.
"""

import hashlib
import json
from pathlib import Path
from typing import NamedTuple

import msgspec

from hilbo.study.disk.lock import LOCK
from hilbo.study.disk.new_file import rewrite_file
from hilbo.study.formats.parsing import UNREADABLE

__all__ = ["LIST", "Listed", "digest", "list_files", "listed", "write_list"]

LIST = ".hilbo.json"
_COMMAND, _WHERE = "//command", "//folder"  # no file has such a name


class Listed(NamedTuple):
    """Content of a list; empty for a folder that hilbo did not write."""

    files: dict[str, str]
    """Name within the folder -> SHA-256."""
    command: str = ""
    where: str = ""
    """Working directory of the command."""


def listed(folder: Path) -> Listed:
    """Read the list of a folder; an empty `Listed` if it is missing or unreadable."""
    try:
        entries = msgspec.json.decode((folder / LIST).read_bytes(), type=dict[str, str])
    except (OSError, *UNREADABLE):
        return Listed({})
    command, where = entries.pop(_COMMAND, ""), entries.pop(_WHERE, "")
    return Listed(entries, command, where)


def list_files(folder: Path, command: str = "", where: str = "") -> None:
    """Write the list of all files that are now in a folder and below, with their digests, without the list itself and
    the lock file; an existing list is replaced."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name not in (LIST, LOCK))
    write_list(folder, Listed({path.relative_to(folder).as_posix(): digest(path) for path in files}, command, where))


def write_list(folder: Path, content: Listed) -> None:
    """Write `content` as the folder's list; an existing list is replaced. `where` is saved only together with a
    command."""
    made = content.files | ({_COMMAND: content.command, _WHERE: content.where} if content.command else {})
    rewrite_file(folder / LIST, json.dumps(made, indent=0, ensure_ascii=False))


def digest(path: Path) -> str:
    """SHA-256 (hex) of a file's content; "" if there is no such file."""
    if not path.is_file():
        return ""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
