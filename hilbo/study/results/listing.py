"""The list that stands in every results folder, `.hilbo.json`: its files with their digests, and what made them.

By it `--force` replaces what hilbo wrote and nothing else, and a withdrawal knows what is to be made again.
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
    """What a list says; empty for a folder that hilbo did not write."""

    files: dict[str, str]
    """Name within the folder -> SHA-256."""
    command: str = ""
    where: str = ""
    """The folder in which the command was given."""


def listed(folder: Path) -> Listed:
    """The list of a folder; an empty one where there is none, or none that can be read."""
    try:
        entries = msgspec.json.decode((folder / LIST).read_bytes(), type=dict[str, str])
    except (OSError, *UNREADABLE):
        return Listed({})
    command, where = entries.pop(_COMMAND, ""), entries.pop(_WHERE, "")
    return Listed(entries, command, where)


def list_files(folder: Path, command: str = "", where: str = "") -> None:
    """Write the list of all files that are in a folder now."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name not in (LIST, LOCK))
    write_list(folder, Listed({path.relative_to(folder).as_posix(): digest(path) for path in files}, command, where))


def write_list(folder: Path, content: Listed) -> None:
    """Write a folder's list."""
    made = content.files | ({_COMMAND: content.command, _WHERE: content.where} if content.command else {})
    rewrite_file(folder / LIST, json.dumps(made, indent=0, ensure_ascii=False))


def digest(path: Path) -> str:
    """SHA-256 of a file; empty for what is none."""
    if not path.is_file():
        return ""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
