"""Reading and writing CSV files as rows of text; all CSV files pass through here.

A file is UTF-8, with or without a byte order mark. Its cells are separated by commas, or, as spreadsheets of many
countries write it, by semicolons or tabs; blanks before a cell are not part of it. Loads no JAX, no pandas.
"""

import contextlib
import csv
import io
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from hilbo.errors import InputError, warn_caller

__all__ = ["CsvTable", "check_header", "csv_rows", "csv_text", "open_csv", "read_errors", "say_delimiter"]

_QUOTED = re.compile(r'"[^"]*"')
_DELIMITERS = {",": "commas", ";": "semicolons", "\t": "tabs"}
_MOST_COLUMNS = 16_384  # of Excel and LibreOffice
_SPREADSHEETS = (".xlsx", ".xls", ".ods")
_SPREADSHEET = "is a spreadsheet; save it as CSV, by the spreadsheet's own menu"
Rows = Iterator[tuple[int, list[str]]]
"""Line on which a row begins, and its cells."""


class CsvTable(NamedTuple):
    """An open CSV file whose header was read; its rows are read as they are iterated."""

    header: list[str]
    """Names of the columns, without blanks around them."""
    rows: Rows
    """The rows that are not empty, each as long as the header."""
    delimiter: str


@contextlib.contextmanager
def open_csv(path: str | os.PathLike, needs: str, *, fill: bool = False) -> Iterator[CsvTable]:
    """Context manager that opens a CSV file and reads its header. `needs`: end of the message for an empty file;
    `fill`: pad short rows with empty cells.

    Raises `InputError` for a file that cannot be read, a repeated column, and, while the rows are iterated, for a row
    that is longer than the header, or shorter without `fill`.
    """
    with csv_rows(path) as (every, delimiter):
        rows = ((line, cells) for line, cells in every if any(cells))  # no empty line, no spreadsheet's row of commas
        header = [name.strip() for name in next(rows, (1, []))[1]]
        if not header:
            raise InputError(f"{path}: is empty; {needs}.")
        check_header(header, f"{path}:1")
        yield CsvTable(header, _as_long(rows, len(header), str(path), fill), delimiter)


@contextlib.contextmanager
def csv_rows(path: str | os.PathLike) -> Iterator[tuple[Rows, str]]:
    """Context manager that gives an iterator of all rows, of any lengths, and the delimiter: the most frequent of
    comma, semicolon and tab in the first line with text. Raises `InputError`, also while the rows are iterated."""
    with read_errors(path), Path(path).open(newline="", encoding="utf-8-sig") as file:
        first = next((line for line in file if line.strip()), "")
        if first.lower().startswith("sep="):
            raise InputError(f'{path}:1: is "{first.strip()}", which only spreadsheets read; delete that line.')
        file.seek(0)
        delimiter = max(_DELIMITERS, key=_QUOTED.sub("", first).count)
        yield _numbered(csv.reader(file, delimiter=delimiter, skipinitialspace=True, strict=True)), delimiter


def csv_text(rows: Iterable[Sequence[str]], delimiter: str = ",") -> str:
    r"""Rows as the text of a CSV file, with quotes where needed and "\n" after each row."""
    text = io.StringIO()
    csv.writer(text, delimiter=delimiter, lineterminator="\n").writerows(rows)
    return text.getvalue()


def check_header(names: Sequence[str], place: str) -> None:
    """Raise `InputError` for a repeated column name, and for more than 16,384 columns; `place`: file and line, for the
    message."""
    if len(names) > _MOST_COLUMNS:
        raise InputError(
            f"{place}: has {len(names)} columns; a table has {_MOST_COLUMNS} at most, leave out unneeded ones."
        )
    known: set[str] = set()
    again = next((name for name in names if name in known or known.add(name)), None)
    if again is not None:
        raise InputError(f'{place}: column "{again}" is there twice; remove one of them.')


def say_delimiter(delimiter: str, source: str) -> None:
    """Warn if the delimiter is not a comma, because a comma in a number is then the decimal point."""
    if delimiter != ",":
        warn_caller(f"{source}: is read with {_DELIMITERS[delimiter]} between its cells; 1,5 is one and a half.")


@contextlib.contextmanager
def read_errors(path: str | os.PathLike) -> Iterator[None]:
    """Context manager that converts errors while a table is read (OSError, ValueError, csv.Error) to `InputError` with
    the file and the remedy. Raises it at once for a spreadsheet's file name."""
    try:
        if Path(path).suffix.lower() in _SPREADSHEETS and Path(path).is_file():
            raise InputError(f"{path}: {_SPREADSHEET}.")
        yield
    except InputError:
        raise
    except OSError as error:
        why = error.strerror or ("it is a stream, and no file" if "seekable" in str(error) else error)
        raise InputError(f"{path}: cannot be read ({why}); check the path.") from error
    except (ValueError, csv.Error) as error:  # pyarrow's errors, and text that is no UTF-8, are ValueErrors
        raise InputError(f"{path}: {_unreadable(Path(path), error)}.") from error


def _unreadable(path: Path, error: Exception) -> str:
    """Text of the message about a file that is not a table: reason and remedy, from its first bytes and the error."""
    with path.open("rb") as file:
        begin = file.read(4)
    if begin == b"PK\x03\x04":
        return _SPREADSHEET
    if isinstance(error, UnicodeDecodeError):
        kind = "is UTF-16 text" if begin[:2] in (b"\xff\xfe", b"\xfe\xff") else "is no UTF-8 text"
        return f"{kind}; save the table as CSV with the encoding UTF-8"
    if isinstance(error, csv.Error) and "unexpected end of data" in str(error):
        return "has a quotation mark that nothing closes; remove it, or close it"
    reason = str(error).strip().splitlines()[-1]
    return f"is not a table that can be read ({reason}); save it as CSV or Parquet"


def _numbered(reader) -> Rows:
    """Rows of a csv.reader, each with the number of the line on which it begins."""
    line = 1
    for cells in reader:
        yield line, cells
        line = reader.line_num + 1


def _as_long(rows: Rows, length: int, source: str, fill: bool) -> Rows:
    """Rows whose cells are as many as the header's (`length`). Short ones are padded with `fill`; otherwise
    `InputError` is raised."""
    for line, cells in rows:
        missing = length - len(cells)
        if missing < 0 or (missing and not fill):
            raise InputError(f"{source}:{line}: has {len(cells)} cells, the header has {length}; fix that line.")
        yield line, cells + [""] * missing
