"""Random changes of exports, as spreadsheets, people and programs make them, for tests of `hilbo import`."""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pandas as pd

Frame = pd.DataFrame
Change = Callable[[Frame, np.random.Generator], Frame]
_MARKS = ("", "NA", "-1", "N/A", "null", "don't know", "nan", "-99", ".")


def _some(frame: Frame, rng: np.random.Generator) -> np.ndarray:
    """Boolean mask of some of the rows: one, a few, or all."""
    share = rng.choice([1.5 / len(frame), 0.2, 1.0])
    mask = rng.random(len(frame)) < share
    mask[rng.integers(len(frame))] = True
    return mask


def _cells(column: str, change: Callable[[str], str]) -> Change:
    """A change of some cells of a column."""

    def changed(frame: Frame, rng: np.random.Generator) -> Frame:
        mask = _some(frame, rng)
        cells = [change(cell) if hit else cell for cell, hit in zip(frame[column], mask, strict=True)]
        return frame.assign(**{column: cells})

    return changed


def _missing(column: str) -> Change:
    """Missing marks in some cells of a column."""

    def changed(frame: Frame, rng: np.random.Generator) -> Frame:
        return _cells(column, lambda cell: str(rng.choice(_MARKS)))(frame, rng)

    return changed


def _random_text(column: str, texts: tuple[str, ...]) -> Change:
    """Other texts in some cells of a column."""
    return lambda frame, rng: _cells(column, lambda cell: str(rng.choice(texts)))(frame, rng)


def _renamed(frame: Frame, rng: np.random.Generator) -> Frame:
    """Another name of one column."""
    column = str(rng.choice(frame.columns))
    names = (column.upper(), f" {column}", f"{column}_x", f"{column}.1", column[:-1], "x", f"trial.{column}")
    return frame.rename(columns={column: str(rng.choice(names))})


def _dropped_column(frame: Frame, rng: np.random.Generator) -> Frame:
    """One column less."""
    return frame.drop(columns=str(rng.choice(frame.columns)))


def _doubled_column(frame: Frame, rng: np.random.Generator) -> Frame:
    """One column twice, the second with its cells in another order."""
    column = str(rng.choice(frame.columns))
    other = pd.DataFrame({column: rng.permutation(frame[column])}, index=frame.index)
    return pd.concat([frame, other] if rng.random() < 0.5 else [other, frame], axis=1)


def _rows(frame: Frame, rng: np.random.Generator) -> Frame:
    """Rows in another order, twice, or fewer of them."""
    kind = rng.integers(3)
    if kind == 0:
        return frame.iloc[rng.permutation(len(frame))]
    if kind == 1:
        return pd.concat([frame, frame[_some(frame, rng)]])
    return frame[~_some(frame, rng)]


def _merged_header(frame: Frame, rng: np.random.Generator) -> Frame:
    """The header once more as a row, as in files that were put one behind the other."""
    place = int(rng.integers(len(frame)))
    header = pd.DataFrame([{column: column for column in frame.columns}])
    return pd.concat([frame.iloc[:place], header, frame.iloc[place:]])


_HIDDEN = ("\u00a0{}", "{}\u200b", " {} ", "\ufeff{}", "{}\t")
CHANGES: Mapping[str, Change] = {
    "zeros dropped": _cells("participant", lambda cell: cell.replace("P0", "P")),
    "ids as numbers": _cells("participant", lambda cell: cell.removeprefix("P").lstrip("0")),
    "ids as floats": _cells("participant", lambda cell: f"{int(cell[1:])}.0"),
    "ids in small letters": _cells("participant", str.lower),
    "ids with exponents": _cells("participant", lambda cell: "9.45E+12"),
    "no ids": _missing("participant"),
    "commas in hue": _cells("hue", lambda cell: cell.replace(".", ",")),
    "commas in light": _cells("light", lambda cell: cell.replace(".", ",")),
    "thousands": _cells("hue", lambda cell: f"1,{cell}"),
    "exponents": _cells("hue", lambda cell: f"{float(cell):E}"),
    "units": _cells("hue", lambda cell: f"{cell} deg"),
    "other units": _cells("light", lambda cell: f"{cell} cd"),
    "no hue": _missing("hue"),
    "no response": _missing("response"),
    "capitals": _cells("response", str.upper),
    "hidden characters": lambda frame, rng: _cells("response", str(rng.choice(_HIDDEN)).format)(frame, rng),
    "other labels": _random_text("response", ("same", "4", "0", "1", "3", "closer", "differnt")),
    "trials from 0": _cells("trial", lambda cell: str(int(cell) - 1)),
    "trials as floats": _cells("trial", lambda cell: f"{cell}.0"),
    "trials missing": _missing("trial"),
    "renamed": _renamed,
    "column dropped": _dropped_column,
    "column doubled": _doubled_column,
    "columns in another order": lambda frame, rng: frame[list(rng.permutation(frame.columns))],
    "rows": _rows,
    "header within": _merged_header,
}
_ENCODINGS = ("utf-8", "utf-8-sig", "utf-16", "utf-16-le", "cp1252", "latin-1")


def written(frame: Frame, path: Path, rng: np.random.Generator) -> str:
    """Write a CSV file in a random dialect, now and then damaged; returns what was done."""
    separator = str(rng.choice([",", ";", "\t", "|"]))
    encoding = str(rng.choice(_ENCODINGS))
    text = frame.to_csv(index=False, sep=separator, quoting=int(rng.choice([0, 1])))
    kind = int(rng.integers(8))
    if kind == 0:
        place = int(rng.integers(len(text)))
        text = text[:place] + str(rng.choice(['"', "\n", separator, " "])) + text[place:]
    elif kind == 1:
        text = text[: int(rng.integers(len(text) // 2, len(text)))]
    elif kind == 2:
        text = f"sep={separator}\n{text}"
    path.write_bytes(text.encode(encoding, errors="replace"))
    return f"{separator!r}, {encoding}, damage {kind}"
