"""One participant's part of tables: rows taken out of CSV, Parquet and netCDF, and names of their sets made nobody's.

A set that was read from somebody's own map may have been compared by others. Where their answers name it, it stays, and
its name and source say `withdrawn-…` in the place of the id; where nobody does, it goes. So do sets of their own map
under a code that their own answers alone name.
"""

import contextlib
import csv
import os
import tempfile
import warnings
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from hilbo.errors import InputError
from hilbo.session.plan.set_codes import OWN
from hilbo.session.withdrawal.names import CODED_OWN, renamed_set, replaced
from hilbo.study.formats.cell_text import csv_rows

__all__ = [
    "Cells",
    "Edited",
    "coded_own",
    "named_sets",
    "netcdf_without",
    "read_table",
    "replace_file",
    "set_names",
    "sets_compared",
    "sets_from",
    "without_person",
    "write_table",
]

_SET_COLUMNS = ("set_a", "set_b", "first", "preferred", "set_id", "source")


class Cells(NamedTuple):
    """A table as text: the header, and the rows."""

    head: list[str]
    rows: list[list[str]]
    delimiter: str = ","


def read_table(path: Path) -> Cells | None:
    """A CSV or Parquet table; None for what is none that can be read."""
    try:
        if path.suffix == ".parquet":
            from hilbo.study.formats.csv_file import read_cells

            with contextlib.suppress(InputError):
                frame = read_cells(path)
                return Cells(list(map(str, frame.columns)), frame.to_numpy().tolist())
            return None
        with open(path, newline="", encoding="utf-8-sig") as file:
            reader, delimiter = csv_rows(file, str(path))
            rows = list(reader)
    except (OSError, UnicodeDecodeError, csv.Error, InputError):
        return None
    return Cells(rows[0], rows[1:], delimiter) if rows else None


class Edited(NamedTuple):
    """What is left of a table."""

    kept: list[int]
    """The rows that stay, by their number from 0."""
    table: Cells
    renamed: int
    """Rows in which the name of a set has become nobody's."""


def set_names(table: Cells, participant: str, label: str) -> dict[str, str]:
    """The sets in a table that are named after a participant, and what they are called afterwards."""
    renamed = {}
    for cells in _rows(table):
        for name in filter(None, (cells.get(column) for column in ("set_a", "set_b", "set_id"))):
            new_name = renamed_set(name, participant, label, (cells.get("material"),))
            if new_name == name and name == cells.get("set_id") and cells.get("source") == OWN + participant:
                new_name = replaced(name, participant, label)
            renamed |= {name: new_name} if new_name != name else {}
    return renamed


def coded_own(table: Cells, participant: str) -> set[str]:
    """The sets of their own map that a participant's answers name by a code."""
    theirs = (cells for cells in _rows(table) if cells.get("participant") == participant)
    names = {cells.get(column, "") for cells in theirs for column in ("set_a", "set_b")}
    return {name for name in names if CODED_OWN.fullmatch(name)}


def named_sets(table: Cells) -> set[str]:
    """All sets that a table names."""
    return {cells[column] for cells in _rows(table) for column in ("set_a", "set_b", "set_id") if cells.get(column)}


def sets_from(table: Cells, participant: str) -> set[str]:
    """The sets whose source says that they are from a participant's map."""
    return {cells["set_id"] for cells in _rows(table) if cells.get("source") == OWN + participant and "set_id" in cells}


def sets_compared(table: Cells, participant: str) -> set[str]:
    """The sets that answers of others name; empty for a table of something else."""
    others = (cells for cells in _rows(table) if cells.get("participant") != participant)
    return {cells[column] for cells in others for column in ("set_a", "set_b") if cells.get(column)}


def _rows(table: Cells) -> Iterator[dict[str, str]]:
    head = [name.strip() for name in table.head]
    return (dict(zip(head, (cell.strip() for cell in row), strict=False)) for row in table.rows)


