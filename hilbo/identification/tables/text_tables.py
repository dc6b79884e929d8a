"""The table in a text file: encoding, separator, header, row of units, rows, and blocks of several steps.

Files of instruments have lines before the header (instrument, sample, date), often the units in the row below it, and
several steps one after the other, each with a header of its own. A line is a header if it names a time and another
quantity of `headings`, or the columns that the user names; a block is a header with the rows below it. Nothing
is dropped without a word: `TextTable.note` says which lines were not read.
"""

import csv
import io
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from hilbo.errors import InputError
from hilbo.identification.tables.blocks import Block, Rows, chosen, completed, is_filled, numerals
from hilbo.identification.tables.headings import heading
from hilbo.identification.tables.layout import Layout, Renamed, renamed
from hilbo.study.formats.csv_file import place, read_cells
from hilbo.study.formats.csv_rows import read_errors, say_delimiter
from hilbo.study.formats.text_encoding import decoded

__all__ = ["TextTable", "read_text_table"]

_DELIMITERS = (",", ";", "\t")
_NEEDS = "a material table needs a header with units and the samples of a test"
_FEWEST = 3  # rows of numbers, one after the other, that are taken for a table
_LINE_END = re.compile(r"[\r\n]+")


class TextTable(NamedTuple):
    """Cells of a table as text, indexed by line (Parquet: row); `where`: the header's place, for messages; `note`: how
    it was read, "" for a plain table."""

    cells: pd.DataFrame
    where: str
    note: str


def read_text_table(path: str | os.PathLike, layout: Layout) -> TextTable:
    """Read the table, or the chosen blocks, of a CSV, text or Parquet file. Raises `InputError` for a file without a
    table, and for several blocks without a choice."""
    source = str(path)
    if source.endswith(".parquet"):
        return TextTable(read_cells(path, _NEEDS), place(source), "")
    with read_errors(path):
        data = Path(path).read_bytes()
        if data[:4] == b"PK\x03\x04":
            raise ValueError  # which `read_errors` makes the sentence about spreadsheets
        text, encoding = decoded(data, source)
        lines = list(io.StringIO(text, newline=""))
        names = renamed(layout)
        first, delimiter = _first_header(lines, names, source)
        blocks = list(_blocks(lines, first, delimiter, names, source))
    block, note = chosen(blocks, layout, source)
    say_delimiter(delimiter, source)
    cells = pd.DataFrame([c for _, c in block.rows], [n for n, _ in block.rows], block.names, dtype=object)
    cells.attrs["decimal comma"] = delimiter != ","
    sentences = [f"The file is no UTF-8 text and was read as {encoding}."] if encoding else []
    before = sum(1 for line in lines[: blocks[0].line - 1] if line.strip())
    sentences += [sentence for sentence in (_lines_note(block, before, note),) if sentence]
    return TextTable(cells, f"{source}:{block.line}: ", " ".join(sentences))


def _lines_note(block: Block, before: int, blocks: str) -> str:
    """Sentence on header, units, blocks and lines that were not read; "" for a table that begins in the first line.
    `before`: number of lines above the header; `blocks`: clause on the blocks, or ""."""
    parts = [f"the header is in line {block.line}"] if before else []
    parts += [f"the units are in line {block.units}"] if block.units else []
    parts += [blocks] if blocks else []
    left = before + block.left_out
    if left:
        parts.append(
            f"{left} lines without samples were not read" if left > 1 else "1 line without samples was not read"
        )
    sentence = ", ".join(parts)
    return f"{sentence[0].upper()}{sentence[1:]}." if sentence else ""


def _first_header(lines: Sequence[str], names: Sequence[Renamed], source: str) -> tuple[int, str]:
    """Index of the line with the first header, and the separator: the one by which most of its cells are quantities.
    Without a header, of the line that looks like one. Raises `InputError` for an empty file, and for numbers without a
    header."""
    filled = [i for i, line in enumerate(lines) if line.strip(' ,;\t\r\n"')]
    if not filled:
        raise InputError(f"{source}: is empty; {_NEEDS}.")
    for i in filled:
        if any(letter.isalpha() for letter in lines[i]):
            counts = {d: _header_count(_split(lines[i], d), names) for d in _DELIMITERS}
            if any(counts.values()):
                return i, max(_DELIMITERS, key=lambda d: counts[d])
    return _likely_header(lines, filled, source)


