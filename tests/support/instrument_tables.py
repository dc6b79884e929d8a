"""One relaxation test as the programs of instruments write it: a corpus of material tables, made by code.

Formats are those of public samples (docs/methods/identification.md names them); the numbers are one simulated test.
`CASES` gives each file's bytes with what a user must state, or the words of its refusal and a remedy that follows them.
"""

from collections.abc import Callable, Sequence
from decimal import Decimal
from typing import NamedTuple

import numpy as np
from material import FOAM, force

from hilbo.identification.tables.layout import Layout

__all__ = ["AREA", "CASES", "GAP", "PLAIN", "Case", "plain"]

AREA, GAP = 400.0, 8.0  # mm², mm
GEOMETRY = Layout("relaxation", area=AREA, gap=GAP)
RELAXATION = Layout("relaxation")
Rows = list[list[str]]


class Case(NamedTuple):
    """A file: its bytes and the user's layout. `exact`: its numbers are those of `PLAIN`, else of another unit.
    `refused`: words of the refusal, "" for none; `remedy` then makes the bytes and the layout that are read."""

    data: bytes
    layout: Layout = RELAXATION
    exact: bool = True
    refused: str = ""
    remedy: Callable[["Case"], tuple[bytes, Layout]] | None = None


def samples() -> list[tuple[Decimal, Decimal, Decimal]]:
    """Time (s), position (mm) and force (N) in few decimals: a ramp of 30 ms to 4 mm, then a hold; every 10 ms."""
    t = np.arange(1200) * 1e-3
    x = 4 * np.minimum(t / 0.03, 1)
    F = force(FOAM, x)[::10] + 0.003 * np.random.default_rng(3).standard_normal(120)
    rounded = [(f"{a:.2f}", f"{b:.3f}", f"{c:.4f}") for a, b, c in zip(t[::10], x[::10], F, strict=True)]
    return [(Decimal(a), Decimal(b), Decimal(c)) for a, b, c in rounded]


SAMPLES = samples()


def column(quantity: str, factor: str = "1") -> list[str]:
    """The cells of a quantity, divided by the `factor` of its unit."""
    which = ("time", "position", "force").index(quantity)
    return [format((row[which] / Decimal(factor)).normalize(), "f") for row in SAMPLES]


def stress(factor: str = "1") -> list[str]:
    """Stress in Pa, divided by `factor`: force over the area."""
    return [format((c * 1_000_000 / Decimal(AREA) / Decimal(factor)).normalize(), "f") for _, _, c in SAMPLES]


def strain(factor: str = "1") -> list[str]:
    """Strain, divided by `factor`: position over the thickness."""
    return [format((b / Decimal(GAP) / Decimal(factor)).normalize(), "f") for _, b, _ in SAMPLES]


def plain(rows: Sequence[Sequence[object]] = SAMPLES, head: str = "test,time_s,position_mm,force_N") -> bytes:
    """The table as hilbo's own documents write it."""
    return "".join([head, "\n", *(f"relaxation,{','.join(map(str, row))}\n" for row in rows)]).encode()


PLAIN = plain()
TIME, POSITION, FORCE = column("time"), column("position"), column("force")
POINTS = [str(i + 1) for i in range(len(SAMPLES))]
BLANK = [""] * len(SAMPLES)


def text(rows: Sequence[Sequence[str]], delimiter: str = ",", comma: bool = False, quotes: bool = False) -> str:
    """Rows as lines; `comma`: with decimal commas; `quotes`: around every cell that is not empty."""
    marked = [[cell.replace(".", ",") if comma and is_number(cell) else cell for cell in row] for row in rows]
    marked = [[f'"{cell}"' if quotes and cell else cell for cell in row] for row in marked]
    return "".join(delimiter.join(row) + "\r\n" for row in marked)


def is_number(cell: str) -> bool:
    """Whether a cell is a number."""
    return cell.replace(".", "").replace("-", "").isdigit()


def across(*columns: Sequence[str]) -> Rows:
    """Columns as rows."""
    return [list(row) for row in zip(*columns, strict=True)]


