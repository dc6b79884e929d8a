"""Remarks on the participants of a trial table, as sentences that `note` is called with."""

import re
from collections.abc import Callable, Sequence

import pandas as pd

from hilbo.study.formats.cell_text import alike, is_rounded

__all__ = ["note_absent", "note_doubtful_ids", "note_forms"]

_NAMED = 6  # participants named in a remark
_FEW_FORMS = 3  # of ids; more are random texts


def note_absent(
    left: pd.DataFrame, table: pd.DataFrame, source: str, besides: str, note: Callable[[str], object]
) -> None:
    """Call `note` with one sentence on participants who occur in `left` (excluded rows) but not in `table` (fitted
    rows); no call if there are none. `besides`: further reason for exclusion, for the sentence."""
    kept = set(table["participant"].unique())
    absent = [str(name) for name in left["participant"].unique() if name not in kept]
    if absent:
        who = ", ".join(absent[:_NAMED]) + (f" and {len(absent) - _NAMED} more" if len(absent) > _NAMED else "")
        answers = f"{len(left)} answers are" if len(left) > 1 else "1 answer is"
        have = "has" if len(absent) == 1 else "have"
        also = f"voided, warm-up or repeated{besides}, and not fitted"
        note(f"{source}: {answers} {also}; {who} {have} no other answer in it.")


def note_doubtful_ids(names: list[str], source: str, note: Callable[[str], object]) -> None:
    """Call `note` with a sentence on two ids that may belong to one participant, and on one that several may share."""
    if pair := alike(names):
        words = 'capitals, blanks, leading zeros or ".0" only'
        note(f"{source}: {pair} differ in {words}; they are treated as two participants.")
    if rounded := [name for name in names if is_rounded(name)]:
        note(
            f'{source}: participant "{rounded[0]}" looks like a number rounded by a spreadsheet; several'
            " participants may share it: export the ids as text."
        )


def note_forms(names: Sequence[str], source: str, note: Callable[[str], object]) -> None:
    """Call `note` with a sentence on ids of several forms, such as P01 and 1, one of which few participants have."""
    forms: dict[str, list[str]] = {}
    for name in names:
        forms.setdefault(re.sub(r"\d+", "0", re.sub(r"[A-Za-z]+", "a", name)), []).append(name)
    if 1 < len(forms) <= _FEW_FORMS:
        first, *others = sorted(forms.values(), key=len, reverse=True)
        odd = ", ".join(f'"{each[0]}"' for each in others)
        note(f'{source}: ids have several forms, such as "{first[0]}" and {odd}; look whether they are participants.')
