"""Covariance functions, written for single points; `gram` makes matrices of them by `vmap`.

    RBF:          k(x, x') = variance * exp(-theta |x - x'|^2)          (paper, section IV-3, with variance 1)
    Matern 3/2:   k(x, x') = variance * (1 + s) exp(-s),  s^2 = 6 theta |x - x'|^2

`theta` is one number, or one per dimension (automatic relevance determination). In terms of a length scale l,
theta = 1 / (2 l^2) for both. Functions of the RBF are smooth everywhere; those of the Matern kernel have a slope
everywhere and may bend sharply, as a dissimilarity that grows with the distance does where it is smallest.
Reference: Rasmussen & Williams (2006), section 4.2.1.
"""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from hilbo.numerics.shown import check_positive, numbers, shown

__all__ = ["RBF", "Kernel", "Matern32", "Stationary", "gram"]


def __dir__() -> list[str]:
    return __all__


@runtime_checkable
class Kernel(Protocol):
    """What the rest of hilbo asks of a covariance function."""

    def __call__(self, x: Float[Array, " d"], y: Float[Array, " d"], /) -> Float[Array, ""]:
        """Covariance of the latent function at two points."""
        ...

    def diagonal(self, x: Float[Array, " d"], /) -> Float[Array, ""]:
        """Variance of the latent function at a point: the covariance with itself, without its rounding.

        `x` (d,) -> a scalar.
        """
        ...


class RBF(eqx.Module):
    """Squared-exponential covariance, variance * exp(-theta |x - x'|^2).

    **Arguments:**

    - `theta`: inverse squared length, > 0, scalar or (d,), per squared unit of x.
    - `variance`: prior variance of the latent function, > 0.

    Raises `InputError` for numbers that are not above 0; what is traced is not checked.
    """

    theta: Float[Array, "*d"]
    variance: Float[Array, ""]

    def __init__(self, theta: ArrayLike | Sequence[float | int], variance: ArrayLike = 1.0):
        self.theta = numbers("RBF", "theta", theta, _float_dtype(theta))
        self.variance = numbers("RBF", "variance", variance, _float_dtype(variance))
        check_positive("RBF", theta=self.theta, variance=self.variance)

    def __repr__(self) -> str:
        return f"RBF(theta={shown(self.theta)}, variance={shown(self.variance)})"

    def __call__(self, x: Float[Array, " d"], y: Float[Array, " d"]) -> Float[Array, ""]:
        """Covariance of the latent function at `x` and at `y`, both (d,)."""
        return self.variance.astype(x.dtype) * jnp.exp(-_squared(self.theta, x, y))

    def along(self, axis: int, x: Float[Array, " n"], y: Float[Array, " m"]) -> Float[Array, "n m"]:
        """The factor (n, m) that one coordinate contributes: the kernel is the product of these and the variance."""
        theta = self.theta[axis] if self.theta.ndim else self.theta
        return jnp.exp(-theta.astype(x.dtype) * (x[:, None] - y[None, :]) ** 2)

    def diagonal(self, x: Float[Array, " d"]) -> Float[Array, ""]:
        """The prior variance, the same everywhere. `x` (d,) -> a scalar."""
        return self.variance.astype(x.dtype)


class Matern32(eqx.Module):
    """Matern covariance of smoothness 3/2, variance * (1 + s) exp(-s) with s^2 = 6 theta |x - x'|^2.

    Arguments and errors as those of `RBF`. Twice differentiable in each point, also where both are the same.
    """

    theta: Float[Array, "*d"]
    variance: Float[Array, ""]

    def __init__(self, theta: ArrayLike | Sequence[float | int], variance: ArrayLike = 1.0):
        self.theta = jnp.asarray(theta, dtype=_float_dtype(theta))
        self.variance = jnp.asarray(variance, dtype=_float_dtype(variance))
        check_positive("Matern32", theta=self.theta, variance=self.variance)

    def __repr__(self) -> str:
        return f"Matern32(theta={shown(self.theta)}, variance={shown(self.variance)})"

    def __call__(self, x: Float[Array, " d"], y: Float[Array, " d"]) -> Float[Array, ""]:
        """Covariance of the latent function at `x` and at `y`, both (d,)."""
        return self.variance.astype(x.dtype) * _matern32(6.0 * _squared(self.theta, x, y))

    def diagonal(self, x: Float[Array, " d"]) -> Float[Array, ""]:
        """The prior variance, the same everywhere. `x` (d,) -> a scalar."""
        return self.variance.astype(x.dtype)


Stationary = RBF | Matern32
"""Kernels of the distance theta |x - x'|^2 alone."""


def _squared(theta: Float[Array, "*d"], x: Float[Array, " d"], y: Float[Array, " d"]) -> Float[Array, ""]:
    """theta |x - y|^2, summed coordinate by coordinate: under vmap this becomes one fused loop over pairs, about three
    times faster than a reduction over an axis of length d, and it keeps the digits that |x|^2 + |y|^2 - 2xy would lose.
    """
    theta = jnp.broadcast_to(theta, x.shape).astype(x.dtype)
    return sum((theta[i] * (x[i] - y[i]) ** 2 for i in range(1, x.shape[0])), theta[0] * (x[0] - y[0]) ** 2)


# With r = s^2 the correlation has the slope -exp(-s) / 2, and that has exp(-s) / (4 s): infinite where both points are
# the same, where it is multiplied by the slope of r, which is 0. Both are written down, so that AD meets no 0 * inf.


@jax.custom_jvp
def _matern32(r: Float[Array, ""]) -> Float[Array, ""]:
    root = jnp.sqrt(r)
    return (1.0 + root) * jnp.exp(-root)


@_matern32.defjvp
def _matern32_jvp(primals, tangents):
    return _matern32(*primals), _matern32_slope(*primals) * tangents[0]


@jax.custom_jvp
def _matern32_slope(r: Float[Array, ""]) -> Float[Array, ""]:
    return -0.5 * jnp.exp(-jnp.sqrt(r))


@_matern32_slope.defjvp
def _matern32_slope_jvp(primals, tangents):
    (r,) = primals
    apart = r > 0
    root = jnp.sqrt(jnp.where(apart, r, 1.0))
    return _matern32_slope(r), jnp.where(apart, jnp.exp(-root) / (4.0 * root), 0.0) * tangents[0]


def gram(kernel: Kernel, x: Float[Array, "n d"], y: Float[Array, "m d"]) -> Float[Array, "n m"]:
    """Matrix of covariances between the rows of `x` and the rows of `y`.

    (n, d), (m, d) -> (n, m), in the units of the latent function squared.
    """
    return jax.vmap(lambda p: jax.vmap(lambda r: kernel(p, r))(y))(x)


def _float_dtype(value: ArrayLike | Sequence[float | int]) -> jnp.dtype:
    """The dtype of an inexact array; the default float dtype for Python numbers, integers and sequences."""
    dtype = getattr(value, "dtype", None)
    return jnp.dtype(dtype if dtype is not None and jnp.issubdtype(dtype, jnp.floating) else jnp.result_type(float))
