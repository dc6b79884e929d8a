"""Mittag-Leffler functions on the negative axis: E_α(-z) and E_{a,b}(-z) for z >= 0, 0 < a <= 1.

They are what exponentials become in fractional order: E_1(-z) = e^{-z}. The inverse Laplace integral along a ray
p = -s, s = e^{x - iφ}, integrated once by parts, is

    E_{a,b}(-z) = 1/(πa)·Im ∫ e^{-s}·s^{1-b}·(s + b - 1)·e^{iπ(1-b)}·log(1 + s^a e^{iπa}/z) dx

For b = 1 and φ = 0 this is the mean of arg(1 + s^a e^{iπa}/z)/(πa) over s ~ Exp(1): positive terms, and smooth in x
whatever a is. As a -> 1 the logarithm's branch point, at angle π(1 - a)/a above the ray, comes near; turning the ray
by φ away from it keeps the distance. The trapezoidal rule then converges like e^{-c/h}: 280 terms give 1e-14. For
b < 1 the left tail falls as slowly as e^{ax}; with x = y - e^{-y-4} it falls double exponentially in y.
Reference: Gorenflo, Kilbas, Mainardi, Rogosin (2014), Mittag-Leffler Functions, sections 3.4 and 4.7.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gamma
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Real

__all__ = ["mittag_leffler", "mittag_leffler_increment", "mittag_leffler_two"]

_Nodes = tuple[np.ndarray, np.ndarray]  # places x and their weights

_ONE = np.arange(-37.5, 4.0, 0.15), np.full(277, 0.15)
_Y = np.arange(-13.0, 4.0, 0.05)
_TWO = _Y - np.exp(-_Y - 4), 0.05 * (1 + np.exp(-_Y - 4))
_TERMS = 12
_SMALL = 0.03


@jax.jit
def mittag_leffler(alpha: Real[ArrayLike, "..."], z: Real[ArrayLike, "..."]) -> Float[Array, "..."]:
    """E_α(-z) for 0 < α <= 1 and z >= 0, elementwise; error below 1e-12. It falls from 1 to 0."""
    dtype = jnp.result_type(1.0, alpha, z)
    return jnp.vectorize(lambda alpha, z: _safe(alpha, jnp.ones_like(alpha), z, _ONE))(
        jnp.asarray(alpha, dtype), jnp.asarray(z, dtype)
    )


@jax.jit
def mittag_leffler_two(
    a: Real[ArrayLike, "..."], b: Real[ArrayLike, "..."], z: Real[ArrayLike, "..."]
) -> Float[Array, "..."]:
    """E_{a,b}(-z) for 0.01 <= a <= 1, a <= b <= 1 and z >= 0, elementwise; error below 1e-10."""
    dtype = jnp.result_type(1.0, a, b, z)
    args = (jnp.asarray(value, dtype) for value in (a, b, z))
    return jnp.vectorize(lambda a, b, z: _safe(a, b, z, _TWO))(*args)


@jax.jit
def mittag_leffler_increment(alpha: Real[ArrayLike, "..."], z: Real[ArrayLike, "..."]) -> Float[Array, "..."]:
    """(1 - E_α(-z))/z, which is E_{α,1+α}(-z), for 0 < α <= 1 and z >= 0, elementwise; 1/Γ(1 + α) at z = 0."""
    dtype = jnp.result_type(1.0, alpha, z)
    return jnp.vectorize(_increment)(jnp.asarray(alpha, dtype), jnp.asarray(z, dtype))


def _increment(alpha: Float[Array, ""], z: Float[Array, ""]) -> Float[Array, ""]:
    """(1 - E_α(-z))/z, by its power series where z is small, else from E_α."""
    small = z < _SMALL
    large = jnp.where(small, 1, z)
    orders = jnp.arange(1, _TERMS + 1, dtype=z.dtype)
    series = jnp.polyval((1 / gamma(1 + alpha * orders))[::-1], jnp.where(small, -z, 0))
    return jnp.where(small, series, (1 - _safe(alpha, jnp.ones_like(alpha), large, _ONE)) / large)


def _safe(a: Float[Array, ""], b: Float[Array, ""], z: Float[Array, ""], nodes: _Nodes) -> Float[Array, ""]:
    """E_{a,b}(-z), also at z = 0; differentiable. `nodes`: nodes x and weights of the quadrature."""
    at_zero = jnp.where(b == 1, 1, 1 / gamma(b))
    return jnp.where(z > 0, _integral(a, b, jnp.where(z > 0, z, 1), nodes), at_zero)


def _integral(a: Float[Array, ""], b: Float[Array, ""], z: Float[Array, ""], nodes: _Nodes) -> Float[Array, ""]:
    """E_{a,b}(-z) for z > 0, by the integral of the module docstring; `nodes`: its nodes x and their weights."""
    x, step = (jnp.asarray(value, z.dtype) for value in nodes)
    # The integral does not depend on φ, so its derivative need not know how φ was chosen.
    phi = jax.lax.stop_gradient(jnp.pi / 4 - jnp.minimum(jnp.pi / 2 * (1 - a) / a, jnp.pi / 4))
    size = jnp.exp(x)
    turn = jnp.pi * (1 - b) + size * jnp.sin(phi) - (1 - b) * phi
    weight = step * jnp.exp((1 - b) * x - size * jnp.cos(phi))
    # s + b - 1 in polar form would lose its sign: its two parts are kept.
    real, imag = size * jnp.cos(phi) - (1 - b), -size * jnp.sin(phi)
    log_size, angle = _log_one_plus(a * x - jnp.log(z), jnp.pi * a - a * phi)
    cos, sin = jnp.cos(turn), jnp.sin(turn)
    factor_real, factor_imag = real * cos - imag * sin, real * sin + imag * cos
    return jnp.sum(weight * (factor_real * angle + factor_imag * log_size)) / (jnp.pi * a)


def _log_one_plus(
    log_u: Float[Array, " nodes"], psi: Float[Array, ""]
) -> tuple[Float[Array, " nodes"], Float[Array, " nodes"]]:
    """Real and imaginary part of log(1 + u·e^{iψ}), for 0 < ψ < π. `log_u` is log u, of any size."""
    big = log_u > 0
    u = jnp.exp(-jnp.abs(log_u))
    angle = jnp.arctan2(u * jnp.sin(psi), 1 + u * jnp.cos(psi))
    size = jnp.log1p(u * (2 * jnp.cos(psi) + u)) / 2
    return size + jnp.where(big, log_u, 0), jnp.where(big, psi - angle, angle)
