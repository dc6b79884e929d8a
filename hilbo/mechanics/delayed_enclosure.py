"""Enclosure of the damping that a delayed rendering needs at any frequency.

Proved for short memory, estimated for full.

With Y of `delay` and A of `response_polynomials`, the damping (T/2)·Y* is sufficient at every frequency if

    P = Y*²·A - Y*·ψA - σ(1 - σ)·|H|²A

is never negative, a cosine polynomial of degree N + 1. With a lower bound -E < 0 of P slightly more is sufficient:
where -E <= P < 0 the slope dP/dY = 2·Y*·A - ψA is Y*·A - E/Y* at least, and so Y* + E·Y*/(Y*²·min A - E) is sufficient.
"""

import math
from functools import partial

import jax.numpy as jnp

from hilbo.mechanics.cosine_polynomials import at_angles, cells_for, climb, least, on_grid, rounding_unit, rows
from hilbo.mechanics.delay import larger_root
from hilbo.mechanics.delayed_bounds import ESTIMATED, largest_need
from hilbo.mechanics.fosls import FOSLS
from hilbo.mechanics.ranges import Coefficients, Number, Scalar
from hilbo.mechanics.response_polynomials import parts_of, square_of, turned_of
from hilbo.numerics.host import namespace_of

__all__ = ["full_estimate", "short_enclosure"]

_Polynomials = tuple[Coefficients, Coefficients, Coefficients]


def short_enclosure(model: FOSLS, lag: Number) -> tuple[Number, Number, Number]:
    """Lower and upper bound of max Y (N/mm) over all angles, and the angle of the maximum found; `lag` is σ.

    For short memory. The upper bound is inf if the lower bound of P is too poor to prove one.
    """
    polynomials, least_A = _polynomials(model, lag)
    A, U, W = polynomials
    xp = namespace_of(A)
    cells = cells_for(model.N + 1)
    width = math.pi / cells
    a, u, w = (on_grid(rows(p, 1), cells)[0] for p in polynomials)
    value = larger_root(u / a, w / a)
    best = xp.argmax(value)
    at = partial(_expand, polynomials)
    peak = climb(at, model.N + 1, best.astype(A.dtype) * width, width)
    largest = xp.maximum(value[best], at(peak)[0])

    size = largest**2 * xp.sum(xp.abs(A)) + largest * xp.sum(xp.abs(U)) + xp.sum(xp.abs(W))
    rounding = rounding_unit(A) * size
    error = rounding / xp.where(largest > 0, largest, 1)  # of Y, where A is 1
    Y = largest + 4 * error
    short = xp.maximum(rounding - least(Y**2 * A - Y * U - W, cells, best, peak), 0)
    room = Y**2 * least_A - short
    more = xp.where(short > 0, xp.where(room > 0, short * Y / xp.where(room > 0, room, 1), xp.inf), 0)
    A_of_peak = at_angles(rows(A, 1), peak[None])[0, 0]
    return largest - 4 * error / xp.minimum(A_of_peak, 1), Y + more, peak


def full_estimate(model: FOSLS, lag: Number) -> tuple[Scalar, Scalar, Scalar]:
    """Maximum of Y (N/mm) found, minus and plus the error of the search, and its angle; for full memory, not proved.

    `lag` is σ. Results as of `short_enclosure`.
    """
    largest, angle = largest_need(model.span, model.K1, model.beta, model.alpha, model.dc_gain(), lag)
    error = ESTIMATED * jnp.abs(largest)
    return largest - error, largest + error, angle


def _polynomials(model: FOSLS, lag: Number) -> tuple[_Polynomials, Number]:
    """Cosine coefficients (N + 2,) of A, ψA and σ(1 - σ)·|H|²A, as a tuple, and the minimum of A."""
    parts = parts_of(model)
    xp = namespace_of(parts.A)
    zero = xp.zeros(1, parts.A.dtype)

    def longer(p):
        return xp.concatenate([p, zero])

    late = longer(model.K0 * parts.A + parts.B) + 2 * lag * turned_of(parts, model.K0)
    return (longer(parts.A), late, longer(lag * (1 - lag) * square_of(parts, model.K0))), parts.least_A


def _expand(polynomials: _Polynomials, angle: Number) -> tuple[Number, Number, Number]:
    """Y at an angle, and slope and second derivative of P for this Y, per 1/(N + 1); for `climb`.

    `polynomials`: as from `_polynomials`.
    """
    a, u, w = (at_angles(rows(p, 3), angle[None])[:, 0] for p in polynomials)
    Y = larger_root(u[0] / a[0], w[0] / a[0])
    return Y, Y**2 * a[1] - Y * u[1] - w[1], 2 * (Y**2 * a[2] - Y * u[2] - w[2])
