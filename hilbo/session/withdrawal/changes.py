"""Tables, plans and commands without a participant: the functions compute new content and change no file.

A set from a participant's own map may have been compared by others. If their answers name it, it stays, and its name
and source have the pseudonym in place of the id; otherwise it is deleted. So are sets of the participant's own map
under a code that only their own answers name. Names of sets have one of three forms, with or without a material before
it: `individual:ID`, `ID ROLE`, and `own-ID` of simulated studies of earlier versions. Nothing else in a plan or a table
counts as a name: an id such as 1 or a may also be a session's label, a number, or a side.
"""

import contextlib
import io
import itertools
import re
import shlex
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from msgspec.structs import replace

from hilbo.errors import InputError
from hilbo.session.plan.set_codes import OWN
from hilbo.study.file.plan_file import Planned, PlanRow, hashed, plan_in, plan_text
from hilbo.study.formats.csv_rows import csv_rows, csv_text
from hilbo.study.tables.parameter_sets import ROLES

__all__ = [
    "CODED_JUDGED",
    "Cells",
    "Edited",
    "command_without",
    "named_sets",
    "plan_without",
    "read_table",
    "sets_of",
    "table_content",
    "without_person",
]

CODED_JUDGED = re.compile(OWN + r"s[0-9a-f]{8}")
"""In the name of a set of an individual map under a code, as others compare it."""
_CODED_OWN = re.compile(
    rf"(?:.+ )?s[0-9a-f]{{8}}(?:-\d+)? (?:{'|'.join(ROLES)})"
)  # as no other participant compares it
_SET_COLUMNS = ("set_a", "set_b", "first", "preferred", "set_id", "source")
_NAME_COLUMNS = ("set_a", "set_b", "set_id")
_COUNT_PEOPLE = ("plan", "simulate", "power")  # commands whose --participants is a number


class Cells(NamedTuple):
    """A table as text: the header, and the rows."""

    head: list[str]
    rows: list[list[str]]
    delimiter: str = ","

    def named(self) -> Iterator[dict[str, str]]:
        """Yield each row as column -> cell, without blanks around them; surplus cells are left out."""
        head = [name.strip() for name in self.head]
        return (dict(zip(head, (cell.strip() for cell in row), strict=False)) for row in self.rows)


class Edited(NamedTuple):
    """A table without a participant."""

    kept: list[int]
    """The rows that stay, by their number from 0."""
    table: Cells
    renamed: int
    """Rows in which the name of a set has the pseudonym now."""


def read_table(path: Path) -> Cells | None:
    """Read a CSV or Parquet table as text; None if the file is no table or cannot be read."""
    try:
        if path.suffix == ".parquet":
            from hilbo.study.formats.csv_file import read_cells

            frame = read_cells(path)
            return Cells(list(map(str, frame.columns)), frame.to_numpy().tolist())
        with csv_rows(path) as (every, delimiter):
            rows = list(itertools.dropwhile(lambda cells: not any(cells), (cells for _, cells in every)))
    except InputError:
        return None
    return Cells(rows[0], rows[1:], delimiter) if rows else None


def table_content(path: Path, edited: Edited) -> bytes:
    """Content of the file `path` after the edit: only rows that stay, with new names of sets. A Parquet file is read
    again for it, so that its numbers stay the same bits."""
    if path.suffix == ".parquet":
        import pandas as pd

        frame, content = pd.read_parquet(path).iloc[edited.kept].copy(), io.BytesIO()
        for i, column in enumerate(edited.table.head):
            if column in _SET_COLUMNS:
                frame[column] = [row[i] for row in edited.table.rows]
        frame.to_parquet(content, index=False)
        return content.getvalue()
    return csv_text([edited.table.head, *edited.table.rows], edited.table.delimiter).encode()


def named_sets(table: Cells) -> set[str]:
    """Names of all sets in a table's columns set_a, set_b and set_id."""
    return {cells[column] for cells in table.named() for column in _NAME_COLUMNS if cells.get(column)}


def sets_of(tables: Iterable[Cells], participant: str, label: str) -> tuple[dict[str, str], set[str]]:
    """New names of a participant's sets (old name -> name with the pseudonym `label`), and the names of those sets that
    no other participant compared."""
    tables, renamed, theirs, compared, coded = list(tables), {}, set(), set(), set()
    for cells in (cells for table in tables for cells in table.named()):
        names = {cells.get(column, "") for column in ("set_a", "set_b")} - {""}
        if cells.get("participant") != participant:
            compared |= names
        else:
            coded |= {name for name in names if _CODED_OWN.fullmatch(name)}
        by_source = cells.get("source") == OWN + participant and "set_id" in cells
        theirs |= {cells["set_id"]} if by_source else set()
        for name in names | ({cells["set_id"]} if cells.get("set_id") else set()):
            new_name = _renamed_set(name, participant, label, (cells.get("material"),))
            if new_name == name and by_source and name == cells["set_id"]:
                new_name = re.sub(rf"(?<![A-Za-z0-9_.-]){re.escape(participant)}(?![\w.-])", label, name)
            renamed |= {name: new_name} if new_name != name else {}
    maps = {name.rpartition(" ")[0] for name in coded - compared}  # with the roles that they have not yet compared
    every = {name for table in tables for name in named_sets(table)}
    theirs |= {name for name in every if _CODED_OWN.fullmatch(name) and name.rpartition(" ")[0] in maps}
    return renamed, (theirs | set(renamed)) - compared


