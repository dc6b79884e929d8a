"""Separator and rows of CSV text of other programs. Loads no JAX, no pandas."""

import csv
import io
import re

from hilbo.errors import InputError

__all__ = ["csv_cells"]

_SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars"}
_QUOTED = re.compile(r'"[^"]*"')
_SAMPLE = 50  # lines in which separators are counted


def csv_cells(text: str, source: str) -> tuple[list[int], list[list[str]], list[str]]:
    """Lines and rows of CSV text, and sentences on a separator other than the comma. Empty lines are left out.

    The separator is the one of comma, semicolon, tab and bar that divides most lines of the beginning into equally many
    cells, quoted parts not counted; a first line "sep=;" states it. Raises `InputError` for a quotation mark that is
    not closed or stands within a cell.
    """
    first, _, rest = text.partition("\n")
    stated = first.strip().lower().startswith("sep=")
    separator = first.strip()[4:5] or "\t" if stated else _separator(text)
    reader = csv.reader(io.StringIO(rest if stated else text, newline=""), delimiter=separator, strict=True)
    lines, rows, line = [], [], 1 + stated
    try:
        for row in reader:
            if any(cell.strip() for cell in row):
                lines.append(line)
                rows.append(row)
            line = reader.line_num + 1 + stated
    except csv.Error as error:
        raise InputError(
            f'{source}:{line}: has a quotation mark that is not closed, or one within a cell; double it ("") there.'
        ) from error
    named = separator != "," and not stated
    words = _SEPARATORS.get(separator, f'"{separator}"')
    return lines, rows, [f"{source}: is read with {words} between its cells."] if named else []


def _separator(text: str) -> str:
    """The most plausible separator of CSV text: most lines with the same number of cells as the first, then most
    cells."""
    plain = [_QUOTED.sub("", line) for line in text.splitlines()[:_SAMPLE] if line.strip()]
    if not plain:
        return ","

    def score(separator: str) -> tuple[int, int]:
        """Number of lines with as many separators as the first, 0 if that has none; and that number."""
        count = plain[0].count(separator)
        return (sum(line.count(separator) == count for line in plain), count) if count else (0, 0)

    return max(_SEPARATORS, key=score)
