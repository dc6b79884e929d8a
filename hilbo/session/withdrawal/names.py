"""How files of a study name a participant: in texts, in file names, and in the names of sets from their own map.

Names of sets have one of three forms, with a material before it or not: `individual:ID`, `ID ROLE`, and `own-ID` of
simulated studies of earlier versions. Nothing else in a plan or a table is taken for a name: an id such as 1 or a is
also a session's label, a number, or a side.
"""

import csv
import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from hilbo.session.plan.set_codes import OWN
from hilbo.study.tables.parameter_sets import ROLES

__all__ = ["CODED_JUDGED", "CODED_OWN", "file_is_called_after", "file_names", "names_person", "renamed_set", "replaced"]

CODED_OWN = re.compile(rf"(?:.+ )?s[0-9a-f]{{8}}(?:-\d+)? (?:{'|'.join(ROLES)})")
"""A set of somebody's own map under a code, as nobody else compares it."""
CODED_JUDGED = re.compile(OWN + r"s[0-9a-f]{8}")
"""In the name of a set of somebody's own map under a code, as others compare it."""


def names_person(text: str, participant: str) -> bool:
    """Whether a text holds this id, not as a part of another one."""
    return _pattern(participant).search(text) is not None


def replaced(text: str, participant: str, label: str) -> str:
    """A text with a label in the place of the id."""
    return _pattern(participant).sub(label, text)


def _pattern(participant: str) -> re.Pattern[str]:
    before = r"(?:(?<![A-Za-z0-9_.-])|(?<=\bown-))"
    return re.compile(rf"{before}{re.escape(participant)}(?![A-Za-z0-9_-]|\.[A-Za-z0-9])")


def renamed_set(name: str, participant: str, label: str, materials: Iterable[str | None] = ()) -> str:
    """The name of a set with a label in the place of the id; as it is, where it is not named after the participant."""
    stated = [material for material in materials if material]
    for prefix in ("", *(f"{material} " for material in stated)):
        rest = name[len(prefix) :] if name.startswith(prefix) else ""
        if rest in (OWN + participant, f"own-{participant}"):
            return prefix + rest.removesuffix(participant) + label
        if participant not in stated and rest in [f"{participant} {role}" for role in ROLES]:
            return prefix + label + rest.removeprefix(participant)
    return name


_ID_COLUMNS = re.compile(
    r"(participant|subject|person|proband|vp)s?(_?(id|nr|no|code))?|id|reissued_from", re.IGNORECASE
)
_BYTE_ORDER = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}


def read_text(path: Path) -> str:
    """A file's text, whatever can be read of it. Raises OSError."""
    content = path.read_bytes()
    return content.decode(_BYTE_ORDER.get(content[:2], "utf-8"), "replace")


def file_is_called_after(path: Path, participant: str) -> bool:
    """Whether a file's name has this id as one of its parts."""
    return re.search(rf"(?<![A-Za-z0-9]){re.escape(participant)}(?![A-Za-z0-9])", path.stem) is not None


def file_names(path: Path, participant: str) -> bool:
    """Whether a file's content names somebody; also if it cannot be read."""
    try:
        text = read_text(path)
    except OSError:
        return True
    number = participant.replace(".", "").isdigit()
    return names_person(text, participant) and (not number or _names_number(text, path.suffix, participant))


def _names_number(text: str, suffix: str, participant: str) -> bool:
    """Whether a number is an id in a text: in columns and fields of ids, after such a word, in names of sets."""
    person = re.escape(participant)
    if suffix in (".nc", ".parquet"):  # what can be read of these has been edited
        return False
    if re.search(rf"(individual:|\bown-){person}(?![\w.-])|(?<![\w.-]){person} ({'|'.join(ROLES)})\b", text):
        return True
    if suffix in (".json", ".jsonl"):
        return any(_field_names(part, participant) for part in (text.splitlines() if suffix == ".jsonl" else [text]))
    if suffix in (".csv", ".tsv"):
        return any(_column_names(text, participant, mark) for mark in ",;\t")
    words = rf"\b(participants?|subject|person|proband|vp)\W{{0,4}}{person}(?![\w.-])"
    return re.search(words, text, re.IGNORECASE) is not None


def _column_names(text: str, participant: str, delimiter: str) -> bool:
    """Whether a whole cell of a column of ids is this id."""
    try:
        head, *rows = csv.reader(text.lstrip("\ufeff").splitlines(), delimiter=delimiter, skipinitialspace=True)
    except (ValueError, csv.Error):
        return False
    columns = [i for i, name in enumerate(head) if _ID_COLUMNS.fullmatch(name.strip())]
    return any(row[i].strip() == participant for row in rows for i in columns if i < len(row))


def _field_names(text: str, participant: str) -> bool:
    """Whether a field of ids of a JSON text holds this id, or one of a list of ids does."""

    def named(value: Any, ids: bool) -> bool:
        if isinstance(value, dict):
            here = ids and participant in value
            return here or any(named(v, _ID_COLUMNS.fullmatch(k) is not None) for k, v in value.items())
        if isinstance(value, list):
            return any(named(v, ids) for v in value)
        return ids and value == participant

    try:
        return named(json.loads(text), False)
    except (ValueError, RecursionError):
        return True
