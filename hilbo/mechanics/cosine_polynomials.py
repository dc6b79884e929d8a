"""Cosine polynomials p(θ) = Σ p_j cos jθ: values, Taylor terms at many angles, and rigorous lower bounds.

Around each angle Taylor's formula, with a remainder from the size of the coefficients, bounds p'' from below on a cell,
and so p by a parabola. Near the minimum of p the cells shrink in proportion to their distance from it, so that the
bound is sharp to rounding. NumPy inputs are computed by NumPy.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from hilbo.mechanics.ranges import Coefficients, Floats, Number
from hilbo.numerics.host import namespace_of, scan

__all__ = ["at_angles", "cells_for", "climb", "least", "lowest", "on_grid", "rounding_unit", "rows"]

_ORDER = 8  # of Taylor's formula
_CELLS_PER_TAP = 8
_LEAST_CELLS = 48
_RINGS = 28
_ROUNDING = 16  # units in the last place of Σ |p_j|


def cells_for(degree: int) -> int:
    """Number of cells from 0 to π, a power of 2, on which a polynomial of this degree is bounded."""
    return 2 ** math.ceil(math.log2(_CELLS_PER_TAP * degree + _LEAST_CELLS))


def rounding_unit(p: Coefficients) -> float:
    """Bound of the rounding error of a value of p, as a fraction of Σ |p_j|; depends only on the dtype of `p`."""
    return _ROUNDING * namespace_of(p).finfo(p.dtype).eps


def least(p: Coefficients, cells: int, best: Any, peak: Number) -> Number:
    """Lower bound of p over all angles, before rounding errors; sharp if the minimum is near the angle `peak`.

    `cells` from 0 to π are bounded one by one; `peak` is at most one cell away from grid node `best`.
    """
    xp = namespace_of(p)
    width = math.pi / cells
    terms = rows(p, _ORDER + 1)
    is_adjacent = xp.abs(xp.arange(cells + 1) - best) <= 1
    cell = lowest(on_grid(terms, cells), xp.asarray(width / 2, p.dtype), terms)
    distance = 2 * width * 0.5 ** xp.arange(_RINGS, dtype=p.dtype)
    centre = xp.concatenate([0.75 * distance, -0.75 * distance, xp.zeros_like(distance[:1])])
    radius = xp.concatenate([0.25 * distance, 0.25 * distance, 0.5 * distance[-1:]])
    near = lowest(at_angles(terms, peak + centre), radius, terms)
    return xp.minimum(xp.min(xp.where(is_adjacent, xp.inf, cell)), xp.min(near))


def climb(
    expand: Callable[[Number], tuple[Number, Number, Number]], degree: int, start: Number, width: float
) -> Number:
    """Angle of the maximum within `width` (one cell) of `start` and in [0, π], by eight steps of Newton's method.

    `expand`: angle -> value, and slope and second derivative, per 1/`degree`, of a polynomial that is minimal where the
    value is maximal. Returns `start` if no larger value is found.
    """
    xp = namespace_of(start)
    low, high = xp.maximum(start - width, 0), xp.minimum(start + width, xp.pi)

    def step(angle, _):
        _, slope, bend = expand(angle)
        curved = bend > 0
        return xp.where(curved, xp.clip(angle - slope / xp.where(curved, bend, 1) / degree, low, high), angle)

    angle = scan(step, start, xp.arange(8))
    return xp.where(expand(angle)[0] > expand(start)[0], angle, start)


def rows(p: Coefficients, count: int) -> Float[Any, "{count} n"]:
    """Coefficients p_j·(j/N)^m/m! of the Taylor terms of order m < `count`, in units of 1/N.

    With cos, -sin, -cos, sin of jθ in turn they are the Taylor terms of p. -> (count, n).
    """
    xp = namespace_of(p)
    j = xp.arange(p.shape[0], dtype=p.dtype) / (p.shape[0] - 1)
    rows = [p]
    for m in range(1, count):
        rows.append(rows[-1] * j / m)
    return xp.stack(rows)


def on_grid(rows: Float[Any, "m n"], cells: int) -> Float[Any, "m {cells+1}"]:
    """Taylor terms (m, i) at the angles πi/cells, i = 0 … cells, by FFT; `rows` as from `rows()`."""
    xp = namespace_of(rows)
    turn = xp.asarray([1j**m for m in range(len(rows))], np.result_type(rows.dtype, np.complex64))
    half = xp.concatenate([2 * rows[:, :1], rows[:, 1:]], axis=1).astype(turn.dtype) * turn[:, None]
    return cells * xp.fft.irfft(half, 2 * cells, axis=1)[:, : cells + 1]


def at_angles(rows: Float[Any, "m n"], angles: Float[Any, " i"]) -> Float[Any, "m i"]:
    """Taylor terms (m, i) at any `angles` (i,); `rows` as from `rows()`."""
    xp = namespace_of(rows, angles)
    turned = xp.arange(rows.shape[1], dtype=angles.dtype)[:, None] * angles[None, :]
    cos, sin = rows @ xp.cos(turned), rows @ xp.sin(turned)
    return xp.stack([(cos[m], -sin[m], -cos[m], sin[m])[m % 4] for m in range(len(rows))])


def lowest(taylor: Float[Any, "m i"], radius: Floats, rows: Float[Any, "m n"]) -> Float[Any, " i"]:
    """Lower bound (i,) of p within `radius` of each angle, from its Taylor terms (m, i) there.

    The last of the `rows` (as from `rows()`) bounds the remainder.
    """
    xp = namespace_of(taylor, rows)
    order, scaled = len(rows) - 1, radius * (rows.shape[1] - 1)
    term = [taylor[m] * scaled**m for m in range(order)]
    remainder = xp.sum(xp.abs(rows[order])) * scaled**order
    # Lower bound of half the second derivative, in units of the radius.
    bend = term[2] - sum(math.comb(m, 2) * xp.abs(term[m]) for m in range(3, order)) - math.comb(order, 2) * remainder
    slope = xp.abs(term[1])
    inside = 2 * bend > slope
    return term[0] - xp.where(inside, slope**2 / (4 * xp.where(inside, bend, 1)), slope - bend)
