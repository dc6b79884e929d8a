"""Cells of a CSV or Parquet table as text, and conversion of columns to numbers.

Numbers are correctly rounded from their decimals. If a CSV table is separated by semicolons or tabs, a comma in a
number is the decimal point, and a warning says so. A table is read in pieces of 50,000 rows. Every mistake is one
sentence with the file and the line (Parquet: row).
"""

import itertools
import math
import os
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from hilbo.errors import InputError
from hilbo.search.box import Parameter
from hilbo.study.formats.cell_text import is_decimal, without_decimal_comma
from hilbo.study.formats.csv_rows import check_header, open_csv, read_errors, say_delimiter

__all__ = [
    "FRAME",
    "answer_forms",
    "cell_pieces",
    "cells_of",
    "check_decimal_marks",
    "numbers",
    "parameter_values",
    "place",
    "read_cells",
    "refuse",
]

FRAME = "DataFrame"
"""Name in messages of a table that is in memory."""

_PIECE = 50_000  # rows


def read_cells(path: str | os.PathLike, needs: str = "a trial table needs a header and an answer") -> pd.DataFrame:
    """Read a whole table with every cell as text; the index is the line (CSV) or the row (Parquet), from 1.

    Raises `InputError` for a file that is not a table; `needs` ends the message for an empty file.
    """
    return pd.concat(cell_pieces(path, needs))


def cell_pieces(
    path: str | os.PathLike, needs: str = "a trial table needs a header and an answer"
) -> Iterator[pd.DataFrame]:
    """Read a table piece by piece, every cell as text, indexed as in `read_cells`. Yields at least one DataFrame, which
    may have no rows. Raises `InputError` while it is iterated; `needs` ends the message for an empty file."""
    path = Path(path)
    with read_errors(path):
        yield from _parquet_pieces(path) if path.suffix == ".parquet" else _csv_pieces(path, needs)


def cells_of(frame: pd.DataFrame) -> pd.DataFrame:
    """The cells of a DataFrame as text, "" for missing values, with its rows numbered from 1. Raises `InputError` for
    another type, and for repeated, too many or multi-level columns."""
    if not isinstance(frame, pd.DataFrame):
        raise InputError(f"{FRAME}: this is a {type(frame).__name__}; give a pandas DataFrame.")
    if frame.columns.nlevels > 1:
        raise InputError(f"{FRAME}: the columns have {frame.columns.nlevels} levels; give one name for each column.")
    check_header(list(frame.columns), FRAME)
    return _as_text(frame, 1)


def _parquet_pieces(path: Path) -> Iterator[pd.DataFrame]:
    """Read a Parquet file as pieces of text cells. The first piece has no rows, so that a table without rows still has
    its columns. Raises `InputError` for its column names."""
    from pyarrow.parquet import ParquetFile

    with ParquetFile(path) as file:
        check_header(file.schema_arrow.names, str(path))
        first_row = 1
        yield _as_text(file.schema_arrow.empty_table().to_pandas(), first_row)
        for batch in file.iter_batches(_PIECE):
            yield _as_text(batch.to_pandas(), first_row)
            first_row += batch.num_rows


def _as_text(frame: pd.DataFrame, first_row: int) -> pd.DataFrame:
    """All cells as text, indexed from `first_row`."""
    index = np.arange(first_row, first_row + len(frame))
    return pd.DataFrame({name: _column_as_text(frame[name]) for name in frame}, index=index, dtype=object)


def _column_as_text(column: pd.Series) -> list[str]:
    """Each cell as text, "" where it is missing. Floats have the fewest digits that identify the number in the column's
    own precision: 0.99 of a float32 column is "0.99"."""
    narrow = column.dtype.kind == "f" and getattr(column.dtype, "itemsize", 8) < 8  # a sparse dtype has no size
    values = column.to_numpy() if narrow else column.tolist()
    return ["" if missing else str(v) for v, missing in zip(values, column.isna().tolist(), strict=True)]


def _csv_pieces(path: Path, needs: str) -> Iterator[pd.DataFrame]:
    """Read a CSV file as pieces of text cells, indexed by line; the attribute "decimal comma" says whether a comma may
    be the decimal point. Warns if the separator is not a comma. Raises `InputError`."""
    with open_csv(path, needs) as table:
        say_delimiter(table.delimiter, str(path))
        pieces = iter(lambda: [*itertools.islice(table.rows, _PIECE)], [])
        for rows in itertools.chain([next(pieces, [])], pieces):  # a table without rows has columns too
            lines, cells = [line for line, _ in rows], [row for _, row in rows]
            frame = pd.DataFrame(cells, index=lines, columns=table.header, dtype=object)
            frame.attrs["decimal comma"] = table.delimiter != ","
            yield frame


def place(source: str, row: object = None) -> str:
    """Prefix of an error message, "FILE:LINE: ", or "FILE: row N: " for Parquet and DataFrames; `row` None is the
    header."""
    if str(source).endswith(".parquet") or source == FRAME:
        return f"{source}: " if row is None else f"{source}: row {row}: "
    return f"{source}:{1 if row is None else row}: "