def with_options(**options: object) -> Callable[[Case], tuple[bytes, Layout]]:
    """Remedy: the same file with these parts of the layout."""
    return lambda case: (case.data, case.layout._replace(**options))


def edited(old: bytes, new: bytes) -> Callable[[Case], tuple[bytes, Layout]]:
    """Remedy: the file with a text replaced."""
    return lambda case: (case.data.replace(old, new), case.layout)


# TA Instruments TRIOS: "Export to LIMS" has [step] blocks with labelled rows; the plain export has a title per step.
LIMS = [["Filename", "foam.txt"], ["Instrument name", "DHR-2"], ["operator", "a"], ["rundate", "3/2/2026"], [""]]
LIMS_STEP = [["[step]"], ["Stress relaxation - 2"], ["Number of points", str(len(SAMPLES))]]
LIMS_TABLE = [
    *(["Variables", "Step time", "Strain", "Stress", "Temperature"], ["", "s", "%", "Pa", "°C"]),
    *across([f"data point {i}" for i in POINTS], TIME, strain("0.01"), stress(), ["23.1"] * len(SAMPLES)),
]
CONDITIONING = [["[step]"], ["Conditioning - 1"], ["Variables", "Step time", "Strain", "Stress"], ["", "s", "%", "Pa"]]
CONDITIONING += [[f"data point {i}", str(i), "0", f"0.{i}"] for i in range(1, 6)] + [[""]]
TRIOS = [["foam"], ["Instrument type", "RSA-G2"], [""], ["Axial relaxation - 3"]]
TRIOS_TABLE = [["Step time", "Displacement", "Axial force", "Temperature"], ["s", "um", "N", "°C"]]
TRIOS_ROWS = across(TIME, column("position", "0.001"), FORCE, ["23.1"] * len(SAMPLES))
SWEEP = [["Frequency sweep - 1"], ["Storage modulus", "Loss modulus", "Angular frequency", "Step time"]]
SWEEP += [["Pa", "Pa", "rad/s", "s"], *([str(1000 + i), str(100 + i), str(i + 1), str(10 * i)] for i in range(9))]
# Anton Paar RheoCompass: intervals, a first column of labels, a blank row, and units in brackets; UTF-16 with tabs.
RHEO = [["Project:", "foam"], ["Test:", "E3"], [""], ["Result:", "Stress relaxation 1"], [""]]


def interval(number: int, names: Sequence[str], units: Sequence[str], rows: Rows) -> Rows:
    """An interval of RheoCompass."""
    top = [["Interval and data points:", str(number), str(len(rows))], ["Interval data:", "Point No.", *names]]
    return [
        *top,
        [""] * (len(names) + 2),
        ["", "", *units],
        *(["", str(i), *row] for i, row in enumerate(rows, 1)),
        [""],
    ]


