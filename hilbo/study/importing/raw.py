"""Tables of other programs as text cells: CSV of any dialect, spreadsheets, Parquet, JSON.

Nothing is interpreted here. The index of a table is the line (CSV) or the row (otherwise) in the file, so that messages
can name it. Every mistake is one sentence with the file.
"""

import datetime
import io
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import msgspec
import pandas as pd

from hilbo.errors import InputError
from hilbo.study.formats.csv_file import read_cells
from hilbo.study.formats.json_file import Content
from hilbo.study.formats.parsing import UNREADABLE
from hilbo.study.formats.text_encoding import decoded
from hilbo.study.importing.dialect import csv_cells

if TYPE_CHECKING:
    from openpyxl.worksheet._read_only import ReadOnlyWorksheet

__all__ = ["RawTable", "read_raw"]

_SHEETS = (".xlsx", ".xlsm")
_OLD_SHEETS = (".xls", ".ods", ".numbers")
_END = "END OF FILE"  # last row of an export of Gorilla


class RawTable(NamedTuple):
    """A table as text, and how its file was read."""

    cells: pd.DataFrame
    """Every cell as text; the index is the line or row in the file."""
    source: str
    notes: tuple[str, ...] = ()
    """Sentences on the encoding, the separator and repeated columns."""


def read_raw(path: Path) -> RawTable:
    """Read a table of any known format. Raises `InputError` for a file that cannot be read as a table."""
    suffix = path.suffix.lower()
    if suffix == ".parquet":
        return RawTable(read_cells(path), str(path))
    if suffix in _OLD_SHEETS:
        raise InputError(f"{path}: is a spreadsheet of a kind that is not read; save it as .xlsx or as CSV.")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path.") from error
    if suffix in _SHEETS or content.startswith(b"PK\x03\x04"):
        return _table(*_sheet_rows(content, str(path)), str(path), [])
    text, encoding = decoded(content, str(path))
    notes = [f"{path}: is read as {encoding} text; look at its accents."] if encoding else []
    if text.lstrip()[:1] in ("{", "[") and suffix not in (".csv", ".tsv"):
        return _table(*_json_rows(text, str(path)), str(path), notes)
    lines, rows, more = csv_cells(text, str(path))
    return _table(lines, rows, str(path), notes + more)


def _table(lines: Sequence[int], rows: Sequence[Sequence[str]], source: str, notes: list[str]) -> RawTable:
    """Rows of text, the first of which is the header, as a table. Rows that are longer than the header by empty cells
    only are cut, shorter ones of spreadsheets and JSON were filled by the reader. Raises `InputError`."""
    if not rows:
        raise InputError(f"{source}: is empty; a table needs a header and a row.")
    header = [name.strip() for name in rows[0]]
    while header and not header[-1] and all(len(row) < len(header) or not row[len(header) - 1] for row in rows[1:]):
        header.pop()
    header, repeated = _distinct(header)
    if repeated:
        notes = [
            *notes,
            f'{source}: column "{repeated}" occurs more than once; the others are called "{repeated} (2)".',
        ]
    kept = [(line, _fitted(row, len(header), source, line)) for line, row in zip(lines[1:], rows[1:], strict=True)]
    kept = [(line, row) for line, row in kept if row]
    index, cells = [line for line, _ in kept], [row for _, row in kept]
    return RawTable(pd.DataFrame(cells, index=index, columns=header, dtype=object), source, tuple(notes))


def _fitted(row: Sequence[str], length: int, source: str, line: int) -> list[str]:
    """A row's cells, as many as the header's; an empty list for an empty row and for the mark of an export's end.
    Raises `InputError` for another number of cells."""
    full = [cell for cell in row if cell.strip()]
    if not full or full == [_END]:
        return []
    if len(row) < length or any(cell.strip() for cell in row[length:]):
        raise InputError(
            f"{source}:{line}: has {len(row)} cells, the header has {length}; a cell with the separator in it needs"
            " quotation marks around it."
        )
    return list(row[:length])


