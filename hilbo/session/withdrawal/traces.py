"""Search of the files below a folder for a participant's id, also as a spreadsheet or a person may have changed it.

Links are followed within the folder but not out of it, since what they lead to may belong to another study. Every place
that is not searched is reported with its reason. An id that is a number counts only where ids are expected: in columns
and fields of ids, after a word such as participant, in names of sets.
"""

import csv
import functools
import io
import json
import os
import re
import stat
import unicodedata
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from hilbo.study.disk.lock import JOURNAL, LOCK
from hilbo.study.formats.cell_text import id_form
from hilbo.study.formats.parsing import UNREADABLE
from hilbo.study.tables.parameter_sets import ROLES

__all__ = ["Below", "called_after", "files_below", "is_closed", "read_text", "same_id", "spelled"]

_CLOSED = (
    *(".zip", ".gz", ".tgz", ".bz2", ".xz", ".7z", ".xlsx", ".xls", ".ods", ".docx", ".doc", ".odt", ".pdf"),
    *(".nc", ".h5", ".hdf5", ".parquet"),
)
# How files begin in which a text cannot be found: archives, office files (zip, OLE), compressed data of statistics.
_CLOSED_BEGINS = (
    *(b"PK\x03\x04", b"PK\x05\x06", b"PK\x07\x08", b"\x1f\x8b", b"\x1f\x9d", b"\xfd7zXZ\x00", b"7z\xbc\xaf\x27\x1c"),
    *(b"\x28\xb5\x2f\xfd", b"\x04\x22\x4d\x18", b"Rar!\x1a\x07", b"%PDF", b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1"),
    *(b"$FL3", b"MATLAB 5.0 MAT-file", b"\x89HDF\r\n\x1a\n", b"PAR1", b"ARROW1"),
)
_BZIP2 = (b"1AY&SY", b"\x17\x72\x45\x38\x50\x90")  # after "BZh" and a digit
_HISTORIES = (".git", ".hg", ".svn")
_PERSON = r"(participant|subject|person|proband|vp)s?"
_ID_COLUMN = re.compile(rf"{_PERSON}(_?(id|nr|no|code))?|id|reissued_from", re.IGNORECASE)
_BYTE_ORDER = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}
_PICTURE = re.compile(r"base64,[A-Za-z0-9+/=\s]+")


class Below(NamedTuple):
    """Result of `files_below`."""

    files: list[Path]
    """Files, and links to files within the folder."""
    links: dict[Path, Path]
    """Those links -> the file itself."""
    left: dict[str, str]
    """Unsearched path -> reason."""


def files_below(root: Path) -> Below:
    """List all files below a folder, including links within it, except locks and a withdrawal's journal.

    Folders of version control, links out of the folder and places that cannot be opened are not searched, but reported.
    """
    inside, below = Path(os.path.realpath(root)), Below([], {}, {})

    def refused(error: OSError) -> None:
        """Report a folder that cannot be opened."""
        below.left[str(error.filename)] = f"cannot be opened ({error.strerror}); if it contains their data, delete it"

    for place, folders, names in os.walk(root, onerror=refused):
        for name in {*folders, *names} - {LOCK, JOURNAL}:
            _sort_in(Path(place, name), inside, below)
        for name in set(folders) & set(_HISTORIES):
            folders.remove(name)
            below.left[str(Path(place, name))] = "keeps all versions of the files, theirs among them if they were in it"
    below.files.sort()
    return below


def _sort_in(path: Path, inside: Path, below: Below) -> None:
    """Add one entry of a folder to `below`: as a file, a link, or a place that is not searched. `inside`: the real path
    of the folder. Folders, pipes and sockets are skipped."""
    linked = os.path.islink(path)
    try:
        mode = path.stat().st_mode
    except OSError as error:
        why = "is a link to what cannot be opened" if linked else "cannot be opened"
        below.left[str(path)] = f"{why} ({error.strerror}); if it leads to their data, delete that"
        return
    place = Path(os.path.realpath(path)) if linked else path
    if linked and not place.is_relative_to(inside):
        what = "withdraw them there too" if stat.S_ISDIR(mode) else "if that contains their data, delete it"
        below.left[str(path)] = f"is a link to {place}, out of this folder, where nothing was looked for; {what}"
    elif stat.S_ISREG(mode):
        below.files.append(path)
        if linked:
            below.links[path] = place


def same_id(text: str, participant: str) -> bool:
    """Whether two ids are equal apart from leading zeros, ".0", blanks, capitals and Unicode form, which spreadsheets
    and people change."""
    return id_form(text) == id_form(participant)