SHEAR, SHEAR_UNITS = ("Time", "Shear Strain", "Shear Stress", "Status"), ("[s]", "[%]", "[Pa]", "")
SHEAR_ROWS = across(TIME, strain("0.01"), stress(), ["TruStrain™"] * len(SAMPLES))
ONE_INTERVAL = [*RHEO, *interval(1, SHEAR, SHEAR_UNITS, SHEAR_ROWS)]
REST = [[str(i), "0", "0.1", ""] for i in range(5)]
INTERVALS = [
    *(*RHEO, *interval(1, SHEAR, SHEAR_UNITS, REST), *interval(2, SHEAR, SHEAR_UNITS, SHEAR_ROWS[:10])),
    *interval(3, SHEAR, SHEAR_UNITS, SHEAR_ROWS[10:]),
]
# Instron Bluehill: quoted cells, units in brackets in the row below the names.
BLUEHILL = [["Time", "Extension", "Load"], ["(s)", "(mm)", "(kN)"], *across(TIME, POSITION, column("force", "1000"))]
RESULTS = [["Results Table 1"], ["", "Maximum Load", "Modulus"], ["", "(N)", "(MPa)"], ["1", "5.1", "0.02"], [""]]
COMPRESSIVE = [["Time", "Compressive extension", "Compressive load", "Compressive strain", "Compressive stress"]]
COMPRESSIVE += [["(s)", "(mm)", "(N)", "(%)", "(MPa)"], *across(TIME, POSITION, FORCE, strain("0.01"), stress("1e6"))]
# Stable Micro Systems TA.XT: names with units, force in grams; or names and units in two rows.
GRAMS = column("force", "0.00980665")
TAXT = [["Time (sec)", "Distance (mm)", "Force (g)"], *across(TIME, POSITION, GRAMS)]
TAXT_ROWS = [["foam1"], ["Force", "Distance", "Time"], ["kg", "mm", "sec"]]
TAXT_ROWS += across(column("force", "9.80665"), POSITION, TIME)
# ZwickRoell testXpert: quoted names and values of the test, then names and units in two rows; Windows-1252 with tabs.
ZWICK = [["Prüfinstitut", "Labor 1"], ["Datum/Uhrzeit", "44335.4"], ["Dicke", "8", "mm"]]
ZWICK_TABLE = [["Prüfzeit", "Standardkraft", "Traversenweg absolut", "Standardweg"], ["s", "N", "mm", "mm"]]
ZWICK_ROWS = across(TIME, FORCE, [str(Decimal(cell) + 100) for cell in POSITION], POSITION)
XPERT = [["Test time", "Standard force", "Standard travel"], ["s", "N", "mm"], *across(TIME, FORCE, POSITION)]
# Bose/TA ElectroForce WinTest: a first line that ends with NUL, quoted names and units, and a comma after each row.
WINTEST = [
    ["Scan  1", ""],
    ["foam", ""],
    ["Points ", "Elapsed Time ", "Disp ", "Load ", ""],
    ["", "Sec", "mm", "N", ""],
]
WINTEST_ROWS = across(POINTS, TIME, POSITION, FORCE, BLANK)
DMA = [["Time (min)", "Strain (%)", "Stress (MPa)"]]
DMA += across([f"{a / 60:.18f}" for a, _, _ in SAMPLES], strain("0.01"), stress("1e6"))
OTHER = [["Zeitpunkt", "Hub", "Last"], ["s", "mm", "N"], *across(TIME, POSITION, FORCE)]
THOUSANDS = [["time_s", "position_um", "force_N"], *across(TIME, column("position", "0.001"), FORCE)]