def numbers(
    text: pd.DataFrame, column: str, source: str, words: str, valid: Callable[[pd.Series], pd.Series]
) -> pd.Series:
    """A column of text cells as float64, each correctly rounded.

    `valid`: function of the float Series that returns a Boolean Series of the allowed values; `words` describes them in
    the message. Raises `InputError` for the first cell that is no finite, allowed number, and for mixed decimal marks.
    """
    cells = _with_points(text, column, source)
    comma = text.attrs.get("decimal comma", False)
    try:
        floats = [] if "_" in "".join(cells) else [float(cell) for cell in cells]
    except ValueError:
        floats = []
    values = pd.Series(floats if len(floats) == len(cells) else [_number(c) for c in cells], text.index, dtype=float)
    wrong = ~(np.isfinite(values) & valid(values))
    hint = "" if comma else "; write 1.5 for one and a half"

    def sentence(row: object) -> str:
        cell = text.at[row, column]
        return f'{column} is "{cell}"; it must be {words}{hint if "," in cell else ""}.'

    refuse(wrong, source, sentence)
    return values


def answer_forms(responses: Sequence[str]) -> tuple[dict[str, int], str]:
    """Accepted texts of a response -> category from 0, and the description of the accepted texts other than labels (""
    for only labels).

    If all labels are whole numbers, "6.0" and "6,0" also mean the label "6", since pandas writes a column with missing
    cells so. If some label reads as a number otherwise, only labels are accepted. If no label does, ranks from 1 are
    accepted too.
    """
    forms = {label: i for i, label in enumerate(responses)}
    if all(re.fullmatch("0|-?[1-9][0-9]*", label) for label in responses):
        return {form: i for label, i in forms.items() for form in (label, f"{label}.0", f"{label},0")}, ""
    if any(math.isfinite(_number(without_decimal_comma(label))) for label in responses):
        return forms, ""
    ranks = {form: i for i in range(len(responses)) for form in (str(i + 1), f"{i + 1}.0", f"{i + 1},0")}
    return ranks | forms, f"a rank from 1 to {len(responses)}"


def parameter_values(text: pd.DataFrame, parameter: Parameter, source: str) -> pd.Series:
    """A parameter's column of text cells as float64 in physical units; names of levels become their index from 0.

    Raises `InputError` for a cell that is no number in the range (whole, for an integer parameter), or no level.
    """
    if parameter.levels:
        cells = text[parameter.name].str.strip()
        values = cells.map({level: float(place) for place, level in enumerate(parameter.levels)})
        refuse(
            values.isna(),
            source,
            lambda row: f'{parameter.name} is "{cells.at[row]}"; it must be {parameter.range_words}.',
        )
        return values.astype(float)

    def valid(values):
        return (values >= parameter.low) & (values <= parameter.high) & ((values % 1 == 0) | (not parameter.integer))

    return numbers(text, parameter.name, source, f"{parameter.range_words}, the study's range", valid)


def check_decimal_marks(text: pd.DataFrame, columns: Sequence[str], source: str) -> None:
    """Raise `InputError` if some number of these columns of text cells has a decimal comma and another one a point, in
    a file in which a comma may be the decimal mark; the message has both cells."""
    if not text.attrs.get("decimal comma", False):
        return
    comma, point = _first_marked(text, columns, ","), _first_marked(text, columns, ".")
    if comma and point:
        where, what = max(comma[0], point[0]), comma[1] if comma[1] == point[1] else f"{comma[1]}, {point[1]}"
        raise InputError(
            f'{place(source, where)}{what} has decimal commas and decimal points ("{comma[2]}" and "{point[2]}");'
            " write all numbers of the table with one of them."
        )


def _first_marked(text: pd.DataFrame, columns: Sequence[str], mark: str) -> tuple[int, str, str] | None:
    """Row, column and text of the first number with this decimal mark; None if there is none."""
    hits = (
        (row, column, cell)
        for column in columns
        for row, cell in zip(text.index, text[column], strict=True)
        if mark in cell and is_decimal(cell, mark)
    )
    return next(hits, None)


def _with_points(text: pd.DataFrame, column: str, source: str) -> list[str]:
    """Cells of a column, with decimal commas replaced by points if the file is one whose numbers may have them. Raises
    `InputError` for commas and points in one column."""
    check_decimal_marks(text, [column], source)
    cells = text[column].tolist()
    return [without_decimal_comma(cell) for cell in cells] if text.attrs.get("decimal comma", False) else cells


def _number(cell: str) -> float:
    """A cell as a float; NaN if it is none. Underscores are not accepted."""
    try:
        return np.nan if "_" in cell else float(cell)  # Python reads 1_5 as 15
    except ValueError:
        return np.nan


def refuse(wrong: pd.Series, source: str, sentence: Callable[[object], str]) -> None:
    """Raise `InputError` with `sentence(row)` for the first True of `wrong` (Boolean, indexed by row); do nothing if
    there is none. `source`: the file, for the message."""
    if wrong.any():
        row = wrong.idxmax()
        raise InputError(f"{place(source, row)}{sentence(row)}")
