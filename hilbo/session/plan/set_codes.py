"""Codes in place of participants' ids in the names of individual sets, and labels of renderings.

Other participants compare these sets, and their answers contain the names. A code is made from the sets' values only,
so that it identifies no participant once the results are deleted in which values and id are together. Labels are for
people who refer to renderings without knowing their parameters.
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
    """Code of a participant's `values`: "s" and 8 hex digits of their hash as JSON. If a code in `taken` has the same
    digits, a number is appended ("-2", …)."""
    code = "s" + digest_of(json.dumps(values, sort_keys=True).encode())[:8]
    again = sum(other.partition("-")[0] == code for other in taken)
    return f"{code}-{again + 1}" if again else code


def label_of(values: Mapping[str, Any], session: str) -> str:
    """Label of a rendering (parameter -> value): three letters and two digits from a hash, which are independent of the
    values.

    Equal renderings have equal labels within a `session`, and other labels in another one.
    """
    number = int(digest_of(json.dumps([session, sorted(values.items())]).encode()), 16)
    letters = ""
    for _ in range(3):
        number, letter = divmod(number, len(_LETTERS))
        letters += _LETTERS[letter]
    return f"{letters}-{number % 100:02d}"


def set_codes(sets: Mapping[str, Sets]) -> dict[str, str]:
    """Participant -> code, for all participants in the names of sets. `sets`: material -> name -> parameters."""
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
    """Name of a set with the participant's id replaced by their code; names of the population's sets are unchanged.
    `codes`: of every participant, by id; raises `KeyError` for another one."""
    person = _person(name)
    if not person:
        return name
    return OWN + codes[person] if name.startswith(OWN) else codes[person] + name.removeprefix(person)


def _person(name: str) -> str:
    """Participant in the name of a set, `individual:PARTICIPANT` or `PARTICIPANT ROLE`; "" for sets of the
    population."""
    if name.startswith(OWN):
        return name.removeprefix(OWN)
    before, _, role = name.rpartition(" ")
    return before if role in ROLES else ""
