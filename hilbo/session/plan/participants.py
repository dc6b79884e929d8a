"""participants.csv: the participants by pseudonymous id, kept separately from all answers.

Columns: participant, consent_time (ISO 8601), protocol_number, optional age and handedness; others are kept. Consent
and protocol number must be entered before the first trial.
"""

import datetime
import os
from collections.abc import Mapping
from pathlib import Path

from hilbo.errors import InputError
from hilbo.study.disk.lock import locked_folder
from hilbo.study.disk.new_file import rewrite_file
from hilbo.study.formats.cell_text import but_for_case, check_id, check_text
from hilbo.study.formats.csv_rows import csv_text, open_csv

__all__ = ["COLUMNS", "add_person", "check_consent", "read_people"]

COLUMNS = ("participant", "consent_time", "protocol_number", "age", "handedness")
_NEEDED = ("participant", "consent_time", "protocol_number")
_HANDS = ("", "right", "left", "both")
People = dict[str, dict[str, str]]


def read_people(path: str | os.PathLike) -> People:
    """Read the list: participant -> row (column -> text). Raises InputError, with the line of the error."""
    return _read(path)[0]


def _read(path: str | os.PathLike) -> tuple[People, str]:
    """Read and check the list; return its rows by participant, and its delimiter. Raises InputError."""
    needs = f"a list of participants has {', '.join(_NEEDED)}"
    people: People = {}
    with open_csv(path, needs, fill=True) as table:
        missing = [name for name in _NEEDED if name not in table.header]
        if missing:
            raise InputError(f'{path}:1: column "{missing[0]}" is missing; {needs}.')
        for line, row in table.rows:
            person = {key: value.strip() for key, value in zip(table.header, row, strict=True)}
            _check(person, f"{path}:{line}")
            if person["participant"] in people:
                raise InputError(f"{path}:{line}: participant {person['participant']} is there twice; remove one row.")
            people[person["participant"]] = person
    return people, table.delimiter


def add_person(path: str | os.PathLike, row: Mapping[str, str]) -> People:
    """Add a row, and rewrite the list atomically, under the lock of its folder; return all rows by participant.

    List and folder are created if they do not exist; a link is followed. Raises InputError for a row that is not valid,
    an id that is taken (also with other capitals), and a file that cannot be written.
    """
    person = {key: str(value).strip() for key, value in row.items()}
    _check(person, str(path))
    _check_past(person, str(path))
    place = _place(Path(path))
    try:
        place.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with locked_folder(place.parent):
            people, delimiter = _read(path) if place.exists() else ({}, ",")
            if person["participant"] in people:
                raise InputError(f"{path}: participant {person['participant']} is there already; choose another id.")
            if alike := but_for_case([*people, person["participant"]]):
                raise InputError(f"{path}: {alike} differ in capitals only; choose another id.")
            people[person["participant"]] = person
            _write(place, people, delimiter)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); choose another place.") from error
    return people


def _place(path: Path) -> Path:
    """Path of the list behind a link. Raises InputError for a link to a file that does not exist: a missing drive would
    otherwise get a new list."""
    place = Path(os.path.realpath(path))
    if path.is_symlink() and not place.exists():
        raise InputError(f"{path}: is a link to {place}, where no list is; connect its drive, or remove the link.")
    return place


def check_consent(people: People, participant: str, protocol_number: str = "") -> dict[str, str]:
    """Return the participant's row. Raises InputError if they are not in the list, consent time or protocol number
    is missing, the consent is in the future, or the protocol is another one than `protocol_number` ("" is not
    compared)."""
    if participant not in people:
        raise InputError(
            f'participant "{participant}" is not in the list of participants; add them, with the time of their consent.'
        )
    row = people[participant]
    for column in ("consent_time", "protocol_number"):
        if not row[column]:
            raise InputError(f"participant {participant} has no {column}; no trial may begin without it.")
    _check_past(row, f"participant {participant}")
    if protocol_number and row["protocol_number"] != protocol_number:
        raise InputError(
            f"participant {participant} agreed to protocol {row['protocol_number']}, the study's is {protocol_number};"
            " ask them again."
        )
    return row


def _check(row: Mapping[str, str], place: str) -> None:
    """Raise InputError for a row with an id that is not pseudonymous, text that a spreadsheet would run as a formula,
    or a consent_time, age or handedness that is not valid. `place` is for messages."""
    check_id(row.get("participant", ""), place)
    for name, text in row.items():
        check_text(name, "the name of a column", place)
        check_text(text, name, place)
    if row.get("consent_time"):
        try:
            datetime.datetime.fromisoformat(row["consent_time"])
        except ValueError:
            raise InputError(
                f'{place}: consent_time is "{row["consent_time"]}"; write it as 2026-05-04T10:15.'
            ) from None
    if row.get("age") and not (row["age"].isdecimal() and len(row["age"]) <= 3 and int(row["age"]) < 130):
        raise InputError(f'{place}: age is "{row["age"]}"; it must be a whole number of years, or empty.')
    if row.get("handedness", "") not in _HANDS:
        raise InputError(f'{place}: handedness is "{row["handedness"]}"; it must be right, left, both, or empty.')


def _check_past(row: Mapping[str, str], place: str) -> None:
    """Raise InputError for a consent_time more than a day in the future: one without a zone may be of another time
    zone."""
    if not row.get("consent_time"):
        return
    consent = datetime.datetime.fromisoformat(row["consent_time"])
    if consent > datetime.datetime.now(consent.tzinfo) + datetime.timedelta(days=1):
        raise InputError(f"{place}: consent_time is {row['consent_time']}, in the future; write the time of consent.")


def _write(path: Path, people: People, delimiter: str) -> None:
    """Rewrite the list, with the standard columns first."""
    columns = list(dict.fromkeys((*COLUMNS, *(key for row in people.values() for key in row))))
    rows = [[row.get(column, "") for column in columns] for row in people.values()]
    rewrite_file(path, csv_text([columns, *rows], delimiter))