HALF = [(i // 2 * Decimal("0.01"), b, c) for i, (_, b, c) in enumerate(SAMPLES)]
"""The samples with a time to 0.01 s for every two rows, as a recording of 200 Hz."""

CASES: dict[str, Case] = {
    "plain": Case(PLAIN, Layout()),
    "plain, semicolons and commas": Case(
        text([["time_s", "position_mm", "force_N"], *across(TIME, POSITION, FORCE)], ";", True).encode()
    ),
    "plain, with an index": Case(
        text([["", "time_s", "position_mm", "force_N"], *across(POINTS, TIME, POSITION, FORCE)]).encode()
    ),
    "plain, other units": Case(
        text(
            [
                ["time [min]", "x [m]", "F [mN]"],
                *across(
                    [f"{a / 60:.18f}" for a, _, _ in SAMPLES], column("position", "1000"), column("force", "0.001")
                ),
            ]
        ).encode(),
        exact=False,
    ),
    "TRIOS for LIMS": Case(text([*LIMS, *LIMS_STEP, *LIMS_TABLE], "\t").encode("utf-8"), GEOMETRY, False),
    "TRIOS for LIMS, two steps": Case(
        text([*LIMS, *CONDITIONING, *LIMS_STEP, *LIMS_TABLE], "\t").encode("utf-8"),
        *(GEOMETRY, False, 'contains 2 blocks .1: ".step., Conditioning - 1", line 8, 5 rows; 2: "Stress relaxation'),
        with_options(blocks=(2,)),
    ),
    "TRIOS without the geometry": Case(
        text([*LIMS, *LIMS_STEP, *LIMS_TABLE], "\t").encode("utf-8"),
        *(RELAXATION, False, "give its area in mm2 by --area and its thickness in mm by --gap"),
        with_options(area=AREA, gap=GAP),
    ),
    "TRIOS, force and displacement": Case(
        text([*TRIOS, *TRIOS_TABLE, *TRIOS_ROWS], "\t").encode("cp1252"), exact=False
    ),
    "TRIOS, after a frequency sweep": Case(
        text([*TRIOS[:2], *SWEEP, [""], TRIOS[3], *TRIOS_TABLE, *TRIOS_ROWS], "\t").encode("cp1252"),
        *(RELAXATION, False, "oscillation; 2:"),
        with_options(blocks=(2,)),
    ),
    "RheoCompass": Case(text(ONE_INTERVAL, "\t").encode("utf-16"), GEOMETRY, False),
    "RheoCompass, commas": Case(text(ONE_INTERVAL, "\t", True).encode("utf-16"), GEOMETRY, False),
    "RheoCompass, intervals": Case(
        text(INTERVALS, ",").encode("utf-8-sig"),
        *(GEOMETRY, False, "contains 3 blocks"),
        with_options(blocks=(2, 3)),
    ),
    "Bluehill": Case(text(BLUEHILL, quotes=True).encode(), exact=False),
    "Bluehill, results first": Case(text([*RESULTS, *COMPRESSIVE], quotes=True).encode()),
    "Bluehill, semicolons and commas": Case(text([*RESULTS, *COMPRESSIVE], ";", True, True).encode("cp1252")),
    "Bluehill, tension positive": Case(
        text([*COMPRESSIVE[:2], *([a, b, f"-{c}", d, e] for a, b, c, d, e in COMPRESSIVE[2:])]).encode(),
        refused="opposite signs",
        remedy=with_options(columns=("force=-Compressive load",)),
    ),
    "TA.XT": Case(text(TAXT).encode(), exact=False),
    "TA.XT, two rows": Case(text(TAXT_ROWS, "\t").encode("cp1252"), exact=False),
    "testXpert": Case(
        text([*ZWICK, *ZWICK_TABLE, *ZWICK_ROWS], "\t", quotes=True).encode("cp1252"),
        refused='"Traversenweg absolut \\[mm\\]" and "Standardweg \\[mm\\]" both are a position; keep one, or choose',
        remedy=with_options(columns=("position=Standardweg",)),
    ),
    "testXpert, English": Case(text(XPERT, ";", True).encode()),
    "WinTest": Case(text([*WINTEST, *WINTEST_ROWS], quotes=True).replace("\r\n", "\x00\r\n", 1).encode()),
    "DMA": Case(text(DMA, "\t").encode(), GEOMETRY, False),
    "unknown names": Case(
        text(OTHER, ";", True).encode("cp1252"),
        refused='found none of them among the columns "Zeitpunkt .s.", "Hub .mm.", "Last .N.": name .* by --column',
        remedy=with_options(columns=("time_s=Zeitpunkt", "position_mm=Hub", "force_N=Last")),
    ),
    "no header": Case(
        text(across(TIME, POSITION, FORCE)).encode(),
        refused=":1: is a row of numbers; write a header above it, such as time_s,position_mm,force_N",
        remedy=lambda case: (b"time_s,position_mm,force_N\r\n" + case.data, case.layout),
    ),
    "no kind of test": Case(
        text(XPERT, "\t").encode(), Layout(), refused="give --test relaxation", remedy=with_options(test="relaxation")
    ),
    "no unit": Case(
        text([["Time (s)", "Disp", "Load (N)"], *across(TIME, POSITION, FORCE)]).encode(),
        refused='column "Disp" has no unit; .* or give --column "position_mm=Disp"',
        remedy=with_options(columns=("position_mm=Disp",)),
    ),
    "two decimal marks": Case(
        text(THOUSANDS, ";", True).replace(";2667;", ";2.667;").encode(),
        exact=False,
        refused="has decimal commas and decimal points",
        remedy=edited(b".", b""),
    ),
    "an oscillation": Case(
        text(SWEEP, "\t").encode(),
        refused="is an oscillatory test .storage and loss modulus.; hilbo identify needs a test in time",
    ),
}