def without_person(
    table: Cells, participant: str, label: str, names: Mapping[str, str], sets_removed: Collection[str] = ()
) -> Edited:
    """A table without a participant. `names`: sets that are called otherwise now. `sets_removed`: their rows go."""
    head = [name.strip() for name in table.head]
    kept, rows, renamed = [], [], 0
    for number, (row, cells) in enumerate(zip(table.rows, _rows(table), strict=True)):
        own = cells.get("source") == OWN + participant and "set_id" not in cells
        if own or cells.get("participant") == participant or cells.get("set_id") in sets_removed:
            continue
        new_row = [
            _renamed(cell, column, {**names, OWN + participant: OWN + label})
            for column, cell in zip([*head, *[""] * (len(row) - len(head))], row, strict=False)
        ]
        renamed += new_row != row
        kept.append(number)
        rows.append(new_row)
    return Edited(kept, table._replace(rows=rows), renamed)


def _renamed(cell: str, column: str, names: Mapping[str, str]) -> str:
    """A whole cell that is the name of a set, called otherwise; a and b are sides where a side stands."""
    side = column in ("first", "preferred") and cell.strip() in ("a", "b")
    return cell if column not in _SET_COLUMNS or side else names.get(cell.strip(), cell)


def write_table(path: Path, edited: Edited) -> None:
    """Write a table anew, whole or not at all; where the path is a link, in the place that it leads to."""
    place = path.resolve()
    handle, new_file = tempfile.mkstemp(dir=place.parent, prefix=f".{path.stem}-", suffix=path.suffix)
    try:
        with open(handle, "w", newline="", encoding="utf-8") as file:
            if path.suffix != ".parquet":
                writer = csv.writer(file, delimiter=edited.table.delimiter, lineterminator="\n")
                writer.writerows([edited.table.head, *edited.table.rows])
            file.flush()
            os.fsync(file.fileno())
        if path.suffix == ".parquet":
            _parquet(path, edited).to_parquet(new_file, index=False)
        replace_file(place, Path(new_file))
    finally:
        Path(new_file).unlink(missing_ok=True)


def _parquet(path: Path, edited: Edited):
    """The rows that are left as the file itself has them, so that numbers stay the same bits."""
    import pandas as pd

    frame = pd.read_parquet(path).iloc[edited.kept].copy()
    for i, column in enumerate(edited.table.head):
        if column in _SET_COLUMNS:
            frame[column] = [row[i] for row in edited.table.rows]
    return frame


def netcdf_without(path: Path, participant: str) -> int | None:
    """Take a participant out of a netCDF file with a dimension `participant`, or with a `participant` of every
    `obs_id`; how many went, None for a file that cannot be read."""
    import xarray as xr

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with xr.open_datatree(path, engine="h5netcdf") as opened:
                groups = {node.path: node.to_dataset(inherit=False).load() for node in opened.subtree}
    except Exception:  # a damaged file makes the HDF5 library raise nearly everything
        return None
    keep = {}
    for group in groups.values():
        if "participant" in group and group["participant"].dims in (("participant",), ("obs_id",)):
            keep[group["participant"].dims[0]] = group["participant"].values != participant
    removed = max((int((~kept).sum()) for kept in keep.values()), default=0)
    if removed:
        kept_in = {name: {dim: kept for dim, kept in keep.items() if dim in g.dims} for name, g in groups.items()}
        tree = xr.DataTree.from_dict(
            {name: group.isel(kept_in[name]).drop_encoding() for name, group in groups.items()}
        )
        place = path.resolve()
        new_file = place.with_name(f".{place.name}-new")
        try:
            tree.to_netcdf(new_file, engine="h5netcdf")
            replace_file(place, new_file)
        finally:
            new_file.unlink(missing_ok=True)
    return removed


def replace_file(path: Path, new_file: Path) -> None:
    """Put a file that is complete in the place of another, with that one's rights; or leave both as before."""
    try:
        os.chmod(new_file, path.stat().st_mode if path.exists() else 0o600)
        os.replace(new_file, path)
    except BaseException:
        new_file.unlink(missing_ok=True)
        raise
