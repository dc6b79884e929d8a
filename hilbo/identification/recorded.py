"""Helpers for recorded tests: force and position, local lines, interpolation between rows, and FFT lengths."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from hilbo.identification.fitting import Test

__all__ = [
    "AROUND",
    "damping_radius",
    "hold_at_end",
    "interpolated",
    "local_line",
    "lost_contact",
    "position_driven",
    "secant",
    "transform_length",
    "unit_of_force",
]

AROUND = 3  # half-width (rows) of the local line
_HELD, _FEWEST_HELD = 0.02, 4
_GAP = 1.5  # median time steps, above which a step is a gap


def local_line(values: Float[np.ndarray, "R m"], chosen: Bool[np.ndarray, " m"]) -> Float[np.ndarray, "R m"]:
    """Smooth each repeat: fit a line to the `chosen` rows among each row and the three on either side of it.

    Where fewer than two of these are chosen, the value stays. `values` (R, m) at even times, `chosen` (m,) -> (R, m).
    """
    offsets = np.arange(-AROUND, AROUND + 1.0)
    among = chosen.astype(values.dtype)

    def moment(row, power):
        return np.convolve(row, (offsets**power)[::-1], "same")

    count, first, second = (moment(among, power) for power in range(3))
    determinant = count * second - first**2
    line = np.stack([second * moment(among * row, 0) - first * moment(among * row, 1) for row in values])
    return np.where(determinant > 0.5, line / np.maximum(determinant, 0.5), values)


def _force_and_position(test: Test) -> tuple[Any, Any]:
    """Force and position of a recorded test, (R, m) each, whichever was applied."""
    return (test.output, test.input) if test.kind == "relaxation" else (test.input, test.output)


def position_driven(test: Test) -> Test:
    """The same recording as a relaxation test, with position as its input and force as its output. It ends where
    contact was lost: from there on the position is not that of the material's surface."""
    force, position = _force_and_position(test)
    lost = lost_contact(test)
    rows = slice(None) if lost is None else slice(lost)
    return Test("relaxation", test.time[rows], force[:, rows], position[:, rows], test.start)


def lost_contact(test: Test) -> int | None:
    """Index of the first row without contact, before the first gap in the rows of a test after contact in which the
    force is 0, as `hilbo.identification.motor.pressing` leaves rows out; None without such a gap."""
    force, step = _force_and_position(test)[0], np.diff(test.time)
    none = np.all(force == 0, axis=0)
    gaps = np.flatnonzero((step > _GAP * np.median(step)) & none[:-1] & none[1:] & np.logical_or.accumulate(~none)[:-1])
    return None if gaps.size == 0 else int(np.flatnonzero(~none[: gaps[0]])[-1]) + 1


def interpolated(
    grid: Float[np.ndarray, " n"], time: Float[np.ndarray, " m"], rows: Float[np.ndarray, "R m"], smooth: bool
) -> Float[np.ndarray, "R n"]:
    """Interpolate `rows`, sampled at `time`, to the times of `grid`: linearly, or by a monotone cubic if `smooth`.

    Beyond the last row the values stay constant. -> (R, n).
    """
    if not smooth:
        return np.stack([np.interp(grid, time, row) for row in rows])
    from scipy.interpolate import PchipInterpolator

    return PchipInterpolator(time, rows, axis=1)(np.minimum(grid, time[-1]))


def unit_of_force(test: Test) -> float:
    """Factor that converts a scale of the output to one of force: for creep the mean stiffness (N/mm), else 1."""
    force, position = _force_and_position(test)
    return float(np.mean(np.abs(force)) / np.mean(np.abs(position))) if test.kind == "creep" else 1.0


def secant(test: Test) -> float:
    """Secant stiffness: largest force / largest position, N/mm."""
    force, position = _force_and_position(test)
    return float(np.max(np.abs(force)) / np.max(np.abs(position)))


def hold_at_end(test: Test) -> slice | None:
    """The last rows of a recorded test, over which its input differs from the last one by 2 % of its largest at most;
    None if there are fewer than four."""
    applied = test.input.mean(axis=0) if test.input is not None else np.zeros(0)
    if not applied.size:
        return None
    away = np.flatnonzero(np.abs(applied - applied[-1]) > _HELD * np.max(np.abs(applied)))
    start = int(away[-1]) + 1 if away.size else 0
    return slice(start, None) if applied.size - start >= _FEWEST_HELD else None


def transform_length(count: int) -> int:
    """FFT length for `count` samples: even, at least three times as long, and fast to transform."""
    from scipy.fft import next_fast_len

    return 2 * next_fast_len((3 * count + 1) // 2)


def damping_radius(length: int, dtype: Any) -> float:
    """Radius of the circle for `length`-point damped FFTs that reduces wrap-around to eps^0.8."""
    return float(np.finfo(dtype).eps ** (-0.8 / length))
