"""participants.csv: who takes part, by pseudonymous id, apart from all answers; and how somebody is deleted.

Columns: participant, consent_time (ISO 8601), protocol_number, optional age and handedness; others are kept. Consent
and the protocol's number must stand there before the first trial.
"""

import csv
import datetime
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path

from hilbo.errors import InputError
from hilbo.session.event_log import in_use, log_paths, read_log
from hilbo.study.text_cells import check_id

__all__ = ["COLUMNS", "add_person", "check_consent", "delete_participant", "read_people"]

COLUMNS = ("participant", "consent_time", "protocol_number", "age", "handedness")
_NEEDED = ("participant", "consent_time", "protocol_number")
_HANDS = ("", "right", "left", "both")
People = dict[str, dict[str, str]]


def read_people(path: str | os.PathLike) -> People:
    """participant -> row. Raises InputError with the line of what is wrong."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, strict=True)
            rows = [(reader.line_num, row) for row in reader]
            columns = list(reader.fieldnames or ())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path.") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: is no table that can be read ({error}); save it as CSV in UTF-8.") from error
    missing = [name for name in _NEEDED if name not in columns]
    if missing:
        raise InputError(
            f'{path}:1: column "{missing[0]}" is missing; a list of participants has {", ".join(_NEEDED)}.'
        )
    people: People = {}
    for line, row in rows:
        found = {key: (value or "").strip() for key, value in row.items() if key is not None}
        _check(found, f"{path}:{line}")
        if found["participant"] in people:
            raise InputError(f"{path}:{line}: participant {found['participant']} stands there twice; keep one row.")
        people[found["participant"]] = found
    return people


def add_person(path: str | os.PathLike, row: Mapping[str, str]) -> People:
    """Add a row, and write the table anew, whole or not at all; with its folder. Raises InputError."""
    people = read_people(path) if Path(path).exists() else {}
    found = {key: str(value).strip() for key, value in row.items()}
    _check(found, str(path))
    if found["participant"] in people:
        raise InputError(f"{path}: participant {found['participant']} stands there already; choose another id.")
    people[found["participant"]] = found
    try:
        _write(Path(path), people)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); choose another place.") from error
    return people


def check_consent(people: People, participant: str, protocol_number: str = "") -> dict[str, str]:
    """The participant's row. Raises InputError without consent, or under another protocol than the study's."""
    if participant not in people:
        raise InputError(
            f'participant "{participant}" is not in the list of participants; add them, with the time of their consent.'
        )
    row = people[participant]
    for column in ("consent_time", "protocol_number"):
        if not row[column]:
            raise InputError(f"participant {participant} has no {column}; no trial may begin before it stands there.")
    if protocol_number and row["protocol_number"] != protocol_number:
        raise InputError(
            f"participant {participant} agreed to protocol {row['protocol_number']}, the study's is {protocol_number};"
            " ask them again."
        )
    return row


def delete_participant(folder: str | os.PathLike, participant: str) -> dict[str, int]:
    """Remove one participant from everything below a folder: their logs, their keys, and their rows of every CSV and
    netCDF table (and in sets tables their own sets). File -> rows or files removed. Raises InputError if nothing is
    there, or one of their sessions is running.

    A plan made in advance keeps the id, and logs of others keep sets that were read from this person's map.
    """
    root = Path(folder)
    whose = {path: read_log(path)[0].participant for sub in _folders(root) for path in log_paths(sub)}
    logs = [path for path, person in whose.items() if person == participant]
    for path in logs:
        if in_use(path):
            raise InputError(f"{path}: is being written; end the session first.")
    changed: dict[str, int] = {}
    for path in [*logs, *_keys(root, participant, set(whose.values()))]:
        path.unlink()
        changed[str(path)] = 1
    for path in sorted(root.rglob("*.csv")):
        if count := _without(path, participant):
            changed[str(path)] = count
    for path in sorted(root.rglob("*.nc")):
        if count := _netcdf_without(path, participant):
            changed[str(path)] = count
    if not changed:
        raise InputError(f'{folder}: holds nothing of participant "{participant}"; check id and folder.')
    return changed


def _folders(root):
    return sorted({root, *(path.parent for path in root.rglob("*.session.jsonl"))})


def _keys(root, participant, people):
    """The files of keys of one participant's sessions, .ID-SESSION.keys; not those of somebody whose id begins so."""
    longer = tuple(f".{person}-" for person in people if person.startswith(f"{participant}-"))
    found = (path for end in ("*.keys", "*.keys.part") for path in root.rglob(end))
    return sorted(
        path for path in found if path.name.startswith(f".{participant}-") and not path.name.startswith(longer)
    )