def _renamed_set(name: str, participant: str, label: str, materials: Iterable[str | None] = ()) -> str:
    """Name of a set with `label` in place of the id; unchanged if the set is not named after the participant.
    `materials`: those that may precede the name."""
    stated = [material for material in materials if material]
    for prefix in ("", *(f"{material} " for material in stated)):
        rest = name[len(prefix) :] if name.startswith(prefix) else ""
        if rest in (OWN + participant, f"own-{participant}"):
            return prefix + rest.removesuffix(participant) + label
        if participant not in stated and rest in [f"{participant} {role}" for role in ROLES]:
            return prefix + label + rest.removeprefix(participant)
    return name


def without_person(
    table: Cells, participant: str, label: str, names: Mapping[str, str], sets_gone: Collection[str] = ()
) -> Edited:
    """Remove a participant's rows from a table, and rename sets. `names`: old -> new name of a set; `sets_gone`: sets
    whose rows are removed; `label`: pseudonym for the source `individual:ID`."""
    head, kept, rows, renamed = [name.strip() for name in table.head], [], [], 0
    called = {**names, OWN + participant: OWN + label}
    for number, (row, cells) in enumerate(zip(table.rows, table.named(), strict=True)):
        own = cells.get("source") == OWN + participant and "set_id" not in cells
        if own or cells.get("participant") == participant or cells.get("set_id") in sets_gone:
            continue
        columns = [*head, *[""] * (len(row) - len(head))]
        new_row = [_new_cell(cell, column, called) for column, cell in zip(columns, row, strict=False)]
        renamed += new_row != row
        kept.append(number)
        rows.append(new_row)
    return Edited(kept, table._replace(rows=rows), renamed)


def _new_cell(cell: str, column: str, names: Mapping[str, str]) -> str:
    """Cell with the new name of a set, if its column has sets and the whole cell is a name in `names`; else unchanged.
    "a" and "b" in the columns first and preferred are sides."""
    side = column in ("first", "preferred") and cell.strip() in ("a", "b")
    return cell if column not in _SET_COLUMNS or side else names.get(cell.strip(), cell)


def plan_without(content: bytes, participant: str, label: str) -> str | None:
    """Text of a plan with `label` in place of a participant, the old hash in `replaces`, and a new one (unless the old
    did not fit). With individual sets the participant's row is removed. None if the content is no plan, or has nothing
    of theirs."""
    plan = plan_in(content)
    if plan is None or not any(participant in (row.participant, row.reissued_from) for row in plan.participants):
        return None
    rows = tuple(
        _row_without(row, participant, label, plan.materials)
        for row in plan.participants
        if not (row.participant == participant and plan.source == "individual")
    )
    changed = replace(plan, participants=rows, replaces=(*plan.replaces, plan.hash))
    return plan_text(hashed(changed) if plan.intact else changed)


def _row_without(row: PlanRow, participant: str, label: str, materials: Sequence[str | None]) -> PlanRow:
    """Copy of a plan's row with `label` in place of the participant, also in names of sets from their map."""

    def set_name(name: str) -> str:
        """Name of a set with the label in place of the participant."""
        return _renamed_set(name, participant, label, materials)

    def trial(planned: Planned) -> Planned:
        """Planned trial with the new names of its sets."""
        return replace(planned, a=set_name(planned.a), b=None if planned.b is None else set_name(planned.b))

    names = {participant: label}
    header = replace(
        row.header,
        participant=names.get(row.header.participant, row.header.participant),
        blocks=tuple(replace(block, trials=tuple(map(trial, block.trials))) for block in row.header.blocks),
        sets={set_name(name): values for name, values in row.header.sets.items()},
    )
    person = names.get(row.participant, row.participant)
    return PlanRow(person, row.order, header, label if row.reissued_from == participant else row.reissued_from)


def command_without(command: str, participant: str) -> str:
    """Command without the participant in its options --names and --participants; "" if such an option names nobody
    else. Commands whose --participants is a number are changed in --names only."""
    words, kept = command.split(), []
    with contextlib.suppress(ValueError):  # a list that was changed by hand
        words = shlex.split(command)
    names = {"--names"} if words[1:2] and words[1] in _COUNT_PEOPLE else {"--names", "--participants"}
    for before, word in zip(["", *words], words, strict=False):
        option, equals, value = word.partition("=") if word.startswith("--") else (before, "", word)
        people = [name.strip() for name in value.split(",")]
        if option in names and participant in people:
            left = ",".join(name for name in people if name != participant)
            if not left:
                return ""
            word = f"{option}={left}" if equals else left
        kept.append(word)
    return shlex.join(kept) if kept != words else command
