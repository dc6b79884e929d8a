"""How much memory a rendering needs: the same tests fitted anew with every number of taps, and with full memory.

Parameters belong to their N: each row has its own. The paper takes the smallest N whose error is below 4 % on both
tests; its own errors at N = 101 are 3.92 % (creep with recovery) and 0.32 % (relaxation).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hilbo.errors import InputError
from hilbo.identification.fitting import Fit, Test, fit, nrmse
from hilbo.identification.sampled import Sampled

__all__ = ["CHOICES", "LIMIT", "PAPER", "Row", "select_memory", "smallest"]

CHOICES: tuple[int | None, ...] = (2, 25, 101, 201, 1000, None)
"""Numbers of taps that are tried; None is full memory."""
LIMIT = 0.04
PAPER = {"creep": 0.0392, "relaxation": 0.0032}


class Row(NamedTuple):
    """The fit with one memory: `N` taps, or full memory where N is None."""

    N: int | None
    fit: Fit
    nrmse: dict[str, float]


def select_memory(
    tests: Sequence[Test],
    T: float = 1e-3,
    choices: Sequence[int | None] = CHOICES,
    lag: float = 0.0,
    corner: float = np.inf,
) -> tuple[Row, ...]:
    """Fit the tests with each memory; `lag` (s) and `corner` (Hz) of the force channel are those of `sampled`."""
    if not choices:
        raise InputError("There is no number of taps to choose from.")
    rows = []
    for N in choices:
        full = N is None
        model = Sampled(T=T, memory="full", lag=lag, corner=corner) if full else Sampled(N, T, lag=lag, corner=corner)
        best_fit = fit(tests, model)
        rows.append(Row(N, best_fit, nrmse(best_fit)))
    return tuple(rows)


def smallest(rows: Sequence[Row], limit: float = LIMIT) -> Row | None:
    """The row with the fewest taps whose errors are all below the limit; None if there is none (but full memory)."""
    good = [row for row in rows if row.N is not None and max(row.nrmse.values()) < limit]
    return min(good, key=lambda row: row.N or np.inf, default=None)
