"""Exact relaxation and creep of the continuous FO-SLS, without sampling or memory limits.

H(s) = K0 + K1·B1·s^α / (K1 + B1·s^α). The force after a unit step of position, and the position after one of force, are

    G(t) = K0 + K1·E_α(-(K1/B1)·t^α)
    J(t) = 1/(K0 + K1) + (K1/(K0 + K1))²/B1 · t^α·E_{α,1+α}(-z),   z = K0·K1/(K0 + K1)/B1 · t^α

The second form of J is valid at K0 = 0 too, where creep has no end. Units: N/mm, N·s^α/mm, s, mm/N. Reference: Mainardi
(2010), Fractional Calculus and Waves in Linear Viscoelasticity, section 3.4.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jax.scipy.special import gammaln
from jaxtyping import Array, Float

from hilbo.mechanics.fosls import share
from hilbo.mechanics.ranges import Reals, Scalar, check_ranges, possible
from hilbo.numerics.mittag_leffler import mittag_leffler, mittag_leffler_increment

__all__ = ["creep_compliance", "relaxation_modulus"]


def relaxation_modulus(t: Reals, K0: Reals, K1: Reals, B1: Reals, alpha: Reals) -> Float[Array, "..."]:
    """Relaxation modulus G(t) (N/mm) for t >= 0; elementwise.

    Differentiable in every parameter; the derivative of t^α at t = 0 is taken as 0. K1 = inf, a spring-pot parallel to
    K0, gives K0 + B1·t^{-α}/Γ(1 - α), which is infinite at t = 0. Raises `InputError` for values outside their ranges;
    where these are traced, and where B1 is 0, the result is NaN.
    """
    check_ranges(t=t, K1=K1, B1=B1, alpha=alpha)
    return _elementwise(_relaxation, t, K0, K1, B1, alpha)


def creep_compliance(t: Reals, K0: Reals, K1: Reals, B1: Reals, alpha: Reals) -> Float[Array, "..."]:
    """Creep compliance J(t) (mm/N) for t >= 0 and K0 >= 0; elementwise and differentiable, K1 may be inf.

    Errors as in `relaxation_modulus`; K0 < 0 is refused, since creep under a load would be unbounded. Creep with
    recovery by superposition: F1·J(t) + (F2 - F1)·J(t - t1) for t >= t1.
    """
    check_ranges(t=t, K0=K0, K1=K1, B1=B1, alpha=alpha)
    return _elementwise(_creep, t, K0, K1, B1, alpha)


@partial(jax.jit, static_argnums=0)
def _elementwise(function: Callable, *args: Reals) -> Float[Array, "..."]:
    """Apply a function of scalars over broadcast arguments, in their common floating dtype; compiled."""
    dtype = jnp.result_type(1.0, *args)
    return jnp.vectorize(function)(*(jnp.asarray(arg, dtype) for arg in args))


def _power(t: Scalar, alpha: Scalar) -> Scalar:
    """t^α, and 0 with zero derivatives at t = 0."""
    return jnp.where(t > 0, jnp.where(t > 0, t, 1) ** alpha, 0)


def _relaxation(t: Scalar, K0: Scalar, K1: Scalar, B1: Scalar, alpha: Scalar) -> Scalar:
    """G(t) (N/mm) of one parameter set, also for infinite K1; NaN for values outside their ranges and for B1 = 0."""
    power = _power(t, alpha)
    rigid = jnp.isinf(K1)
    spring = jnp.where(rigid, 1, K1)
    branch = spring * mittag_leffler(alpha, spring / B1 * power)
    # 1/Γ(1 - α) = Γ(α)·sin(πα)/π.
    size = B1 * jnp.exp(gammaln(alpha)) * jnp.sin(jnp.pi * alpha) / jnp.pi
    pot = jnp.where(t > 0, size / jnp.where(t > 0, power, 1), jnp.inf)
    allowed = possible(t=t, K1=K1, B1=B1, alpha=alpha) & (B1 > 0)
    return jnp.where(allowed, K0 + jnp.where(rigid, pot, branch), jnp.nan)


def _creep(t: Scalar, K0: Scalar, K1: Scalar, B1: Scalar, alpha: Scalar) -> Scalar:
    """J(t) (mm/N) of one parameter set; NaN for values outside their ranges and for B1 = 0."""
    power = _power(t, alpha)
    ratio = share(K1, K0)  # K1/(K0 + K1)
    later = ratio**2 / B1 * power * mittag_leffler_increment(alpha, K0 * ratio / B1 * power)
    allowed = possible(t=t, K0=K0, K1=K1, B1=B1, alpha=alpha) & (B1 > 0)
    return jnp.where(allowed, 1 / (K0 + K1) + later, jnp.nan)