def _id_pattern(participant: str, exact: bool) -> str:
    """Regular expression of an id: of exactly this text, or of all spellings that `same_id` accepts."""
    if exact:
        return re.escape(participant)
    pieces = re.findall(r"\.\d+|\d+|.", id_form(participant))
    ways = [rf"0*{piece}(?:\.0+(?!\d))?" if piece[0].isdigit() else re.escape(piece) for piece in pieces]
    return "(?i:" + r"\s?".join(ways) + ")"


def called_after(path: Path, participant: str) -> bool:
    """Whether a file's name contains exactly this id, delimited by other characters than letters and digits."""
    return re.search(rf"(?<![A-Za-z0-9]){re.escape(participant)}(?![A-Za-z0-9])", path.stem) is not None


def read_text(path: Path) -> str:
    """Read a file as UTF-8, or UTF-16 with a byte order mark; bytes that cannot be decoded are replaced. Raises
    OSError."""
    content = path.read_bytes()
    return content.decode(_BYTE_ORDER.get(content[:2], "utf-8"), "replace")


def spelled(text: str, suffix: str, participant: str, exact: bool = False) -> str:
    """The first occurrence of a participant's id in a file's text, as it is spelled there (perhaps with the words
    around it); "" if there is none. `suffix`: the file's, which decides where a numeric id is looked for. `exact`: only
    this spelling."""
    text, way = _PICTURE.sub("", text), _id_pattern(participant, exact)
    text = text if exact else unicodedata.normalize("NFKC", text)
    match = re.search(rf"(?:(?<![\w.-])|(?<=\bown-)){way}(?![\w-]|\.\w)", text)
    if match is None:
        return ""
    if not id_form(participant).replace(".", "").isdigit():
        return match[0]
    names_set = rf"(?:individual:|\bown-){way}(?![\w.-])|(?<![\w.-]){way} (?:{'|'.join(ROLES)})\b"
    if match := re.search(names_set, text):
        return match[0]
    is_id = participant.__eq__ if exact else functools.partial(same_id, participant)
    if suffix in (".json", ".jsonl"):
        lines = text.splitlines() if suffix == ".jsonl" else [text]
        return next(filter(None, (_in_fields(line, is_id, participant) for line in lines)), "")
    if suffix in (".csv", ".tsv"):
        return next(filter(None, (_in_columns(text, is_id, mark) for mark in ",;\t")), "")
    match = re.search(rf"(?i:\b{_PERSON})\W{{0,4}}{way}(?![\w.-])", text)
    return match[0] if match else ""


def _in_columns(text: str, is_id: Callable[[str], bool], delimiter: str) -> str:
    """First cell in a column of ids that is this id, in a CSV text with this delimiter; "" if there is none, or it is
    no CSV."""
    try:
        reader = csv.reader(io.StringIO(text.lstrip("\ufeff")), delimiter=delimiter, skipinitialspace=True)
        rows = [row for row in reader if any(row)]
    except csv.Error:
        return ""
    columns = [i for i, name in enumerate(rows[0] if rows else []) if _ID_COLUMN.fullmatch(name.strip())]
    cells = (row[i].strip() for row in rows[1:] for i in columns if i < len(row))
    return next((cell for cell in cells if is_id(cell)), "")


def _in_fields(text: str, is_id: Callable[[str], bool], participant: str) -> str:
    """First value (or key) in a field of ids of a JSON text that is this id; "" if there is none. If the text is no
    JSON, the id itself is returned, since it cannot be excluded."""

    def named(value: Any, field: re.Match[str] | None) -> Iterator[str]:
        """Yield the ids within `value` that match; `field` is the match of the name of its field, None for other
        fields."""
        if isinstance(value, dict):
            for key, part in value.items():
                yield from [key] if field and is_id(key) else []
                yield from named(part, _ID_COLUMN.fullmatch(key))
        elif isinstance(value, list):
            for part in value:
                yield from named(part, field)
        elif field and (isinstance(value, str) or field[1]) and is_id(str(value)):  # an id: 1 is of anything
            yield str(value)

    try:
        return next(named(json.loads(text), None), "")
    except UNREADABLE:
        return participant


def is_closed(path: Path) -> bool:
    """Whether a file is packed or compressed, so that no id can be found in it, by its first bytes or its name. Raises
    OSError."""
    with path.open("rb") as file:
        begin = file.read(20)
    bzip2 = begin.startswith(b"BZh") and begin[4:10] in _BZIP2
    return bzip2 or begin.startswith(_CLOSED_BEGINS) or path.suffix.lower() in _CLOSED
