"""Passivity of the sampled FO-SLS: the damping a device needs, and the largest K1 that a device can render.

A rendering H(z) on a device with physical damping b is passive (Colgate & Schenkel 1997) if

    b > (T/2) / (1 - cos ωT) · Re{(1 - e^{-jωT})·H(e^{jωT})},  0 <= ω <= π/T,   and   H(1) >= 0.

For odd N and for full memory the Nyquist frequency binds (docs/methods/mechanics.md says what of this is proved):
b_min = (T/2)·H(-1). With K0 set by H(1) = K_eff, S = C(1), C = C(-1) (see
`viscoelastic`) this is

    b_min = (T/2)·[K_eff + β(C - S) · K1/(K1 + β·C) · K1/(K1 + β·S)],

which rises in K1 from (T/2)·K_eff to (T/2)·[K_eff + β(C - S)]. Solved for K1, with Y = 2b/T - K_eff and
A = β(C - S) - Y:

    A <= 0: every K1 is passive;  Y <= 0 or K_eff < 0: none is;  otherwise
    K1max = β·[Y(C + S) + sqrt(Y²(C + S)² + 4·A·Y·C·S)] / (2A).

With full memory S = 0, C = 2^α and K_eff = K0. For even N these forms are up to 2.8 % (N = 2) too low, so even N is
refused; `certify` decides every N, and K1, B1 at their limits, for one parameter set at a time.

Units: K N/mm, B1 N·s^α/mm, T s, damping N·s/m.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Real

from hilbo.errors import InputError
from hilbo.mechanics.fosls import FOSLS, pot_stiffness, share
from hilbo.mechanics.memory import sums
from hilbo.mechanics.passivity_certificate import Certificate, Witness, certify, needed_damping, witness
from hilbo.mechanics.span import Memory, Span, span
from hilbo.numerics.host import namespace_of, on_host
from hilbo.viscoelastic import elementwise

__all__ = [
    "Certificate",
    "Witness",
    "certify",
    "largest_K1",
    "largest_K1_beside",
    "minimum_damping",
    "needed_damping",
    "witness",
]


def __dir__() -> list[str]:
    return __all__


def minimum_damping(
    K1: Real[ArrayLike, "..."],
    B1: Real[ArrayLike, "..."],
    alpha: Real[ArrayLike, "..."],
    K_eff: Real[ArrayLike, "..."] = 0.44,
    N: int = 101,
    T: Real[ArrayLike, "..."] = 1e-3,
    *,
    memory: Memory = "short",
) -> Float[Array, "..."]:
    """Smallest device damping b (N·s/m) with which the rendering is passive; elementwise.

    `inf` where `K_eff` < 0: a negative static stiffness is active whatever the damping. For a set with a K0 of its
    own, `K_eff` is its `viscoelastic.dc_gain`. Raises `InputError` for even N, and for values that no model has; where
    they are traced the result is NaN.
    """
    return elementwise(_minimum_damping, _closed(memory, N), K1, B1, alpha, K_eff, T)


def largest_K1(
    B1: Real[ArrayLike, "..."],
    alpha: Real[ArrayLike, "..."],
    b: Real[ArrayLike, "..."] = 0.95,
    K_eff: Real[ArrayLike, "..."] = 0.44,
    N: int = 101,
    T: Real[ArrayLike, "..."] = 1e-3,
    *,
    memory: Memory = "short",
) -> Float[Array, "..."]:
    """Largest passive K1 (N/mm) on a device with damping `b` (N·s/m); elementwise.

    `inf` where every K1 is passive, 0 where none is. Differentiable, with derivative 0 at `inf` and at 0.
    Raises `InputError` for even N, and for values that no model or device has; where they are traced the result is
    NaN, never a K1 that would pass for passive.
    """
    return elementwise(_largest_K1, _closed(memory, N), B1, alpha, b, K_eff, T)


def largest_K1_beside(model: FOSLS, b: float) -> float:
    """`largest_K1` (N/mm) beside the B1, α, memory, T and static stiffness of a model, by NumPy where its numbers are
    NumPy's. Raises ValueError for even N."""
    place = model.B1, model.alpha, b, model.dc_gain(), model.T
    if not on_host(model.B1, model.alpha):
        return float(elementwise(_largest_K1, _closed(model.memory, model.N), *place))
    return float(_largest_K1(_closed(model.memory, model.N), *map(np.float64, place)))


def _closed(memory: Memory, N: int) -> Span:
    """The memory of a model, where the closed forms hold for it."""
    if memory == "short" and N % 2 == 0:
        raise InputError(f"N is {N}; it must be odd: the closed passivity bound is too low for an even number of taps.")
    return span(memory, N)


def _minimum_damping(
    span: Span,
    K1: Float[Array, ""],
    B1: Float[Array, ""],
    alpha: Float[Array, ""],
    K_eff: Float[Array, ""],
    T: Float[Array, ""],
) -> Float[Array, ""]:
    """b_min of this module's head, N·s/m; 500·T is T/2 for stiffness in N/mm."""
    beta = pot_stiffness(B1, alpha, T)
    gl = sums(alpha, span)
    fast, slow = share(K1, beta * gl.at_nyquist), share(K1, beta * gl.at_dc)
    stiffness = K_eff + beta * gl.spread * fast * slow
    return jnp.where(K_eff < 0, jnp.inf, 500 * T * stiffness)


def _largest_K1(
    span: Span,
    B1: Float[Any, ""],
    alpha: Float[Any, ""],
    b: Float[Any, ""],
    K_eff: Float[Any, ""],
    T: Float[Any, ""],
) -> Float[Any, ""]:
    """K1max of this module's head, N/mm, and its two limits."""
    xp = namespace_of(B1, alpha, b, K_eff, T)
    beta = pot_stiffness(B1, alpha, T)
    gl = sums(alpha, span)
    room = b / (500 * T) - K_eff  # Y
    excess = beta * gl.spread - room  # A
    impossible = (room <= 0) | (K_eff < 0)
    unlimited = excess <= 0
    limited = ~impossible & ~unlimited
    # The root is taken of harmless numbers where it is not used, so that its derivative cannot turn into NaN.
    room, excess = xp.where(limited, room, 1), xp.where(limited, excess, 1)
    half = room * (gl.at_nyquist + gl.at_dc)
    root = xp.sqrt(half**2 + 4 * excess * room * gl.at_nyquist * gl.at_dc)
    return xp.where(impossible, 0, xp.where(unlimited, xp.inf, beta * (half + root) / (2 * excess)))
