"""Rules for participants' ids, and for text in the cells of a table (protection against CSV injection).

Loads no JAX, no pandas.

A spreadsheet runs a text cell that begins with =, @, + or - (OWASP, "CSV injection"). Where a cell ends depends on the
locale: the text `a;=1+1` is two cells in half of Europe. hilbo rejects such text on input and writes every text
unchanged: an escape character would make it another text. Plain numbers and lone dashes are allowed.
"""

import re
import unicodedata
from collections.abc import Iterable

from hilbo.errors import InputError

__all__ = [
    "FORMULA_WORDS",
    "ID_WORDS",
    "alike",
    "but_for_case",
    "check_id",
    "check_text",
    "formulas",
    "id_form",
    "invalid_ids",
    "is_decimal",
    "is_id",
    "is_rounded",
    "runs_in_a_spreadsheet",
    "without_decimal_comma",
]

_ID = re.compile(r"[A-Za-z0-9]([A-Za-z0-9_.-]{0,62}[A-Za-z0-9_-])?")
_RESERVED = re.compile(r"(?i:con|prn|aux|nul|com\d|lpt\d)(\..*)?")  # by Windows, which keeps no file of this name
ID_WORDS = (
    'an id has up to 64 letters, digits, "_", "-", ".", begins with a letter or digit, does not end with ".", and is'
    " neither a person's name nor one that Windows reserves, such as NUL"
)
FORMULA_WORDS = (
    "which a spreadsheet would run as a formula; begin it, and what follows a comma, semicolon or tab in it, with a"
    " letter or a digit"
)
_NUMERAL = re.compile(r"[-+]?(\d+[.,]?\d*|[.,]\d+)([eE][-+]?\d+)?")
_ROUNDED = re.compile(r"\d([.,]\d+)?[eE]\+?\d+")
_DASHES = "-+ \t\r\n"
_BEGINS = ("=", "@", "+", "-", "\t", "\r", "\n", "＝", "＠", "＋", "－")  # noqa: RUF001 (some spreadsheets take these too)


_ENDS = re.compile(r"[,;\t\r\n]")  # of cells: the separators of tables that hilbo reads, and ends of lines


def is_id(participant: str) -> bool:
    """Whether this may be a participant's id: up to 64 letters, digits, "_", "-", ".", the first a letter or digit, the
    last not "."; no reserved name of Windows."""
    return _ID.fullmatch(participant) is not None and _RESERVED.fullmatch(participant) is None


def check_id(participant: str, place: str) -> None:
    """Raise InputError unless this is a valid id; `place`: file and line for the message."""
    if not is_id(participant):
        raise InputError(f'{place}: participant is "{participant}"; {ID_WORDS}.')


def but_for_case(names: Iterable[str]) -> str:
    """The first pair of different ids that are equal apart from capitals, as 'participants "a" and "A"'; "" if there is
    none."""
    first: dict[str, str] = {}
    for name in names:
        other = first.setdefault(name.casefold(), name)
        if other != name:
            return f'participants "{other}" and "{name}"'
    return ""


def alike(names: Iterable[str]) -> str:
    """The first pair of different ids that have the same `id_form`, as 'participants "1" and "01"'; "" if there is
    none."""
    first: dict[str, str] = {}
    for name in names:
        other = first.setdefault(id_form(name), name)
        if other != name:
            return f'participants "{other}" and "{name}"'
    return ""


def id_form(text: str) -> str:
    """Normal form of an id: without what spreadsheets and people change, that is blanks, leading zeros of numbers and
    ".0" after them; lower case, NFKC."""
    text = re.sub(r"\s+", "", unicodedata.normalize("NFKC", text)).casefold()
    return re.sub(r"(?<=\d)\.0+(?!\d)", "", re.sub(r"(?<![\d.])0+(?=\d)", "", text))


def is_rounded(name: str) -> bool:
    """Whether an id is a number with an exponent, as a spreadsheet shows long ones, such as 9.45E12."""
    return _ROUNDED.fullmatch(name) is not None


def runs_in_a_spreadsheet(text: str) -> bool:
    """Whether a spreadsheet could take this cell, or a part of it after a comma, semicolon, tab or line break, for a
    formula."""
    return _begins_a_formula(text.lstrip(" ")) or any(
        _begins_a_formula(part.lstrip('"')) for part in _ENDS.split(text)[1:]
    )


def _begins_a_formula(text: str) -> bool:
    """Whether a text begins with a formula character, and is neither a number nor only dashes, plus signs and
    blanks."""
    return text.startswith(_BEGINS) and text.strip(_DASHES) != "" and _NUMERAL.fullmatch(text.strip()) is None


def formulas(cells: Iterable[str]) -> set[str]:
    """The set of those cells that a spreadsheet could run as a formula."""
    return {cell for cell in set(cells) if runs_in_a_spreadsheet(cell)}


def invalid_ids(cells: Iterable[str]) -> set[str]:
    """The set of those cells that are not valid participants' ids."""
    return {cell for cell in set(cells) if not is_id(cell)}


def check_text(text: str, name: str, place: str = "") -> None:
    """Raise InputError if a spreadsheet could run this text as a formula; `name`: what the text is, `place`: its
    location or "", for the message."""
    if runs_in_a_spreadsheet(text):
        raise InputError(f'{place + ": " if place else ""}{name} is "{text}", {FORMULA_WORDS}.')


def is_decimal(cell: str, mark: str) -> bool:
    """Whether a cell is a number written with this decimal mark ("," or "."); False for a number without the mark."""
    return mark in cell and _NUMERAL.fullmatch(cell.strip()) is not None


def without_decimal_comma(cell: str) -> str:
    """A number with its decimal comma replaced by a point; any other text unchanged."""
    return cell.replace(",", ".") if is_decimal(cell, ",") else cell