def _distinct(names: Sequence[str]) -> tuple[list[str], str]:
    """Names made distinct, "x (2)" for the second "x" and "column 3" for an empty third one; and the first repeated
    name, or ""."""
    given: list[str] = []
    repeated, taken = "", {name for name in names if name}
    for number, name in enumerate(names, 1):
        name = name or f"column {number}"
        called, again = name, 1
        while called in given or (again > 1 and called in taken):
            called, again = f"{name} ({again + 1})", again + 1
        repeated = repeated or (name if again > 1 else "")
        given.append(called)
    return given, repeated


# Spreadsheets.


def _sheet_rows(content: bytes, path: str) -> tuple[list[int], list[list[str]]]:
    """Row numbers and rows of a spreadsheet's only sheet with cells, as text, all of one length. Raises `InputError`
    for several such sheets, a file that is no spreadsheet, and if openpyxl is not installed."""
    try:
        from openpyxl import load_workbook
    except ImportError as error:
        raise InputError(f"{path}: needs openpyxl; pip install 'hilbo[excel]', or save the table as CSV.") from error
    try:
        book = load_workbook(io.BytesIO(content), read_only=True, data_only=True)
    except Exception as error:  # openpyxl raises those of zipfile, XML and its own
        raise InputError(f"{path}: is no spreadsheet that can be read ({error}); save it again as .xlsx.") from error
    filled = {name: list(_filled_rows(book[name])) for name in book.sheetnames}
    filled = {name: rows for name, rows in filled.items() if rows}
    if len(filled) > 1:
        raise InputError(f"{path}: has several sheets ({', '.join(filled)}); save the one with the responses as CSV.")
    rows = next(iter(filled.values()), [])
    width = max((len(row) for _, row in rows), default=0)
    return [number for number, _ in rows], [row + [""] * (width - len(row)) for _, row in rows]


def _filled_rows(sheet: "ReadOnlyWorksheet") -> Iterator[tuple[int, list[str]]]:
    """Yield number (from 1) and cells of each row of a sheet that is not empty."""
    for number, row in enumerate(sheet.iter_rows(values_only=True), 1):
        cells = [_text(value) for value in row]
        if any(cells):
            yield number, cells


def _text(value: object) -> str:
    """A value of a spreadsheet or of JSON as text: numbers with the fewest digits that identify them, "" for None,
    nested values as JSON."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, datetime.date | datetime.time):
        return value.isoformat()
    return json.dumps(value, ensure_ascii=False) if isinstance(value, dict | list) else str(value)


# JSON.


def _json_rows(text: str, source: str) -> tuple[list[int], list[list[str]]]:
    """Row numbers and rows, the first of which is the header, of JSON: a list of objects, or one value a line, each an
    object or a list of them (JATOS). Nested objects become columns with dotted names. Raises `InputError`."""
    records = [_flat(record) for record in _records(text, source)]
    names = list(dict.fromkeys(name for record in records for name in record))
    rows = [names, *([record.get(name, "") for name in names] for record in records)]
    return list(range(len(rows))), rows  # record 1 is row 1; the header is not counted


def _records(text: str, source: str) -> list[Content]:
    """The objects of a JSON text. Raises `InputError` for other values, with the line where there are several."""
    try:
        values = [msgspec.json.decode(text)]
    except UNREADABLE:
        values = [_line_of_json(line, f"{source}:{n}") for n, line in enumerate(text.splitlines(), 1) if line.strip()]
    flat = [record for value in values for record in (value if isinstance(value, list) else [value])]
    records = [record for record in flat if isinstance(record, dict)]
    if len(records) < len(flat):
        wrong = next(record for record in flat if not isinstance(record, dict))
        raise InputError(f"{source}: has {json.dumps(wrong)[:60]} where a record is expected; export it as records.")
    return records


def _line_of_json(line: str, where: str) -> object:
    """The value of one line of JSON Lines. `where`: file and line. Raises `InputError`."""
    try:
        return msgspec.json.decode(line)
    except UNREADABLE as error:
        raise InputError(f"{where}: is no JSON ({error}); export the data again.") from error


def _flat(record: Content, before: str = "") -> dict[str, str]:
    """A record without nesting: {"a": {"b": 1}} becomes {"a.b": "1"}."""
    flat: dict[str, str] = {}
    for name, value in record.items():
        flat |= _flat(value, f"{before}{name}.") if isinstance(value, dict) else {f"{before}{name}": _text(value)}
    return flat
