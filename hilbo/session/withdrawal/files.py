"""All files below a folder that somebody's withdrawal looks into, and every place there that it cannot look into.

Links are followed within the folder and not out of it: what lies elsewhere may be another study's. A place that is not
looked into is never passed over in silence; each has its reason.
"""

import contextlib
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

__all__ = ["Below", "files_below", "is_closed", "refusals", "remove"]

_CLOSED = (".zip", ".gz", ".tgz", ".bz2", ".xz", ".7z", ".xlsx", ".xls", ".ods", ".docx", ".doc", ".odt", ".pdf")
# How files begin in which a text cannot be found: archives, office files (zip, OLE), compressed data of statistics.
_CLOSED_BEGINS = (
    *(b"PK\x03\x04", b"PK\x05\x06", b"PK\x07\x08", b"\x1f\x8b", b"\x1f\x9d", b"\xfd7zXZ\x00", b"7z\xbc\xaf\x27\x1c"),
    *(b"\x28\xb5\x2f\xfd", b"\x04\x22\x4d\x18", b"Rar!\x1a\x07", b"%PDF", b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1"),
    *(b"$FL3", b"MATLAB 5.0 MAT-file"),
)
_BZIP2 = (b"1AY&SY", b"\x17\x72\x45\x38\x50\x90")  # after "BZh" and a digit
_TABLE_BEGINS = (b"\x89HDF\r\n\x1a\n", b"PAR1", b"ARROW1")  # compressed as well, within
_TABLES = (".nc", ".parquet")  # these have been read by the time
_HISTORIES = (".git", ".hg", ".svn")


class Below(NamedTuple):
    """What lies below a folder."""

    files: list[Path]
    """Files, and links to files within the folder."""
    links: dict[Path, Path]
    """Those links -> the file itself."""
    left: dict[str, str]
    """What was not looked into -> why."""


def files_below(root: Path) -> Below:
    """Everything below a folder, the links within it among them."""
    inside, below = Path(os.path.realpath(root)), Below([], {}, {})

    def refused(error: OSError) -> None:
        below.left[str(error.filename)] = (
            f"cannot be opened ({error.strerror}); if it holds anything of theirs, delete it"
        )

    for place, folders, names in os.walk(root, onerror=refused):
        for name in [*folders, *names]:
            _sort_in(Path(place, name), inside, below)
        for name in set(folders) & set(_HISTORIES):
            folders.remove(name)
            below.left[str(Path(place, name))] = "keeps all versions of the files, theirs among them if they were in it"
    below.files.sort()
    return below


def _sort_in(path: Path, inside: Path, below: Below) -> None:
    """Put one entry of a folder where it belongs; folders themselves, pipes and sockets hold no text."""
    linked = os.path.islink(path)
    try:
        mode = path.stat().st_mode
    except OSError as error:
        why = "is a link to what cannot be opened" if linked else "cannot be opened"
        below.left[str(path)] = f"{why} ({error.strerror}); if it leads to anything of theirs, delete that"
        return
    place = Path(os.path.realpath(path)) if linked else path
    if linked and not place.is_relative_to(inside):
        what = "withdraw them there too" if stat.S_ISDIR(mode) else "if that holds anything of theirs, delete it"
        below.left[str(path)] = f"is a link to {place}, out of this folder, where nothing was looked for; {what}"
    elif stat.S_ISREG(mode):
        below.files.append(path)
        if linked:
            below.links[path] = place


@contextlib.contextmanager
def refusals(path: Path, left: dict[str, str]) -> Iterator[None]:
    """What the system refuses about one file is listed, and the rest of a withdrawal goes on."""
    try:
        yield
    except OSError as error:
        left[str(path)] = f"could not be changed ({error.strerror or error}); if it holds anything of theirs, delete it"


def remove(path: Path) -> None:
    """Remove a file; where it is a link, the file itself first, so that what cannot be removed is still found."""
    path.resolve().unlink(missing_ok=True)
    path.unlink(missing_ok=True)


def is_closed(path: Path) -> bool:
    """Whether a file is packed or compressed, so that no id is found in it: by how it begins, or by its name. Raises
    OSError."""
    with path.open("rb") as file:
        begin = file.read(20)
    bzip2 = begin.startswith(b"BZh") and begin[4:10] in _BZIP2
    table = begin.startswith(_TABLE_BEGINS) and path.suffix not in _TABLES
    return bzip2 or table or begin.startswith(_CLOSED_BEGINS) or path.suffix.lower() in _CLOSED
