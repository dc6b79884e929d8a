"""How a recorded test begins and which signs it has: offsets of one channel, and channels that oppose each other."""

import numpy as np
from jaxtyping import Float

__all__ = ["correlation", "off_zero", "untared"]

_OFF_ZERO, _MOVED = 0.03, 0.2  # of a curve's range


def untared(put: Float[np.ndarray, " m"], out: Float[np.ndarray, " m"]) -> str | None:
    """Which has an offset, "input" or "output": its first row is not 0, although the other's is. (m,) each.

    A step in the first row itself looks alike, but there the other one moves while this one stays.
    """
    name = off_zero(put, out)
    held, other = (put, out) if name == "input" else (out, put)
    leaves = np.abs(held - held[0]) > max(0.05, 4 * _jitter(held)) * np.ptp(held)
    before = int(np.argmax(leaves)) if leaves.any() else held.size
    return name if np.ptp(other[:before]) <= _MOVED * np.ptp(other) else None


def off_zero(put: Float[np.ndarray, " m"], out: Float[np.ndarray, " m"]) -> str | None:
    """Which, "input" or "output", is clearly not 0 in the first row, where the other one is."""
    for name, one, other in (("input", put, out), ("output", out, put)):
        height = _height(one)
        zero = _height(other) <= max(0.1 * min(height, 1.0), 2 * _jitter(other))
        if zero and height > max(_OFF_ZERO, 6 * _jitter(one)):
            return name
    return None


def _height(values: Float[np.ndarray, " m"]) -> float:
    """The first of the values, over their range."""
    first, width = abs(values[0]), np.ptp(values)
    return float(first / width) if width > 0 else np.inf if first > 0 else 0.0


def _jitter(values: Float[np.ndarray, " m"]) -> float:
    """Standard deviation of the noise from row to row, over the range of the values."""
    second = np.abs(np.diff(values, 2))  # has the variance of six samples
    return float(1.4826 * np.median(second) / np.sqrt(6) / (np.ptp(values) or np.inf))


def correlation(time: Float[np.ndarray, " m"], put: Float[np.ndarray, " m"], out: Float[np.ndarray, " m"]) -> float:
    """Of two curves about 0, over the time; nan where one of them is 0.

    A storage modulus is above 0 at every frequency, and so is this of whatever a material can do from rest.
    """
    both, ones, others = (np.trapezoid(product, time) for product in (put * out, put * put, out * out))
    return float(both / np.sqrt(ones * others)) if ones * others > 0 else np.nan
