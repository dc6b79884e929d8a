"""The fractional-order standard linear solid (FO-SLS): its coefficients and its closed forms.

Continuous model H(s) = K0 + K1·B1·s^α / (K1 + B1·s^α), 0 < α < 1. Sampled every T seconds with N past samples
(Grünwald-Letnikov, short memory):

    c_0 = 1, c_i = c_{i-1}·(i-1-α)/i (negative for i >= 1),  C(z) = Σ_{i=0..N} c_i z^{-i},  β = B1·T^{-α}
    H(z) = K0 + K1·β·C(z) / (K1 + β·C(z))

Everything below follows from the partial sums S_i = c_0 + … + c_i = Π_{j=1..i} (1 - α/j), because
|c_i| = (α/i)·S_{i-1}: products of positive numbers, in which no digit is lost at either end of α.

Units: stiffness N/mm, B1 N·s^α/mm, T s, damping N·s/m. N and T belong to a parameter set: α means another material
under another N. Reference: Podlubny (1999), Fractional Differential Equations, section 7.3 (short memory).
"""

from collections.abc import Callable
from functools import partial
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Real

__all__ = [
    "GLSums",
    "K0_from_effective_stiffness",
    "dc_gain",
    "effective_damping",
    "gl_alternating_sum",
    "gl_coefficients",
    "gl_sum",
    "gl_sums",
]

Memory = Literal["short", "full"]


class GLSums(eqx.Module):
    """The four sums of Grünwald-Letnikov coefficients that the closed forms need."""

    at_dc: Float[Array, ""]  # S_N = C(1)
    at_nyquist: Float[Array, ""]  # C(-1), close to 2^α
    spread: Float[Array, ""]  # C(-1) - C(1) = 2·Σ_{odd i} |c_i|
    moment: Float[Array, ""]  # M1 = -Σ i·c_i


@partial(jax.jit, static_argnames="N")
def gl_coefficients(alpha: Real[ArrayLike, ""], N: int) -> Float[Array, " {N+1}"]:
    """Coefficients c_0 … c_N of one order α; `jax.vmap` over `alpha` for several."""
    alpha = jnp.asarray(alpha, jnp.result_type(1.0, alpha))
    _, tail = jax.lax.scan(partial(_tap, alpha), jnp.ones_like(alpha), _indices(alpha, N))
    return jnp.concatenate([jnp.ones(1, alpha.dtype), -tail])


@partial(jax.jit, static_argnames="N")
def gl_sums(alpha: Real[ArrayLike, ""], N: int) -> GLSums:
    """C(1), C(-1), their difference and the first moment of one order α, without cancellation."""
    alpha = jnp.asarray(alpha, jnp.result_type(1.0, alpha))

    def add(sums, i):
        following, tap = _tap(alpha, sums.at_dc, i)
        odd = i % 2 == 1
        return GLSums(
            at_dc=following,
            at_nyquist=sums.at_nyquist + jnp.where(odd, tap, -tap),
            spread=sums.spread + jnp.where(odd, 2 * tap, 0),
            moment=sums.moment + i * tap,
        ), None

    zero, one = jnp.zeros_like(alpha), jnp.ones_like(alpha)
    return jax.lax.scan(add, GLSums(one, one, zero, zero), _indices(alpha, N))[0]


def gl_sum(alpha: Real[ArrayLike, "..."], N: int) -> Float[Array, "..."]:
    """S_N = C(1) = Π_{i=1..N} (1 - α/i), elementwise in `alpha`."""
    return elementwise(_gl_sum, N, alpha)


def gl_alternating_sum(alpha: Real[ArrayLike, "..."], N: int) -> Float[Array, "..."]:
    """C(-1) = Σ (-1)^i c_i, elementwise in `alpha`; within 3.4e-4 of 2^α at N = 101."""
    return elementwise(_gl_alternating_sum, N, alpha)


def K0_from_effective_stiffness(
    K1: Real[ArrayLike, "..."],
    B1: Real[ArrayLike, "..."],
    alpha: Real[ArrayLike, "..."],
    K_eff: Real[ArrayLike, "..."] = 0.44,
    N: int = 101,
    T: Real[ArrayLike, "..."] = 1e-3,
    *,
    memory: Memory = "short",
) -> Float[Array, "..."]:
    """K0 (N/mm) with which the rendering has the static stiffness H(1) = `K_eff` (N/mm); elementwise."""
    check_memory(memory)
    return elementwise(_K0, N, K1, B1, alpha, K_eff, T)


def dc_gain(
    K0: Real[ArrayLike, "..."],
    K1: Real[ArrayLike, "..."],
    B1: Real[ArrayLike, "..."],
    alpha: Real[ArrayLike, "..."],
    N: int = 101,
    T: Real[ArrayLike, "..."] = 1e-3,
    *,
    memory: Memory = "short",
) -> Float[Array, "..."]:
    """Static stiffness H(1) (N/mm) of the sampled model; elementwise."""
    check_memory(memory)
    return elementwise(_dc_gain, N, K0, K1, B1, alpha, T)


def effective_damping(
    K1: Real[ArrayLike, "..."],
    B1: Real[ArrayLike, "..."],
    alpha: Real[ArrayLike, "..."],
    N: int = 101,
    T: Real[ArrayLike, "..."] = 1e-3,
    *,
    memory: Memory = "short",
) -> Float[Array, "..."]:
    """dH/ds at s = 0 (N·s/m): the damping felt in slow motion, T·K1²·β·M1/(K1 + β·S_N)²; elementwise."""
    check_memory(memory)
    return elementwise(_effective_damping, N, K1, B1, alpha, T)


def check_memory(memory: str) -> None:
    """The closed forms for full memory (K0 >= 0, states instead of taps) are not written yet."""
    if memory != "short":
        raise NotImplementedError(f'The closed forms know memory="short" only so far, not {memory!r}.')


def elementwise(function: Callable, N: int, *args: Real[ArrayLike, "..."]):
    """Apply `function(N, *scalars)` over broadcast arguments in their common floating dtype, compiled once."""
    if N < 1:
        raise ValueError(f"N is {N}, it must be at least 1: the number of past samples in the sum.")
    dtype = jnp.result_type(1.0, *args)
    return _compiled(function, N, *(jnp.asarray(arg, dtype) for arg in args))


@partial(jax.jit, static_argnums=(0, 1))
def _compiled(function, N, *args):
    return jnp.vectorize(partial(function, N))(*args)


def _tap(alpha, partial_sum, i):
    """From S_{i-1} to S_i and |c_i|."""
    return partial_sum * (1 - alpha / i), alpha / i * partial_sum


def _indices(alpha, N):
    return jnp.arange(1, N + 1, dtype=alpha.dtype)


def _gl_sum(N, alpha):
    return gl_sums(alpha, N).at_dc


def _gl_alternating_sum(N, alpha):
    return gl_sums(alpha, N).at_nyquist


def _K0(N, K1, B1, alpha, K_eff, T):
    return K_eff - _branch_gain(N, K1, B1, alpha, T)


def _dc_gain(N, K0, K1, B1, alpha, T):
    return K0 + _branch_gain(N, K1, B1, alpha, T)


def _branch_gain(N, K1, B1, alpha, T):
    """DC gain of spring K1 and spring-pot in series."""
    pot = B1 * T**-alpha * gl_sums(alpha, N).at_dc
    return K1 * pot / (K1 + pot)


def _effective_damping(N, K1, B1, alpha, T):
    beta = B1 * T**-alpha
    sums = gl_sums(alpha, N)
    share = K1 / (K1 + beta * sums.at_dc)
    return 1000 * T * beta * sums.moment * share**2
