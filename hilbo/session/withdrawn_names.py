"""How files of a study name a participant: in texts, in file names, and in the names of sets from their own map.

Names of sets have one of three forms, with a material before it or not: `individual:ID`, `ID ROLE`, and `own-ID` of
simulated studies of earlier versions. Nothing else in a plan or a table is taken for a name: an id such as 1 or a is
also a session's label, a number, or a side.
"""

import re
from collections.abc import Iterable

from hilbo.session.set_codes import OWN
from hilbo.study.set_table import ROLES

__all__ = ["CODED_JUDGED", "CODED_OWN", "names_person", "renamed_set", "replaced"]

CODED_OWN = re.compile(rf"(?:.+ )?s[0-9a-f]{{8}}(?:-\d+)? (?:{'|'.join(ROLES)})")
"""A set of somebody's own map under a code, as nobody else compares it."""
CODED_JUDGED = re.compile(OWN + r"s[0-9a-f]{8}")
"""In the name of a set of somebody's own map under a code, as others compare it."""


def names_person(text: str, participant: str) -> bool:
    """Whether a text holds this id, not as a part of another one."""
    return _pattern(participant).search(text) is not None


def replaced(text: str, participant: str, label: str) -> str:
    """A text with a label in the place of the id."""
    return _pattern(participant).sub(label, text)


def _pattern(participant: str) -> re.Pattern[str]:
    before = r"(?:(?<![A-Za-z0-9_.-])|(?<=\bown-))"
    return re.compile(rf"{before}{re.escape(participant)}(?![A-Za-z0-9_-]|\.[A-Za-z0-9])")


def renamed_set(name: str, participant: str, label: str, materials: Iterable[str | None] = ()) -> str:
    """The name of a set with a label in the place of the id; as it is, where it is not named after the participant."""
    known = [material for material in materials if material]
    for prefix in ("", *(f"{material} " for material in known)):
        own = name[len(prefix) :] if name.startswith(prefix) else ""
        if own in (OWN + participant, f"own-{participant}"):
            return prefix + own.removesuffix(participant) + label
        if participant not in known and own in [f"{participant} {role}" for role in ROLES]:
            return prefix + label + own.removeprefix(participant)
    return name
