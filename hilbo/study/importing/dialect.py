"""Encoding and separator of CSV text of other programs. Loads no JAX, no pandas."""

import codecs
import csv
import io
import re

from hilbo.errors import InputError

__all__ = ["csv_cells", "decoded_text"]

_MARKS = ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"))
_SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars"}
_QUOTED = re.compile(r'"[^"]*"')
_SAMPLE = 50  # lines in which separators are counted


def decoded_text(content: bytes, source: str) -> tuple[str, list[str]]:
    """Decode a file: UTF-8, UTF-16 with or without a byte order mark, else Windows-1252. Returns the text, and
    sentences on an encoding other than UTF-8. Raises `InputError` for bytes that are no text."""
    encoding = next((name for mark, name in _MARKS if content.startswith(mark)), "")
    if not encoding and b"\0" in content[:200]:
        encoding = "utf-16-le" if content[1:2] == b"\0" else "utf-16-be"
    try:
        text = content.decode(encoding or "utf-8")
    except UnicodeDecodeError as error:
        if encoding:
            raise InputError(f"{source}: is damaged {encoding} text; export it again, as UTF-8.") from error
        text, encoding = _windows(content, source), "Windows-1252"
    if "\0" in text:
        raise InputError(f"{source}: is no text; export the table as CSV.")
    named = encoding not in ("", "utf-8-sig")
    return text, [f"{source}: is read as {encoding.upper()} text; look at its accents."] if named else []


def _windows(content: bytes, source: str) -> str:
    """Text of Windows-1252. Raises `InputError` for bytes that it does not have."""
    try:
        return content.decode("cp1252")
    except UnicodeDecodeError as error:
        raise InputError(f"{source}: is no text in UTF-8, UTF-16 or Windows-1252; export it as UTF-8.") from error


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
