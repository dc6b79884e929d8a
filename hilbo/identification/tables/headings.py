"""Headings of columns: names and units of the quantities, as material tables and instruments write them.

A heading is a name with its unit: `time_s`, `time (ms)`, `time [s]`, `Kraft / N`, `Force, N`. Names are compared
without capitals, and with blanks for underscores. A name of two quantities (deformation) is told by its unit.
"""

import functools
import re
import unicodedata
from typing import NamedTuple

__all__ = ["AS_FORCE", "FOREIGN", "UNITS", "Heading", "first_unit", "heading", "is_unit", "unit_of", "without_unit"]

_OWN = {
    "time": ("time", "t"),
    "position": ("position", "displacement", "deformation", "indentation", "x"),
    "force": ("force", "f"),
    "modulus": ("modulus", "relaxation modulus", "g"),
    "compliance": ("compliance", "creep compliance", "j"),
}
_OF_INSTRUMENTS = {
    "time": ("elapsed time", "test time", "total time", "zeit", "prüfzeit", "pruefzeit", "testzeit"),
    "step time": ("step time", "interval time", "segment time"),
    "position": (
        *("extension", "compressive extension", "tensile extension", "distance", "disp", "axial disp"),
        *("axial displacement", "crosshead", "crosshead travel", "standard travel", "travel", "weg", "standardweg"),
        *("traversenweg", "traversenweg absolut", "verformung", "dehnung"),
    ),
    "force": (
        *("load", "axial load", "axial force", "compressive load", "tensile load", "standard force"),
        *("kraft", "standardkraft", "prüfkraft", "pruefkraft"),
    ),
    "strain": (
        *("strain", "shear strain", "compressive strain", "tensile strain", "axial strain", "engineering strain"),
        *("deformation", "verformung", "dehnung", "stauchung"),
    ),
    "stress": (
        *("stress", "shear stress", "compressive stress", "tensile stress", "axial stress", "engineering stress"),
        *("spannung", "druckspannung", "schubspannung", "zugspannung"),
    ),
    "modulus": ("g(t)", "e(t)", "modulus g(t)", "modulus e(t)", "shear relaxation modulus", "relaxationsmodul"),
    "compliance": ("j(t)", "d(t)", "compliance j(t)", "shear compliance", "kriechnachgiebigkeit"),
    "oscillation": ("storage modulus", "loss modulus", "g'", "g''", 'g"', "e'", "e''", 'e"', "speichermodul"),
}
# Factor to the first unit of each line.
UNITS = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0, "h": 3600.0},
    "position": {"mm": 1.0, "um": 1e-3, "cm": 10.0, "m": 1000.0, "in": 25.4},
    "force": {"N": 1.0, "mN": 1e-3, "kN": 1000.0, "gf": 9.80665e-3, "kgf": 9.80665, "lbf": 4.4482216152605},
    "stress": {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "N/mm2": 1e6, "psi": 6894.757293168361},
    "strain": {"-": 1.0, "%": 0.01},
    "modulus": {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9, "N/mm": 1.0, "N/m": 1e-3},
    "compliance": {"1/Pa": 1.0, "1/kPa": 1e-3, "1/MPa": 1e-6, "1/GPa": 1e-9, "mm/N": 1.0, "m/N": 1e3},
}
UNITS["step time"] = UNITS["time"]
UNITS["oscillation"] = dict.fromkeys(("Pa", "kPa", "MPa", "GPa"), 1.0)
AS_FORCE = {"g": "gf", "kg": "kgf", "lb": "lbf"}
"""Units of mass that instruments give to a force, and the unit of force that is meant."""
FOREIGN = frozenset({"rad", "mrad", "deg", "°", "°C", "degC", "K", "Hz", "rad/s", "1/s", "V", "mV", "N.m", "mN.m"})
"""Units of other quantities: a column with one of these is not what its name says."""
_SAME = {
    **dict.fromkeys(("S", "sec", "Sec", "secs", "second", "seconds", "sek", "Sek"), "s"),
    **dict.fromkeys(("msec", "millisec"), "ms"),
    **dict.fromkeys(("minute", "minutes", "Min"), "min"),
    **dict.fromkeys(("1", "mm/mm", "m/m"), "-"),
    **dict.fromkeys(("inch", "inches"), "in"),
    **{"percent": "%", "Newton": "N", "N/mm^2": "N/mm2"},
}
_LETTERS = str.maketrans({"µ": "u", "μ": "u", "²": "2", "⋅": ".", "·": "."})
_BRACKETS = re.compile(r"(.*?)[\s,_]*[\[(]([^\[\]()]*)[\])]\s*")
_AFTER = (r"(.*)_([^_]*)", r"(.*?)\s+/\s+(.*)", r"(.*),\s*(.*)", r"(.*?)\s+in\s+(.*)")


