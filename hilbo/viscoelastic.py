"""Fractional-order standard linear solid (FO-SLS): public names of the model, and its closed forms over arrays.

Continuous model H(s) = K0 + K1·B1·s^α / (K1 + B1·s^α), 0 < α <= 1. Sampled every T seconds with N past samples
(Grünwald-Letnikov, short memory), or with a positive sum of exponentials instead (full memory; see `memory`):

    c_0 = 1, c_i = c_{i-1}·(i-1-α)/i (negative for i >= 1),  C(z) = Σ_{i=0..N} c_i z^{-i},  β = B1·T^{-α}
    H(z) = K0 + K1·β·C(z) / (K1 + β·C(z))

The record `FOSLS` is defined in `fosls`, the exact continuous functions in `continuous`, presets, special cases and
loads in `materials`, the change of sets in contact in `switching`; all are re-exported here. The closed forms in this
module need only S_N = C(1), M1 = -Σ i·c_i and C(-1).

Units: stiffness N/mm, B1 N·s^α/mm, T s, damping N·s/m. N and T belong to a parameter set: the same α with another N is
another material. Reference: Podlubny (1999), Fractional Differential Equations, section 7.3 (short memory).
"""

from collections.abc import Callable
from functools import cache, partial
from inspect import signature

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hilbo.mechanics.continuous import creep_compliance, relaxation_modulus
from hilbo.mechanics.fosls import FOSLS, pot_stiffness, slow_damping, slow_stiffness
from hilbo.mechanics.materials import (
    PRESETS,
    Preset,
    creep_load,
    kelvin_voigt,
    maxwell,
    relaxation_load,
    sls,
    spring,
    springpot,
)
from hilbo.mechanics.memory import GLSums, gl_coefficients, gl_sums, sums
from hilbo.mechanics.ranges import RANGES, Reals, Scalar, check_ranges, possible
from hilbo.mechanics.span import Memory, Span, span
from hilbo.mechanics.switching import switched_force

__all__ = [
    "FOSLS",
    "PRESETS",
    "GLSums",
    "K0_from_effective_stiffness",
    "Memory",
    "Preset",
    "creep_compliance",
    "creep_load",
    "dc_gain",
    "effective_damping",
    "gl_alternating_sum",
    "gl_coefficients",
    "gl_sum",
    "gl_sums",
    "kelvin_voigt",
    "maxwell",
    "relaxation_load",
    "relaxation_modulus",
    "sls",
    "spring",
    "springpot",
    "switched_force",
]


def __dir__() -> list[str]:
    return __all__


def gl_sum(alpha: Reals, N: int) -> Float[Array, "..."]:
    """S_N = C(1) = Π_{i=1..N} (1 - α/i), elementwise in `alpha`. Raises `InputError` for values out of range."""
    return elementwise(_gl_sum, span("short", N), alpha)


def gl_alternating_sum(alpha: Reals, N: int) -> Float[Array, "..."]:
    """C(-1) = Σ (-1)^i c_i, elementwise in `alpha`; within 3.4e-4 of 2^α at N = 101.

    Raises `InputError` for values out of range.
    """
    return elementwise(_gl_alternating_sum, span("short", N), alpha)


def K0_from_effective_stiffness(
    K1: Reals, B1: Reals, alpha: Reals, K_eff: Reals = 0.44, N: int = 101, T: Reals = 1e-3, *, memory: Memory = "short"
) -> Float[Array, "..."]:
    """K0 (N/mm) for which the rendering has the static stiffness H(1) = `K_eff` (N/mm); elementwise.

    K1 and `K_eff` in N/mm, B1 in N·s^α/mm, T in s; arrays that broadcast. Raises `InputError` for values out of range,
    here and below; where these are traced the result is NaN.
    """
    return elementwise(_K0, span(memory, N), K1, B1, alpha, K_eff, T)


def dc_gain(
    K0: Reals, K1: Reals, B1: Reals, alpha: Reals, N: int = 101, T: Reals = 1e-3, *, memory: Memory = "short"
) -> Float[Array, "..."]:
    """Static stiffness H(1) (N/mm) of the sampled model; elementwise.

    K0 (any number) and K1 in N/mm, B1 in N·s^α/mm, T in s; arrays that broadcast. Raises `InputError` for K1 < 0, B1 <
    0 or infinite, alpha outside (0, 1], T not above 0 or infinite, N < 1 and an unknown memory; where the numbers are
    traced the result is NaN.
    """
    return elementwise(_dc_gain, span(memory, N), K0, K1, B1, alpha, T)


