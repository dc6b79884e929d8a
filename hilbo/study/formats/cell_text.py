"""The rule for participants' ids, and the one for text in the cells of a table.

Loads no JAX, no pandas.

A spreadsheet runs a text cell that begins with =, @, + or - (OWASP, "CSV injection"). Where a cell ends depends on the
country that it is set to: the text `a;=1+1` is two cells in half of Europe. hilbo refuses such text where it comes in,
and writes every text as it is: a mark put before it would be another text. Plain numbers and lone dashes are no such
text.
"""

import re
from collections.abc import Iterable

from hilbo.errors import InputError

__all__ = [
    "FORMULA_WORDS",
    "ID_WORDS",
    "but_for_case",
    "check_id",
    "check_text",
    "formulas",
    "is_decimal",
    "is_id",
    "no_ids",
    "runs_in_a_spreadsheet",
    "without_decimal_comma",
]

_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,31}")
ID_WORDS = 'an id has up to 32 letters, digits, "_", "-", ".", begins with a letter or digit, and is nobody\'s name'
FORMULA_WORDS = (
    "which a spreadsheet would run as a formula; begin it, and what follows a comma, semicolon or tab in it, with a"
    " letter or a digit"
)
_NUMERAL = re.compile(r"[-+]?(\d+[.,]?\d*|[.,]\d+)([eE][-+]?\d+)?")
_DASHES = "-+ \t\r\n"
_BEGINS = ("=", "@", "+", "-", "\t", "\r", "\n", "＝", "＠", "＋", "－")  # noqa: RUF001 (some spreadsheets take these too)


_ENDS = re.compile(r"[,;\t\r\n]")  # of cells: the separators of tables that hilbo reads, and ends of lines


def is_id(participant: str) -> bool:
    """Whether this may be a participant's id: up to 32 letters, digits, "_", "-", ".", the first a letter or digit."""
    return _ID.fullmatch(participant) is not None


def check_id(participant: str, place: str) -> None:
    """Refuse what is no pseudonymous id; `place` says where it stands."""
    if not is_id(participant):
        raise InputError(f'{place}: participant is "{participant}"; {ID_WORDS}.')


def but_for_case(names: Iterable[str]) -> str:
    """The first two different names that are the same but for capitals, in words; empty where there are none."""
    first: dict[str, str] = {}
    for name in names:
        other = first.setdefault(name.casefold(), name)
        if other != name:
            return f'participants "{other}" and "{name}"'
    return ""


def runs_in_a_spreadsheet(text: str) -> bool:
    """Whether a spreadsheet may take this cell, or what follows a separator in it, for a formula."""
    return _begins_a_formula(text.lstrip(" ")) or any(
        _begins_a_formula(part.lstrip('"')) for part in _ENDS.split(text)[1:]
    )


def _begins_a_formula(text: str) -> bool:
    return text.startswith(_BEGINS) and text.strip(_DASHES) != "" and _NUMERAL.fullmatch(text.strip()) is None


def formulas(cells: Iterable[str]) -> set[str]:
    """Those of many cells that a spreadsheet would run."""
    return {cell for cell in set(cells) if runs_in_a_spreadsheet(cell)}


def no_ids(cells: Iterable[str]) -> set[str]:
    """Those of many cells that are no participant's id."""
    return {cell for cell in set(cells) if not is_id(cell)}


def check_text(text: str, name: str, place: str = "") -> None:
    """Refuse text that a spreadsheet would run; `name` says what it is, `place` where it stands."""
    if runs_in_a_spreadsheet(text):
        raise InputError(f'{place + ": " if place else ""}{name} is "{text}", {FORMULA_WORDS}.')


def is_decimal(cell: str, mark: str) -> bool:
    """Whether a cell is a number with this decimal mark."""
    return mark in cell and _NUMERAL.fullmatch(cell.strip()) is not None


def without_decimal_comma(cell: str) -> str:
    """A number as it is written with a decimal point; anything else as it was, to be refused."""
    return cell.replace(",", ".") if is_decimal(cell, ",") else cell
