"""Choice of the memory length: the same tests are fitted with each number of taps, and with full memory.

Parameters depend on N, so each row has its own. The paper takes the smallest N whose error is below 4 % on both tests;
its own errors at N = 101 are 3.92 % (creep with recovery) and 0.32 % (relaxation).
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
    """Fit with one memory length: `N` taps, or full memory if N is None; `nrmse` by kind of test."""

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
    """Fit the tests with each memory length in `choices`: number of taps, None for full memory; rows in that order.

    `T` (s); `lag` (s) and `corner` (Hz) of the force channel stay fixed. Raises `InputError` for no choices, and as
    `fit`.
    """
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
    """Row with the fewest taps (not full memory) whose NRMSE is below `limit` for every test; None if there is none."""
    good = [row for row in rows if row.N is not None and max(row.nrmse.values()) < limit]
    return min(good, key=lambda row: row.N or np.inf, default=None)
