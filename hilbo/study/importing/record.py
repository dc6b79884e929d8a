"""The record of an import: rows read, converted and left out. Loads no JAX."""

from collections import Counter
from collections.abc import Mapping as MappingLike
from collections.abc import Sequence
from dataclasses import dataclass, field

import pandas as pd

from hilbo.study.file.reading import StudyFile
from hilbo.study.formats.json_file import Content
from hilbo.study.importing.answers import is_missing, is_traceable
from hilbo.study.importing.checks import numeric_names
from hilbo.study.importing.mapping import Mapping
from hilbo.study.importing.patterns import is_pattern, matches
from hilbo.study.importing.raw import RawTable
from hilbo.study.importing.tools import personal

__all__ = ["Counts", "record_of", "sentences_of"]


@dataclass
class Counts:
    """Counts of rows while an export is converted."""

    rows: int = 0
    """Rows read, further header rows not counted."""
    left_out: Counter[str] = field(default_factory=Counter)
    """Reason -> rows that are not in the table."""
    missing: Counter[str] = field(default_factory=Counter)
    """Cell -> missing responses."""
    people: Counter[str] = field(default_factory=Counter)
    """Id in the export -> missing responses."""


def record_of(
    tables: Sequence[RawTable],
    mapping: Mapping,
    study: StudyFile,
    table: pd.DataFrame,
    ids: MappingLike[str, str],
    counts: Counts,
) -> Content:
    """Actions taken, without ids, names of files, and texts that are no usual mark of a missing response: counts,
    columns, conversions. `table`: the trial table, `ids`: id in the export -> id in the table."""
    columns = dict.fromkeys(name for raw in tables for name in raw.cells.columns)
    used = {*mapping.keep, *mapping.rows}
    for column in mapping.columns.values():
        used |= {*matches(column, columns, numeric_names(study))} if is_pattern(column, columns) else {column}
    left = [_shown(name) for name in columns if name not in used]
    return {
        "schema": 1,
        "study": study.hash,
        "files": len(tables),
        "read_as": [sentence.removeprefix(f"{raw.source}: ") for raw in tables for sentence in raw.notes],
        "tool": mapping.tool,
        "rows_read": counts.rows,
        "trials": len(table),
        "participants": int(table["participant"].nunique()),
        "rows_left_out": {reason: count for reason, count in counts.left_out.items() if count},
        "missing": dict(_by_mark(counts.missing)),
        "missing_by_participant": sorted(counts.people.values(), reverse=True),
        "responses": dict(mapping.responses),
        "ids": mapping.ids or ("code" if ids else "as written"),
        "ids_changed": sum(old != new for old, new in ids.items()),
        "trials_numbered": "trial" not in mapping.columns,
        "trials_from": mapping.trials_from,
        "columns": dict(mapping.columns),
        "columns_kept": list(mapping.keep),
        "columns_left_out": left,
        "columns_personal": personal(left),
    }


def _shown(column: str) -> str:
    """A column's name without what could be traced to a participant, as JSON with ids as keys has."""
    return "…" if "@" in column else ".".join("…" if is_traceable(part) else part for part in column.split("."))


def _by_mark(missing: "Counter[str]") -> "Counter[str]":
    """Counts of missing responses by their usual marks; any other text, which a participant may have written, counts
    as "other"."""
    counts: Counter[str] = Counter()
    for cell, count in missing.items():
        counts[cell if is_missing(cell) else "other"] += count
    return counts


def sentences_of(record: Content, people: Counter[str]) -> list[str]:
    """The record as sentences for the user, who may see ids."""
    tool = f"an export of {record['tool']}; " if record["tool"] else ""
    lines = [
        f"{tool}{record['rows_read']} rows read, {record['trials']} trials of {record['participants']} participants."
    ]
    for reason, count in record["rows_left_out"].items():
        lines.append(f"{count} {'row is' if count == 1 else 'rows are'} left out: {reason}.")
    if people:
        marks = ", ".join(f'"{mark}" {count}' for mark, count in record["missing"].items())
        who = ", ".join(f"{name} {count}" for name, count in people.most_common(6))
        lines.append(f"missing responses: {marks}; by participant, as in the export: {who}{', …' * (len(people) > 6)}.")
    if record["responses"]:
        read = ", ".join(f'"{cell}" as {label}' for cell, label in record["responses"].items())
        lines.append(f"responses are read: {read}.")
    if record["ids_changed"]:
        lines.append(f"{record['ids_changed']} ids are changed; the list from old to new ids is kept beside the table.")
    if record["trials_numbered"]:
        lines.append("trials are numbered in the order of the rows or columns, which may not be that of presentation.")
    elif record["trials_from"] != 1:
        lines.append(f"trials are counted from {record['trials_from']} in the export, and from 1 in the table.")
    if personal_ones := record["columns_personal"]:
        lines.append(f"columns on persons are left out: {', '.join(personal_ones)}.")
    if others := [name for name in record["columns_left_out"] if name not in personal_ones]:
        lines.append(f"other columns are left out: {', '.join(others[:12])}{', …' * (len(others) > 12)}.")
    return lines
