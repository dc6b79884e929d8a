"""Cells of responses, levels and ids of other programs: their plain form, and what they mean. Loads no JAX."""

import re
import unicodedata
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import NamedTuple

from hilbo.study.formats.cell_text import is_id
from hilbo.study.formats.csv_file import answer_forms

__all__ = [
    "Answers",
    "answers_of",
    "clean",
    "is_absent",
    "is_missing",
    "is_personal_id",
    "is_traceable",
    "levels_of",
    "plain",
    "told_missing",
]

_INVISIBLE = dict.fromkeys(map(ord, "\u200b\u200c\u200d\u2060\ufeff\u00ad"))
_MISSING = {
    *("", "na", "n/a", "nan", "null", "none", "<na>", "#n/a", "#null!", ".", "-", "undefined", "missing"),
    *("-1", "-9", "-99", "-999", "-77", "-88"),
    *("don't know", "dont know", "do not know", "no answer", "no response", "skip", "skipped", "timeout"),
    *("prefer not to say", "not answered", "weiß nicht", "weiss nicht", "keine angabe", "keine antwort", "k. a."),
}
_ABSENT = {"", "na", "n/a", "nan", "null", "none", "<na>", "#n/a", "#null!", "undefined", "missing"}
_PERSONAL = re.compile(r".+@.+\..+|[0-9a-f]{24}|A[0-9A-Z]{12,14}|R_[0-9A-Za-z]{13,17}|\d{1,3}(\.\d{1,3}){3}")
_WHOLE = re.compile(r"[-+]?\d+([.,]0+)?")


class Answers(NamedTuple):
    """What the cells of a response column mean."""

    labels: dict[str, str]
    """Cell, in its plain form, -> response of the study, for cells that are not a label as it stands; "" for ranks that
    may count from 0 or from 1."""
    missing: tuple[str, ...]
    """Cells, in their plain form, that mean a missing response."""
    unknown: tuple[str, ...]
    """Cells that mean nothing known."""
    from_zero: bool
    """Whether ranks count from 0."""


def clean(cell: str) -> str:
    """A cell without what no reader sees: blanks around it, no-break blanks, characters of no width; NFC."""
    return re.sub(r"\s+", " ", unicodedata.normalize("NFC", cell).translate(_INVISIBLE)).strip()


def plain(cell: str) -> str:
    """The form in which cells are compared: `clean`, in lower case, with straight apostrophes."""
    return clean(cell).casefold().replace("\u2019", "'")


def is_missing(cell: str) -> bool:
    """Whether a cell usually means a missing value."""
    return told_missing(cell, _MISSING)


def is_absent(cell: str, levels: Collection[str] = ()) -> bool:
    """Whether a cell of a parameter or stimulus has no value: it is empty or a word for a missing value, and none of
    the `levels`. Numbers such as -1 are values."""
    return plain(cell) in _ABSENT and plain(cell) not in {plain(level) for level in levels}


def told_missing(cell: str, marks: Collection[str]) -> bool:
    """Whether a cell is one of these marks of a missing value, in their plain form."""
    form = plain(cell)
    return form in marks or re.sub(r"(?<=\d)[.,]0+$", "", form) in marks


def is_traceable(text: str) -> bool:
    """Whether a text could be traced to a person: an address, or an id of Prolific, Mechanical Turk or Qualtrics."""
    return _PERSONAL.fullmatch(text) is not None


def is_personal_id(cell: str) -> bool:
    """Whether an id is traceable, or no valid id."""
    return is_traceable(cell) or not is_id(cell)


def answers_of(cells: Iterable[str], responses: Sequence[str], counts_from_zero: bool) -> Answers:
    """Find what the cells of a response column mean: labels in other capitals, blanks or Unicode forms, and ranks from
    1, or from 0 if there is a 0, or if the program is known to count so (`counts_from_zero`)."""
    forms, ranks = answer_forms(responses)
    known = {plain(form): responses[category] for form, category in forms.items()}
    every = {plain(cell) for cell in cells}
    whole = {_whole(form) for form in every if not is_missing(form)} - {None}
    from_zero = bool(ranks) and (counts_from_zero or 0 in whole) and whole <= set(range(len(responses)))
    if from_zero:
        zero = {str(rank): label for rank, label in enumerate(responses)}
        known = {plain(label): label for label in responses} | zero
    meant = {form: known.get(form) or known.get(re.sub(r"(?<=\d)[.,]0+$", "", form)) for form in every}
    missing = tuple(sorted(form for form in every if meant[form] is None and is_missing(form)))
    unknown = tuple(sorted(form for form in every if meant[form] is None and form not in missing))
    if from_zero and 0 not in whole:  # the program counts from 0, but nothing in the cells shows it
        labels = {form: "" for form in sorted(every) if _whole(form) is not None}
    elif from_zero:
        labels = {str(rank): label for rank, label in enumerate(responses)}
    else:
        exact = set(forms) | {f"{form}.0" for form in forms}
        labels = {form: label for form, label in sorted(meant.items()) if label and form not in exact}
    return Answers(labels, missing, unknown, from_zero)


def _whole(form: str) -> int | None:
    """A plain cell as a whole number; None if it is none."""
    return int(float(form.replace(",", "."))) if _WHOLE.fullmatch(form) else None


def levels_of(cells: Iterable[str], levels: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """Cells of a parameter with levels that are written otherwise -> level; and those that are no level."""
    known: Mapping[str, str] = {plain(level): level for level in levels}
    every = {clean(cell) for cell in cells if not is_absent(cell, levels)}
    other = {cell: known[plain(cell)] for cell in sorted(every) if cell not in levels and plain(cell) in known}
    return other, sorted(cell for cell in every if plain(cell) not in known)
