"""Passivity of the sampled FO-SLS: the damping a device needs, and the largest K1 that a device can render.

A rendering H(z) on a device with physical damping b is passive (Colgate & Schenkel 1997) if

    b > (T/2) / (1 - cos ωT) · Re{(1 - e^{-jωT})·H(e^{jωT})},  0 <= ω <= π/T,   and   H(1) >= 0.

For odd N and for full memory the Nyquist frequency binds (docs/methods/mechanics.md states which part is proved): b_min
= (T/2)·H(-1). With K0 set by H(1) = K_eff, S = C(1), C = C(-1) (see `viscoelastic`) this is

    b_min = (T/2)·[K_eff + β(C - S) · K1/(K1 + β·C) · K1/(K1 + β·S)],

which rises in K1 from (T/2)·K_eff to (T/2)·[K_eff + β(C - S)]. Solved for K1, with Y = 2b/T - K_eff and A = β(C - S) -
Y:

    A <= 0: every K1 is passive;  Y <= 0 or K_eff < 0: none is;  otherwise
    K1max = β·[Y(C + S) + sqrt(Y²(C + S)² + 4·A·Y·C·S)] / (2A).

A force that comes `delay` seconds after its position, 0 to T, needs another damping, at a frequency below Nyquist, and
there is no closed form: `mechanics.delay` has the theory, `mechanics.delayed_bounds` the search. A delay of 0 uses the
forms above.

With full memory S = 0, C = 2^α and K_eff = K0. For even N these forms are up to 2.8 % (N = 2) too low, so even N is
refused; `certify` handles every N, and K1, B1 at their limits, for one parameter set at a time.

Units: K N/mm, B1 N·s^α/mm, T s, damping N·s/m.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hilbo.errors import InputError
from hilbo.mechanics.delay import check_delay
from hilbo.mechanics.delayed_bounds import delayed_damping, delayed_largest_K1
from hilbo.mechanics.fosls import FOSLS, pot_stiffness, share
from hilbo.mechanics.memory import sums
from hilbo.mechanics.passivity_certificate import Certificate, Witness, certify, needed_damping, witness
from hilbo.mechanics.ranges import Number, Reals, Scalar
from hilbo.mechanics.span import Memory, Span, span
from hilbo.numerics.host import namespace_of, on_host
from hilbo.viscoelastic import elementwise

__all__ = [
    "Certificate",
    "Witness",
    "certify",
    "is_passive",
    "largest_K1",
    "largest_K1_beside",
    "minimum_damping",
    "needed_damping",
    "witness",
]

_BATCH = 128  # parameter sets whose frequency grids are in memory at once


def __dir__() -> list[str]:
    return __all__


def minimum_damping(
    K1: Reals,
    B1: Reals,
    alpha: Reals,
    K_eff: Reals = 0.44,
    N: int = 101,
    T: Reals = 1e-3,
    *,
    memory: Memory = "short",
    delay: Reals = 0.0,
) -> Float[Array, "..."]:
    """Smallest device damping b (N·s/m) with which the rendering is passive; elementwise.

    `delay`: from a sample of the position to its force, s, from 0 to T; if above 0 the result has a relative error of
    1e-6.

    `inf` where `K_eff` < 0: a negative static stiffness is active with any damping. For a set with a given K0,
    `K_eff` is its `viscoelastic.dc_gain`. Raises `InputError` for even N, and for values out of range; where these are
    traced the result is NaN.
    """
    memory_span = _checked_span(memory, N)
    if check_delay(delay, T):
        return elementwise(delayed_damping, memory_span, K1, B1, alpha, K_eff, T, delay, batch=_BATCH)
    return elementwise(_minimum_damping, memory_span, K1, B1, alpha, K_eff, T)


def largest_K1(
    B1: Reals,
    alpha: Reals,
    b: Reals = 0.95,
    K_eff: Reals = 0.44,
    N: int = 101,
    T: Reals = 1e-3,
    *,
    memory: Memory = "short",
    delay: Reals = 0.0,
) -> Float[Array, "..."]:
    """Largest passive K1 (N/mm) on a device with damping `b` (N·s/m); elementwise.

    `inf` where every K1 is passive, 0 where none is. Differentiable, with derivative 0 at `inf` and at 0. `delay`: from
    a sample of the position to its force, s, from 0 to T. If it is above 0, the returned K1 needs a damping from b·(1 -
    2e-5) to b; first derivatives are exact, second ones are those at the binding frequency; and K1 is 0 where b is
    below `mechanics.delay.least_damping`, about what a spring of K_eff needs, although a few K1 may be passive there.
    Raises `InputError` for even N, and for values out of range; where these are traced the result is NaN, never a K1
    that looks passive.
    """
    memory_span = _checked_span(memory, N)
    if check_delay(delay, T):
        return elementwise(delayed_largest_K1, memory_span, B1, alpha, b, K_eff, T, delay, batch=_BATCH)
    return elementwise(_largest_K1, memory_span, B1, alpha, b, K_eff, T)


def is_passive(
    K1: Reals,
    B1: Reals,
    alpha: Reals,
    b: Reals,
    K_eff: Reals = 0.44,
    N: int = 101,
    T: Reals = 1e-3,
    *,
    memory: Memory = "short",
    delay: Reals = 0.0,
) -> Bool[Array, "..."]:
    """Whether the rendering is passive on a device with damping `b` (N·s/m), elementwise.

    For every delay of the force from 0 to `delay` (s), as checked by a device. The needed damping first falls with the
    delay and then rises, so that checking both ends is sufficient. Raises `InputError` for even N, and for values out
    of range; where these are traced the result is False.
    """
    arguments = K1, B1, alpha, K_eff, N, T
    passive = minimum_damping(*arguments, memory=memory) <= jnp.asarray(b)
    if not check_delay(delay, T):
        return passive
    return passive & (minimum_damping(*arguments, memory=memory, delay=delay) <= jnp.asarray(b))


def largest_K1_beside(model: FOSLS, b: float, *, delay: float = 0.0) -> float:
    """`largest_K1` (N/mm) for the B1, α, memory, T and static stiffness H(1) of a model, on damping `b` (N·s/m).

    The model's own K1 enters only through H(1). `inf` where every K1 is passive, 0 where none is. Computed by NumPy if
    the model's numbers are NumPy's and there is no `delay` (s). Raises `InputError` for even N, for a delay that is not
    from 0 to T, and unless computed by NumPy for a `b` out of range.
    """
    arguments = model.B1, model.alpha, b, model.dc_gain(), model.T
    if check_delay(delay, model.T):
        return float(elementwise(delayed_largest_K1, _checked_span(model.memory, model.N), *arguments, delay))
    if not on_host(model.B1, model.alpha):
        return float(elementwise(_largest_K1, _checked_span(model.memory, model.N), *arguments))
    return float(_largest_K1(_checked_span(model.memory, model.N), *map(np.float64, arguments)))


def _checked_span(memory: Memory, N: int) -> Span:
    """Memory as a `Span`. Raises `InputError` for short memory of even N, for which the closed forms are not valid."""
    if memory == "short" and N % 2 == 0:
        raise InputError(f"N is {N}; it must be odd: the closed passivity bound is too low for an even number of taps.")
    return span(memory, N)


def _minimum_damping(span: Span, K1: Scalar, B1: Scalar, alpha: Scalar, K_eff: Scalar, T: Scalar) -> Scalar:
    """b_min of the module docstring, N·s/m, for scalars; inf for a negative `K_eff`. 500·T is T/2 for stiffness in
    N/mm.
    """
    beta = pot_stiffness(B1, alpha, T)
    gl = sums(alpha, span)
    fast, slow = share(K1, beta * gl.at_nyquist), share(K1, beta * gl.at_dc)
    stiffness = K_eff + beta * gl.spread * fast * slow
    return jnp.where(K_eff < 0, jnp.inf, 500 * T * stiffness)


def _largest_K1(span: Span, B1: Number, alpha: Number, b: Number, K_eff: Number, T: Number) -> Number:
    """K1max of the module docstring, N/mm, for scalars: 0 where no K1 is passive, inf where every K1 is.

    NumPy numbers give a NumPy number, others a JAX array.
    """
    xp = namespace_of(B1, alpha, b, K_eff, T)
    beta = pot_stiffness(B1, alpha, T)
    gl = sums(alpha, span)
    Y = b / (500 * T) - K_eff
    A = beta * gl.spread - Y
    impossible = (Y <= 0) | (K_eff < 0)
    unlimited = A <= 0
    limited = ~impossible & ~unlimited
    # Where the root is not used, its arguments are set to 1, so that its derivative is not NaN.
    Y, A = xp.where(limited, Y, 1), xp.where(limited, A, 1)
    half = Y * (gl.at_nyquist + gl.at_dc)
    root = xp.sqrt(half**2 + 4 * A * Y * gl.at_nyquist * gl.at_dc)
    return xp.where(impossible, 0, xp.where(unlimited, xp.inf, beta * (half + root) / (2 * A)))
