"""Sets tables: a CSV file with one named parameter set in each row, for `hilbo device`.

Columns: set_id (its name), K1, B1, alpha, and optionally K0, N, T, memory, states, force_limit; others are kept out.
Without K0 it follows from the effective stiffness. Units: N/mm, N·s^α/mm, s, N.
"""

import csv
import os
from typing import Any

from hilbo.errors import InputError

__all__ = ["NUMBERS", "read_sets"]

NUMBERS = ("K0", "K1", "B1", "alpha", "T", "force_limit")
_WHOLE = ("N", "states")
_NEEDED = ("set_id", "K1", "B1", "alpha")


def read_sets(path: str | os.PathLike) -> dict[str, dict[str, Any]]:
    """Each set's name and values, in the order of the file. Raises `InputError`."""
    source = str(path)
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            rows = [(reader.line_num, row) for row in reader]
            columns = [name.strip() for name in reader.fieldnames or ()]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{source}: cannot be read ({error}); a sets table is a CSV file.") from error
    missing = [name for name in _NEEDED if name not in columns]
    if missing:
        raise InputError(f'{source}:1: column "{missing[0]}" is missing; a sets table has {", ".join(_NEEDED)}.')
    if not rows:
        raise InputError(f"{source}: has no sets; write one in each row.")
    found: dict[str, dict[str, Any]] = {}
    for line, row in rows:
        cells = {(name or "").strip(): (value or "").strip() for name, value in row.items() if isinstance(value, str)}
        name = cells["set_id"]
        if not name or name in found:
            raise InputError(
                f'{source}:{line}: set_id "{name}" is empty or used before; each set has a name of its own.'
            )
        found[name] = _values(cells, f"{source}:{line}")
    return found


def _values(cells, place) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for names, kind, words in ((NUMBERS, float, "a number"), (_WHOLE, int, "a whole number")):
        for name in names:
            text = cells.get(name, "")
            if not text and name not in _NEEDED:
                continue
            try:
                found[name] = kind(text)
            except ValueError:
                raise InputError(f'{place}: {name} is "{text}", it must be {words}.') from None
    return found | ({"memory": cells["memory"]} if cells.get("memory") else {})
