"""The data dictionary: unit and meaning of each column of the tables that `hilbo export` and `hilbo report` write.

Source of the sidecars of an export, dictionary.csv of a report, the page docs/guides/columns.md, and the names that no
parameter may have. Loads no JAX.
"""

import csv
from pathlib import Path

from hilbo.search.box import Box

__all__ = ["COLUMNS", "EXPORTED", "UNWRITTEN", "Meaning", "meanings", "presented_column"]

Meaning = tuple[str, str]
"""Unit ("" where there is none), and description."""
UNWRITTEN = "see the log"
"""Replaces a text that a spreadsheet would run; the log has the text."""
EXPORTED = ("trials", "validation", "sets", "presentations", "sessions")
"""Tables of `hilbo export`; all others are of `hilbo report`."""


def _read() -> dict[str, dict[str, Meaning]]:
    """Read hilbo/data/columns.csv: table -> column -> (unit, meaning)."""
    tables: dict[str, dict[str, Meaning]] = {}
    text = (Path(__file__).parents[2] / "data" / "columns.csv").read_text(encoding="utf-8")
    for row in csv.DictReader(text.splitlines()):
        for table in row["tables"].split():
            tables.setdefault(table, {})[row["column"]] = row["unit"], row["meaning"]
    return tables


COLUMNS = _read()
"""Table -> column -> meaning, from hilbo/data/columns.csv."""
_K0: Meaning = ("N/mm", "stiffness of the spring, derived from the effective stiffness")


def presented_column(side: str, name: str) -> str:
    """Column name of a parameter's value as confirmed to be presented on a side ("a" or "b"): `presented_SIDE_NAME`."""
    return f"presented_{side}_{name}"


def meanings(table: str, space: Box) -> dict[str, Meaning]:
    """Column -> (unit, meaning) of a table in a study with this search space: K0, the parameters, presented values, and
    the table's own columns, which replace a parameter of the same name. Raises KeyError for an unknown table."""
    units = {p.name: (p.unit, f", {p.range_words}" if p.levels else "") for p in space.parameters}
    columns = {"K0": _K0} | {name: (unit, f"value of the parameter{levels}") for name, (unit, levels) in units.items()}
    for side in "ab":
        for name, (unit, levels) in units.items():
            columns[presented_column(side, name)] = (unit, f"value confirmed as presented on side {side}{levels}")
    mechanics = space.mechanics
    damped = mechanics is not None and mechanics.effective_damping is not None
    natural = any(p.natural_ends for p in space.parameters)
    here = _by_the_study(natural, bool(space.constraints), mechanics is not None, damped)
    return columns | COLUMNS[table] | {name: here[name] for name in here if name in COLUMNS[table]}


def _by_the_study(natural: bool, constrained: bool, rendered: bool, damped: bool) -> dict[str, Meaning]:
    """Meanings of the columns `low_end` and `location`, whose possible values depend on what the study has:
    natural ends, constraints, a renderer, a range of effective damping."""
    ends, places = ["another response", "the range"], ["range limit"]
    if natural:
        places = [*places, "natural end of a range"]
    if constrained:
        ends, places = [*ends, "a constraint"], [*places, "constraint boundary"]
    if rendered:
        ends, places = [*ends, "the passive boundary"], [*places, "passive boundary"]
    if damped:
        ends, places = [*ends, "the range of effective damping"], [*places, "limit of effective damping"]
    return {
        "low_end": ("", f"reason of the lower end: {', '.join(ends[:-1])} or {ends[-1]}"),
        "location": ("", f"flags of the location: {', '.join(places)}, extrapolation; empty: none"),
    }
