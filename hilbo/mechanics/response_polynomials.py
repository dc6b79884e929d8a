"""Frequency response of an FO-SLS with short memory as cosine polynomials, after multiplication by a denominator A.

With g = K1/(K1 + β), h = 1 - g and k = K1·β/(K1 + β) the response is H = K0 + k·C/(g + h·C), and times A = |g + h·C|²

    Re H - cot(θ/2)·Im H    is    K0·A + B,   B = k·(g·V + h·|C|²)
    Re(e^{-jθ}·H)           is    cos θ·(K0·A + k·h·|C|²) + k·g·Re(e^{-jθ}·C)
    |H|²                    is    |K0·g + (K0·h + k)·C|²

where V = Re C - cot(θ/2)·Im C = S_N - 2·Σ_{j=1..N} (S_{j-1} - S_N)·cos jθ. NumPy inputs are computed by NumPy.
"""

from typing import Any, NamedTuple

from jaxtyping import Float

from hilbo.mechanics.fosls import FOSLS, series, share
from hilbo.mechanics.ranges import Coefficients, Number
from hilbo.numerics.host import namespace_of

__all__ = ["Parts", "parts_of", "square_of", "turned_of"]


class Parts(NamedTuple):
    """Cosine coefficients of degree N, and g, h, k as in the module docstring."""

    A: Coefficients
    B: Coefficients
    least_A: Number  # (g + h·S_N)² > 0, the least value of A
    C: Coefficients  # Re C
    square: Coefficients  # |C|²
    g: Number
    h: Number
    k: Number


def parts_of(model: FOSLS) -> Parts:
    """Polynomials A and B of a model with short memory, with their components."""
    beta = model.beta
    xp = namespace_of(model.alpha)
    k = series(model.K1, beta)
    g, h = xp.where(k > 0, share(model.K1, beta), 1), xp.where(k > 0, share(beta, model.K1), 0)
    one = xp.ones(1, k.dtype)
    i = xp.arange(1, model.N + 1, dtype=k.dtype)
    partial = xp.concatenate([one, xp.cumprod(1 - model.alpha / i)])  # S_0 ... S_N
    c = xp.concatenate([one, -(model.alpha / i) * partial[:-1]])
    last = partial[-1]
    square = xp.correlate(c, c, mode="full")[model.N :]
    square = xp.concatenate([square[:1], 2 * square[1:]])
    # Re C = Σ c_j cos jθ
    A = h**2 * square + 2 * g * h * c + xp.concatenate([g[None] ** 2, xp.zeros(model.N, k.dtype)])
    V = xp.concatenate([last[None], 2 * (last - partial[:-1])])
    return Parts(A, k * (g * V + h * square), (g + h * last) ** 2, c, square, g, h, k)


def turned_of(parts: Parts, K0: Number) -> Float[Any, " m"]:
    """Cosine coefficients (N + 2,) of Re(e^{-jθ}·H)·A, one degree higher than A. K0 in N/mm."""
    xp = namespace_of(parts.A)
    zero = xp.zeros(1, parts.A.dtype)
    late = xp.concatenate([zero, parts.C])  # Re(e^{-jθ}·C)
    p = K0 * parts.A + parts.k * parts.h * parts.square
    # cos θ·cos jθ is the mean of cos (j-1)θ and cos (j+1)θ.
    up, down = xp.concatenate([zero, p[:1], p[1:] / 2]), xp.concatenate([p[1:] / 2, zero, zero])
    return up + down + parts.k * parts.g * late


def square_of(parts: Parts, K0: Number) -> Coefficients:
    """Cosine coefficients (N + 1,) of |H|²·A. K0 in N/mm."""
    xp = namespace_of(parts.A)
    constant, slope = K0 * parts.g, K0 * parts.h + parts.k
    p = slope**2 * parts.square + 2 * constant * slope * parts.C
    return xp.concatenate([p[:1] + constant**2, p[1:]])