class Heading(NamedTuple):
    """A column that may hold a quantity: its name in the table, that name without unit, quantity, unit ("" without
    one), and factor -1 to turn its sign, else 1."""

    column: str
    name: str
    quantity: str
    unit: str
    sign: float = 1.0

    @property
    def short(self) -> bool:
        """Whether the name is a single letter, which may stand for another quantity."""
        return len(self.name) == 1

    @property
    def own(self) -> bool:
        """Whether the name is one of hilbo's, not of an instrument."""
        return _plain(self.name) in _OWN.get(self.quantity, ())

    @property
    def usable(self) -> bool:
        """Whether the unit is a known unit of the quantity; False without a unit."""
        return self.unit in UNITS[self.quantity] or self.of_mass

    @property
    def of_mass(self) -> bool:
        """Whether the unit is one of mass that stands for a force."""
        return self.quantity == "force" and self.unit in AS_FORCE

    @property
    def factor(self) -> float:
        """Factor of the values to the first unit of the quantity, with the sign."""
        return self.sign * UNITS[self.quantity][AS_FORCE[self.unit] if self.of_mass else self.unit]


def heading(column: str) -> Heading | None:
    """The quantity and unit of a column by its name, unit "" without one; None if it names no quantity, or has a unit
    of another kind, such as rad."""
    parts = _parts(column)
    if parts is None or parts[2] in FOREIGN:
        return None
    name, quantities, unit = parts
    quantity = next((q for q in quantities if unit in UNITS[q] or (q == "force" and unit in AS_FORCE)), quantities[0])
    return Heading(column, name, quantity, unit)


def first_unit(quantity: str) -> str:
    """The first of the units of a quantity, as an example."""
    return next(iter(UNITS[quantity]))


def is_unit(text: str) -> bool:
    """Whether a text is a unit of any quantity."""
    unit = unit_of(text)
    return unit in AS_FORCE or unit in FOREIGN or any(unit in units for units in UNITS.values())


def unit_of(text: str) -> str:
    """A unit in the spelling of `UNITS`, without brackets around it; unknown ones as they are."""
    text = re.sub(r"\s*([\[(])(.*)[\])]\s*", r"\2", text).strip().translate(_LETTERS)
    return _SAME.get(text, text)


def without_unit(column: str) -> tuple[str, str]:
    """Name and unit of any column, by brackets at its end or as `heading` reads it; ("...", "") without a unit."""
    parts = _parts(column)
    if parts is not None:
        return parts[0], parts[2]
    match = _BRACKETS.fullmatch(column)
    return (match[1].strip(), unit_of(match[2])) if match else (column.strip(), "")


@functools.lru_cache(4096)
def _parts(column: str) -> tuple[str, tuple[str, ...], str] | None:
    """Name, possible quantities and unit of a column; None if it has no known name."""
    column = column.strip()
    if quantities := _QUANTITIES.get(_plain(column)):
        return column, quantities, ""
    matches = [_BRACKETS.fullmatch(column), *(re.fullmatch(pattern, column) for pattern in _AFTER)]
    blank = re.fullmatch(r"(.*)\s+(\S+)", column)  # a word after a blank may be of the name: only a known unit counts
    matches += [blank] if blank and is_unit(blank[2]) and not blank[2].isdecimal() else []
    for match in filter(None, matches):
        if quantities := _QUANTITIES.get(_plain(match[1])):
            return match[1].strip(), quantities, unit_of(match[2])
    return None


def _plain(name: str) -> str:
    """A name for comparison: no capitals, one blank for blanks and underscores."""
    return re.sub(r"[\s_]+", " ", unicodedata.normalize("NFC", name)).strip(" :").lower()


def _by_name() -> dict[str, tuple[str, ...]]:
    """The quantities that each name may stand for, hilbo's own first."""
    names: dict[str, tuple[str, ...]] = {}
    for table in (_OWN, _OF_INSTRUMENTS):
        for quantity, spellings in table.items():
            for name in spellings:
                names[name] = (*names.get(name, ()), quantity)
    return names


_QUANTITIES = _by_name()
