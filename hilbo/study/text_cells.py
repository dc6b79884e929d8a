"""The rule for participants' ids, and the one for text that ends up in the cell of a table; loads no JAX.

A spreadsheet runs a text cell that begins with =, @, + or - (OWASP, "CSV injection"). hilbo refuses such text where it
comes in, and writes every text as it is: a mark put before it would be another text. Plain numbers are no such text.
"""

import re

from hilbo.errors import InputError

__all__ = ["check_id", "check_text", "is_id", "runs_in_a_spreadsheet"]

_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,31}")
_NUMERAL = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
_BEGINS = ("=", "@", "+", "-", "\t", "\r", "\n", "＝", "＠", "＋", "－")  # noqa: RUF001 (some spreadsheets take these too)


def is_id(participant: str) -> bool:
    """Whether this may be a participant's id: up to 32 letters, digits, "_", "-", ".", the first a letter or digit."""
    return _ID.fullmatch(participant) is not None


def check_id(participant: str, place: str) -> None:
    """Refuse what is no pseudonymous id; `place` says where it stands."""
    if not is_id(participant):
        raise InputError(
            f'{place}: participant is "{participant}"; an id has up to 32 letters, digits, "_", "-", ".", begins with'
            " a letter or digit, and is nobody's name."
        )


def runs_in_a_spreadsheet(text: str) -> bool:
    """Whether a spreadsheet may take this cell for a formula."""
    return text.startswith(_BEGINS) and _NUMERAL.fullmatch(text) is None


def check_text(text: str, name: str, place: str = "") -> None:
    """Refuse text that a spreadsheet would run; `name` says what it is, `place` where it stands."""
    if runs_in_a_spreadsheet(text):
        raise InputError(
            f'{place + ": " if place else ""}{name} is "{text}", which a spreadsheet would run as a formula; begin it'
            " with a letter or a digit."
        )