def effective_damping(
    K1: Reals, B1: Reals, alpha: Reals, N: int = 101, T: Reals = 1e-3, *, memory: Memory = "short", states: int = 10
) -> Float[Array, "..."]:
    """Damping dH/ds at s = 0 (N·s/m), that of slow motion, T·K1²·β·M1/(K1 + β·S_N)²; elementwise.

    K1 in N/mm, B1 in N·s^α/mm, T in s; `states`: number of exponentials of full memory. Raises `InputError` for values
    out of range; where these are traced the result is NaN.
    """
    return elementwise(_effective_damping, span(memory, N, states), K1, B1, alpha, T)


def elementwise(function: Callable, span: Span, *args: Reals, batch: int | None = None) -> Float[Array, "..."]:
    """Apply `function(span, *scalars)` over the broadcast arguments `args`, converted to their common floating dtype.

    Compiled once for each function, span and shapes. `batch`: number of elements computed at a time, to limit memory;
    None: all. Arguments whose parameter name is in `RANGES` are checked, except K0: raises `InputError` for values out
    of range; where these are traced, the result is NaN.
    """
    names = _ranged(function)
    check_ranges(**{name: args[i] for i, name in names})
    dtype = jnp.result_type(1.0, *args)
    return _compiled(function, span, *(jnp.asarray(arg, dtype) for arg in args), batch=batch)


@cache
def _ranged(function: Callable) -> tuple[tuple[int, str], ...]:
    """Positions (after `span`) and names of a function's parameters that have a range in `RANGES`, without K0, which
    may be any number here.
    """
    names = [*signature(function).parameters][1:]
    return tuple((i, name) for i, name in enumerate(names) if name in RANGES and name != "K0")


@partial(jax.jit, static_argnums=(0, 1), static_argnames="batch")
def _compiled(
    function: Callable, span: Span, *args: Float[Array, "..."], batch: int | None = None
) -> Float[Array, "..."]:
    """Compiled part of `elementwise`; NaN where an argument is out of range."""

    def one(*scalars):
        allowed = possible(**{name: scalars[i] for i, name in _ranged(function)})
        return jnp.where(allowed, function(span, *scalars), jnp.nan)

    if batch is None:
        return jnp.vectorize(one)(*args)
    same = jnp.broadcast_arrays(*args)
    if same[0].size <= batch:
        return jnp.vectorize(one)(*same)
    flat = jax.lax.map(lambda scalars: one(*scalars), tuple(arg.ravel() for arg in same), batch_size=batch)
    return flat.reshape(same[0].shape)


def _gl_sum(span: Span, alpha: Scalar) -> Scalar:
    """S_N for one α."""
    return sums(alpha, span).at_dc


def _gl_alternating_sum(span: Span, alpha: Scalar) -> Scalar:
    """C(-1) for one α."""
    return sums(alpha, span).at_nyquist


def _K0(span: Span, K1: Scalar, B1: Scalar, alpha: Scalar, K_eff: Scalar, T: Scalar) -> Scalar:
    """K0 (N/mm) with which one parameter set has the static stiffness `K_eff` (N/mm)."""
    return K_eff - slow_stiffness(K1, pot_stiffness(B1, alpha, T), sums(alpha, span))


def _dc_gain(span: Span, K0: Scalar, K1: Scalar, B1: Scalar, alpha: Scalar, T: Scalar) -> Scalar:
    """H(1) (N/mm) of one parameter set."""
    return K0 + slow_stiffness(K1, pot_stiffness(B1, alpha, T), sums(alpha, span))


def _effective_damping(span: Span, K1: Scalar, B1: Scalar, alpha: Scalar, T: Scalar) -> Scalar:
    """dH/ds at s = 0 (N·s/m) of one parameter set."""
    return slow_damping(K1, pot_stiffness(B1, alpha, T), sums(alpha, span), T)
