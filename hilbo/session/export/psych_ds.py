"""The tables of sessions as a Psych-DS data set: a folder of CSV files, each with a JSON sidecar that describes its
columns."""

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from hilbo.session.export.tables import presentations_table, sessions_table, sets_table, trials_table, validation_table
from hilbo.session.log.log_files import log_name
from hilbo.session.log.state import LiveSession
from hilbo.study.file.columns import meanings
from hilbo.study.file.reading import StudyFile
from hilbo.study.formats.cell_text import check_text
from hilbo.study.tables.trials import write_trials

__all__ = ["psych_ds"]

_TABLES = {
    "trials": trials_table,
    "validation": validation_table,
    "sets": sets_table,
    "presentations": presentations_table,
}


def psych_ds(sessions: Sequence[LiveSession], folder: Path, study: StudyFile) -> list[Path]:
    """Write the tables that are not empty, with sidecars, into `folder`/data, and `folder`/dataset_description.json;
    return the paths of all files written.

    Raises InputError for an id, a label or the name of a set that a spreadsheet would run as a formula.
    """
    for state in sessions:
        _check_names(state)
    tables = {kind: make(sessions) for kind, make in _TABLES.items()} | {"sessions": sessions_table(sessions, study)}
    (folder / "data").mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    columns: dict[str, Any] = {}
    for kind, table in tables.items():
        if table.empty:
            continue
        known = meanings(kind, study.space)
        here = [_variable(str(column), *known[str(column)]) for column in table.columns]
        columns |= {variable["name"]: variable for variable in here if variable["name"] not in columns}
        written += _write(table, here, folder / "data", kind, study)
    path = folder / "dataset_description.json"
    path.write_text(_json(_description(study, len(sessions), list(columns.values()))), encoding="utf-8")
    return [*written, path]


def _write(table: pd.DataFrame, variables: list[dict[str, str]], data: Path, kind: str, study: StudyFile) -> list[Path]:
    """Write a table and its sidecar, which has the description of its columns (`variables`); return both paths."""
    name = re.sub(r"[^A-Za-z0-9]", "", study.name) or "study"
    path = data / f"study-{name}_table-{kind}_data.csv"
    write_trials(table, path)
    sidecar = path.with_suffix(".json")
    content = {"description": f"{kind} of {study.name}", "variableMeasured": variables}
    sidecar.write_text(_json(content), encoding="utf-8")
    return [path, sidecar]


def _description(study: StudyFile, logs: int, variables: list[dict[str, str]]) -> dict[str, Any]:
    """Content of dataset_description.json. `logs`: number of sessions; `variables`: descriptions of all columns."""
    return {
        "@context": "https://schema.org/",
        "@type": "Dataset",
        "name": study.name,
        "description": f"Live sessions of {logs} logs, study {study.hash}, written by hilbo.",
        "schemaVersion": "Psych-DS 0.4.0",
        "variableMeasured": variables,
    }


def _check_names(state: LiveSession) -> None:
    """Raise InputError for an id, a label or the name of a set that a spreadsheet would run as a formula. Unlike free
    texts, names cannot be left out of a table, since they identify its rows."""
    header, place = state.header, log_name(state.header)
    check_text(header.participant, "participant", place)
    check_text(header.session, "the session's label", place)
    for name in header.sets:
        check_text(name, "the name of a set", place)


def _variable(column: str, unit: str, meaning: str) -> dict[str, str]:
    """Psych-DS description of a column; without `unitText` if `unit` is empty."""
    variable = {"@type": "PropertyValue", "name": column, "description": meaning}
    return variable | {"unitText": unit} if unit else variable


def _json(content: Any) -> str:
    """Format as indented JSON with a final newline."""
    return json.dumps(content, indent=2, ensure_ascii=False) + "\n"
