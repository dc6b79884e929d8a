"""Names of people's own sets: a code in the place of the participant's id.

Others compare these sets, and their answers name them. A code is made from the sets' values alone, so that it leads to
nobody once the results are gone in which the values stand beside the id. And labels of renderings, for those who are
to speak of them without knowing them.
"""

import json
from collections.abc import Iterable, Mapping
from typing import Any

from hilbo.study.formats.json_file import digest_of
from hilbo.study.tables.parameter_sets import ROLES

__all__ = ["OWN", "Sets", "code_of", "coded", "label_of", "set_codes"]

OWN = "individual:"
_LETTERS = "ABCDEFGHKLMNPRSTUVWXYZ"  # none that looks or sounds like another, or like a digit
Sets = Mapping[str, Mapping[str, float]]
"""Name of a set -> parameters in physical units."""


def code_of(values: Any, taken: Iterable[str] = ()) -> str:
    """The code of some values; with a number behind it where another person has the same ones."""
    code = "s" + digest_of(json.dumps(values, sort_keys=True).encode())[:8]
    again = sum(other.partition("-")[0] == code for other in taken)
    return f"{code}-{again + 1}" if again else code


def label_of(values: Mapping[str, Any], session: str) -> str:
    """A label for a rendering (parameter -> value), the same whenever it comes again in a session: three letters and
    two digits, which say nothing of the values. `session`: what makes another session's labels others."""
    number = int(digest_of(json.dumps([session, sorted(values.items())]).encode()), 16)
    letters = ""
    for _ in range(3):
        number, letter = divmod(number, len(_LETTERS))
        letters += _LETTERS[letter]
    return f"{letters}-{number % 100:02d}"


def set_codes(sets: Mapping[str, Sets]) -> dict[str, str]:
    """Participant -> the code that stands for them in names of sets. `sets`: material -> name -> parameters."""
    values: dict[str, list[Any]] = {}
    for material, here in sets.items():
        for name, parameters in here.items():
            if person := _person(name):
                what = name.removesuffix(person).removeprefix(person)
                values.setdefault(person, []).append([material, what, sorted(parameters.items())])
    codes: dict[str, str] = {}
    for person, described in values.items():
        codes[person] = code_of(sorted(described), codes.values())
    return codes


def coded(name: str, codes: Mapping[str, str]) -> str:
    """The name of a set with the code in the place of the participant."""
    person = _person(name)
    if not person:
        return name
    return OWN + codes[person] if name.startswith(OWN) else codes[person] + name.removeprefix(person)


def _person(name: str) -> str:
    """Participant in the name of a set; "" for sets of the population."""
    if name.startswith(OWN):
        return name.removeprefix(OWN)
    before, _, role = name.rpartition(" ")
    return before if role in ROLES else ""
