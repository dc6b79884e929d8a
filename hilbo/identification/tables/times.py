"""Times of the rows: in order, and equal only where they were rounded.

A program that writes times to 0.01 s gives rows of a faster recording equal times. Such rows are replaced by their
mean: its time, like that of each row, is within half a step of the written one, and the mean of curves that are
straight over a step belongs to the mean of their times. Nothing is spread over the step, which the file does not tell.
"""

import re

import numpy as np
import pandas as pd

from hilbo.errors import InputError
from hilbo.study.formats.csv_file import place

__all__ = ["with_distinct_times"]

_NUMBER = re.compile(r"[-+]?\d*[.,]?(\d*)(?:[eE]([-+]?\d+))?")
_STEPS = 2.0  # of the last digit: largest distance of equal times to the next one
_SLACK = 1e-9


def with_distinct_times(
    table: pd.DataFrame, cells: pd.Series, factor: float, source: str
) -> tuple[pd.DataFrame, float]:
    """Average the rows of equal times; the second value is the step (s) to which these are written, 0 for none.

    `table`: rows of one repeat, with `time` in s, indexed by line; `cells`: the times as written, with the same index;
    `factor` of their unit to s. A table without equal times is returned as it is. Raises `InputError` for times that
    fall, and for equal times that rounding does not explain.
    """
    time = table["time"].to_numpy()
    steps = np.diff(time)
    if np.any(steps < 0):
        row = int(np.argmax(steps < 0)) + 1
        raise InputError(
            f"{place(source, table.index[row])}time does not increase from the row before ({cells.iloc[row].strip()}"
            f" after {cells.iloc[row - 1].strip()}); sort the rows of each repeat, and number repeats that follow one"
            ' another in a column "repeat".'
        )
    if not np.any(steps == 0):
        return table, 0.0
    starts = np.flatnonzero(np.r_[True, steps > 0])
    coarsest = 0.0
    for k in np.flatnonzero(np.diff(np.r_[starts, time.size]) > 1).tolist():
        near = [starts[j] for j in (k - 1, k + 1) if 0 <= j < starts.size]
        last = factor * min(_last_digit(cells.iloc[row]) for row in (starts[k], *near))
        distance = min((abs(time[row] - time[starts[k]]) for row in near), default=np.inf)
        if not distance <= _STEPS * last * (1 + _SLACK):
            row = int(starts[k]) + 1
            raise InputError(
                f"{place(source, table.index[row])}time is {cells.iloc[row].strip()} as in the row before, which"
                f" rounding does not explain, since times are written to {last:g} s; delete one of the two rows, or"
                ' number repeats in a column "repeat".'
            )
        coarsest = max(coarsest, last)
    groups = np.repeat(np.arange(starts.size), np.diff(np.r_[starts, time.size]))
    means = table.groupby(groups).mean().set_axis(table.index[starts])
    means["time"] = time[starts]
    return means, coarsest


def _last_digit(cell: str) -> float:
    """Value of one unit in the last digit of a number as written: 0.01 for 3.20, 10 for 1.2e2; 0 for no number."""
    match = _NUMBER.fullmatch(cell.strip())
    if match is None:
        return 0.0
    return 10.0 ** (int(match[2] or 0) - len(match[1]))