def _check(row, place):
    check_id(row.get("participant", ""), place)
    if row.get("consent_time"):
        try:
            datetime.datetime.fromisoformat(row["consent_time"])
        except ValueError:
            raise InputError(
                f'{place}: consent_time is "{row["consent_time"]}"; write it as 2026-05-04T10:15.'
            ) from None
    if row.get("age") and not (row["age"].isdigit() and int(row["age"]) < 130):
        raise InputError(f'{place}: age is "{row["age"]}"; it must be a whole number of years, or empty.')
    if row.get("handedness", "") not in _HANDS:
        raise InputError(f'{place}: handedness is "{row["handedness"]}"; it must be right, left, both, or empty.')


def _write(path, people):
    columns = list(dict.fromkeys((*COLUMNS, *(key for row in people.values() for key in row))))
    rows = [[row.get(column, "") for column in columns] for row in people.values()]
    path.parent.mkdir(parents=True, exist_ok=True)
    _replace(path, [columns, *rows])


def _replace(path, rows):
    handle, made = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}-")
    try:
        with open(handle, "w", newline="", encoding="utf-8") as file:
            csv.writer(file, lineterminator="\n").writerows(rows)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(made, path.stat().st_mode if path.exists() else 0o644)
        os.replace(made, path)
    except BaseException:
        Path(made).unlink(missing_ok=True)
        raise


def _without(path, participant):
    """Rewrite a CSV table without one participant; how many rows went."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            rows = list(csv.reader(file))
    except (OSError, UnicodeDecodeError, csv.Error):
        return 0
    head = rows[0] if rows else []
    theirs = {"participant": participant, "source": f"individual:{participant}"}
    wanted = [(head.index(column), value) for column, value in theirs.items() if column in head]
    kept = [row for row in rows[1:] if not any(len(row) > i and row[i] == value for i, value in wanted)]
    removed = len(rows) - 1 - len(kept)
    if wanted and removed:
        _replace(path, [head, *kept])
        return removed
    return 0


def _netcdf_without(path, participant):
    """As `_without`, for a netCDF file with a dimension `participant`, or with a `participant` of every `obs_id`."""
    import xarray as xr

    try:
        with xr.open_datatree(path, engine="h5netcdf") as opened:
            groups = {node.path: node.to_dataset(inherit=False).load() for node in opened.subtree}
    except (OSError, ValueError):
        return 0
    keep = {}
    for group in groups.values():
        if "participant" in group and group["participant"].dims in (("participant",), ("obs_id",)):
            keep[group["participant"].dims[0]] = group["participant"].values != participant
    removed = max((int((~kept).sum()) for kept in keep.values()), default=0)
    if removed:
        here = {name: {dim: kept for dim, kept in keep.items() if dim in g.dims} for name, g in groups.items()}
        tree = xr.DataTree.from_dict({name: group.isel(here[name]).drop_encoding() for name, group in groups.items()})
        made = path.with_name(f".{path.name}-new")
        try:
            tree.to_netcdf(made, engine="h5netcdf")
            os.replace(made, path)
        finally:
            made.unlink(missing_ok=True)
    return removed