def _likely_header(lines: Sequence[str], filled: Sequence[int], source: str) -> tuple[int, str]:
    """Line and separator of what looks like a header although it names no quantities: the fullest line without numbers
    above the first rows of numbers, or else the first line. Raises `InputError` if the rows of numbers begin at the
    first line, or if blanks separate their numbers."""
    for d in reversed(_DELIMITERS):  # a comma may be the decimal mark
        cells = {i: _split(lines[i], d) for i in filled}
        runs = [numerals(cells[i]) >= 2 for i in filled]
        start = next((k for k in range(len(runs)) if len(runs[k:]) >= _FEWEST and all(runs[k : k + _FEWEST])), None)
        if start == 0:
            raise InputError(
                f"{source}:{filled[0] + 1}: is a row of numbers; write a header above it, such as"
                f" {d.join(('time_s', 'position_mm', 'force_N'))}."
            )
        if start is not None:
            above = [i for i in filled[max(0, start - 4) : start] if numerals(cells[i]) == 0]
            if above:
                return max(above, key=lambda i: sum(map(bool, cells[i]))), d
    runs = [numerals(lines[i].split()) >= 2 for i in filled]
    if any(all(runs[k : k + _FEWEST]) for k in range(len(runs) - _FEWEST + 1)):
        raise InputError(f"{source}: has blanks between its numbers; save it with tabs, semicolons or commas.")
    return filled[0], max(_DELIMITERS, key=re.sub('"[^"]*"', "", lines[filled[0]]).count)


def _blocks(lines: list[str], first: int, delimiter: str, names: Sequence[Renamed], source: str) -> Iterator[Block]:
    """Yield every header, from the line of index `first` on, with the rows below it. Raises `csv.Error`, and
    `InputError` for rows that are not as long as their header."""
    before = [(i + 1, _split(line, delimiter)) for i, line in enumerate(lines[:first])]
    rows = _rows(lines[first:], first, delimiter)
    line, header = next(rows)
    below: Rows = []
    columns = _quantity_columns(header, names)
    for number, cells in rows:
        if numerals(cells, columns) < 2 and _header_count(cells, names):
            block, before = completed(before, line, header, below, columns, source, last=False)
            yield block
            line, header, below, columns = number, cells, [], _quantity_columns(cells, names)
        else:
            below.append((number, cells))
    yield completed(before, line, header, below, columns, source, last=True)[0]


def _rows(lines: list[str], offset: int, delimiter: str) -> Iterator[tuple[int, list[str]]]:
    """Rows that are not empty, each with the number of the line in the file on which it begins."""
    reader = csv.reader(lines, delimiter=delimiter, skipinitialspace=True, strict=True)
    line = 1
    for cells in reader:
        if is_filled(cells):
            yield offset + line, [_LINE_END.sub(" ", cell) for cell in cells]  # a message about a cell is one line
        line = reader.line_num + 1


def _split(line: str, delimiter: str) -> list[str]:
    """Cells of one line, without blanks around them; the whole line if its quotation marks cannot be read."""
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])]
    except csv.Error:
        return [line.strip()]


def _header_count(cells: Sequence[str], names: Sequence[Renamed]) -> int:
    """Number of columns that are quantities, by their name or named by the user; 0 if the line is no header."""
    cells = [cell.strip() for cell in cells]
    if names:
        meant = {column for name in names if (column := name.among(cells)) is not None}
        if len(meant) < len({name.column for name in names}):
            return 0
    heads = {head.quantity for cell in cells if (head := heading(cell)) is not None}
    timed = bool({"time", "step time"} & heads) and len(heads - {"time", "step time"}) > 0
    return len(heads) + len(names) if names or timed or "oscillation" in heads else 0


def _quantity_columns(header: Sequence[str], names: Sequence[Renamed]) -> list[int]:
    """Positions of the columns that are quantities; of all columns where there are none."""
    cells = [cell.strip() for cell in header]
    meant = {name.among(cells) for name in names}
    return [i for i, cell in enumerate(cells) if cell in meant or heading(cell) is not None] or [*range(len(cells))]
