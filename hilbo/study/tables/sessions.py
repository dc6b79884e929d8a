"""The table of sessions in an export: who had which session, by which plan, with which study file."""

import math
from pathlib import Path
from typing import NamedTuple

from hilbo.errors import InputError
from hilbo.study.formats.csv_file import read_cells

__all__ = ["SessionRow", "read_session_table"]


class SessionRow(NamedTuple):
    """A session of an export."""

    participant: str
    session: str
    phases: str
    """Phases of its blocks, separated by ", "."""
    plan: str
    """Hash of the plan; empty if the session had none."""
    began_at: float | None
    """Time of the first event, in s since the epoch; None without an event."""
    ended_at: float | None
    """Time of the last event, likewise."""
    study: str
    """Hash of the study file that it was begun with."""
    differs_in: str
    """Keys in which that file differs from the one of the export, as text; empty if it is the same."""


def read_session_table(folder: Path) -> list[SessionRow] | None:
    """Read the sessions of an export, from the table in its data/; None if there is no such table. Raises
    InputError."""
    paths = sorted((folder / "data").glob("*_table-sessions_data.csv"))
    sessions = []
    for path in paths:
        cells = read_cells(path, "a table of sessions needs a header and a session")
        missing = [name for name in SessionRow._fields if name not in cells]
        if missing:
            raise InputError(f'{path}:1: column "{missing[0]}" is missing; export the logs again.')
        for line, row in zip(cells.index, cells.to_dict("records"), strict=True):
            began, ended = (_time(row[name], name, f"{path}:{line}") for name in ("began_at", "ended_at"))
            who = (row["participant"], row["session"], row["phases"], row["plan"])
            sessions.append(SessionRow(*who, began, ended, row["study"], row["differs_in"]))
    return sessions if paths else None


def _time(text: str, name: str, place: str) -> float | None:
    """A time in s from the text of a cell of the column `name`; None if it is empty. Raises InputError."""
    if not text:
        return None
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not math.isfinite(seconds):
        raise InputError(f'{place}: {name} is "{text}"; it must be a number of seconds: export the logs again.')
    return seconds
