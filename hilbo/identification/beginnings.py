"""Checks of the start of a recorded test: an offset in one channel, and the correlation of the two channels."""

import numpy as np
from jaxtyping import Float

__all__ = ["correlation", "off_zero", "untared"]

_OFF_ZERO, _MOVED = 0.03, 0.2  # of a curve's range


def untared(applied: Float[np.ndarray, " m"], measured: Float[np.ndarray, " m"]) -> str | None:
    """Name the channel with an untared offset, "input" or "output"; None if there is none.

    That channel is clearly not 0 in its first row, while the other one is 0. A step in the first row looks the same,
    but there the other channel moves while this one stays constant. `applied` (the input), `measured` (the output):
    (m,) each, in any unit.
    """
    name = off_zero(applied, measured)
    suspect, other = (applied, measured) if name == "input" else (measured, applied)
    has_moved = np.abs(suspect - suspect[0]) > max(0.05, 4 * _jitter(suspect)) * np.ptp(suspect)
    first_moved = int(np.argmax(has_moved)) if has_moved.any() else suspect.size
    return name if np.ptp(other[:first_moved]) <= _MOVED * np.ptp(other) else None


def off_zero(applied: Float[np.ndarray, " m"], measured: Float[np.ndarray, " m"]) -> str | None:
    """Name the channel that is clearly not 0 in its first row while the other one is 0.

    "input" (`applied`) or "output" (`measured`), (m,) each in any unit; None if both or neither are 0.
    """
    for name, values, other in (("input", applied, measured), ("output", measured, applied)):
        height = _height(values)
        zero = _height(other) <= max(0.1 * min(height, 1.0), 2 * _jitter(other))
        if zero and height > max(_OFF_ZERO, 6 * _jitter(values)):
            return name
    return None


def _height(values: Float[np.ndarray, " m"]) -> float:
    """Absolute first value divided by the range of the values; for a constant inf, or 0 if it is 0."""
    first, width = abs(values[0]), np.ptp(values)
    return float(first / width) if width > 0 else np.inf if first > 0 else 0.0


def _jitter(values: Float[np.ndarray, " m"]) -> float:
    """Standard deviation of the row-to-row noise, divided by the range of the values (0 for a constant)."""
    second = np.abs(np.diff(values, 2))  # has the variance of six samples
    return float(1.4826 * np.median(second) / np.sqrt(6) / (np.ptp(values) or np.inf))


def correlation(
    time: Float[np.ndarray, " m"], applied: Float[np.ndarray, " m"], measured: Float[np.ndarray, " m"]
) -> float:
    """Correlation about 0 (not about the mean) of two curves over time; nan if one of them is 0 throughout.

    The storage modulus of any material is positive at every frequency, so this is positive for any motion from rest.
    `time` (m,) in s, increasing; the curves (m,) in any unit.
    """
    cross, applied_2, measured_2 = (
        np.trapezoid(product, time) for product in (applied * measured, applied * applied, measured * measured)
    )
    return float(cross / np.sqrt(applied_2 * measured_2)) if applied_2 * measured_2 > 0 else np.nan
