"""Recorded tests as numbers: their force and position, lines through and between their rows, lengths of transforms."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from hilbo.identification.fitting import Test

__all__ = [
    "AROUND",
    "between",
    "circle",
    "local_line",
    "position_driven",
    "secant",
    "transform_length",
    "unit_of_force",
]

AROUND = 3  # rows before and after one that belong to it


def local_line(values: Float[np.ndarray, "R m"], chosen: Bool[np.ndarray, " m"]) -> Float[np.ndarray, "R m"]:
    """Each row's place on the line through the chosen rows among it and three on both sides.

    Where fewer than two are chosen, the row itself. `values` (R, m) at even times, `chosen` (m,) -> (R, m).
    """
    offsets = np.arange(-AROUND, AROUND + 1.0)
    among = chosen.astype(values.dtype)

    def moment(row, power):
        return np.convolve(row, (offsets**power)[::-1], "same")

    count, first, second = (moment(among, power) for power in range(3))
    size = count * second - first**2
    line = np.stack([second * moment(among * row, 0) - first * moment(among * row, 1) for row in values])
    return np.where(size > 0.5, line / np.maximum(size, 0.5), values)


def _force_and_position(test: Test) -> tuple[Any, Any]:
    """Both (R, m), whichever was applied."""
    return (test.output, test.input) if test.kind == "relaxation" else (test.input, test.output)


def position_driven(test: Test) -> Test:
    """The test with force as its output."""
    force, position = _force_and_position(test)
    return Test("relaxation", test.time, force, position, test.start)


def between(
    grid: Float[np.ndarray, " n"], time: Float[np.ndarray, " m"], rows: Float[np.ndarray, "R m"], smooth: bool
) -> Float[np.ndarray, "R n"]:
    """The rows at the times of the grid; after the last row they stay."""
    if not smooth:
        return np.stack([np.interp(grid, time, row) for row in rows])
    from scipy.interpolate import PchipInterpolator

    return PchipInterpolator(time, rows, axis=1)(np.minimum(grid, time[-1]))


def unit_of_force(test: Test) -> float:
    """Factor from the scale of the output to one of force: for positions the mean stiffness, N/mm."""
    force, position = _force_and_position(test)
    return float(np.mean(np.abs(force)) / np.mean(np.abs(position))) if test.kind == "creep" else 1.0


def secant(test: Test) -> float:
    """Largest force over largest position, N/mm."""
    force, position = _force_and_position(test)
    return float(np.max(np.abs(force)) / np.max(np.abs(position)))


def transform_length(count: int) -> int:
    """A length that transforms fast, at least three times as long as the data."""
    from scipy.fft import next_fast_len

    return 2 * next_fast_len((3 * count + 1) // 2)


def circle(length: int, dtype: Any) -> float:
    """Radius of the circle on which `length` points damp what wraps around to eps^0.8."""
    return float(np.finfo(dtype).eps ** (-0.8 / length))
