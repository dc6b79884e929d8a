"""Covariance functions of single points; `gram` builds matrices of them by `vmap`.

    RBF:          k(x, x') = variance * exp(-theta |x - x'|^2)          (paper, section IV-3, with variance 1)
    Matern 3/2:   k(x, x') = variance * (1 + s) exp(-s),  s^2 = 6 theta |x - x'|^2

`theta` is one number, or one per dimension (automatic relevance determination). In terms of a length scale l, theta = 1
/ (2 l^2) for both. A coordinate may be categorical with k unordered levels, at 0, 1/(k-1), ..., 1: its part of theta |x
- x'|^2 is theta for different levels and 0 for equal ones. That is the squared distance of corners of a simplex, so
that the covariance stays positive definite.

Functions of the RBF are smooth everywhere; those of the Matern kernel have a slope everywhere and may bend sharply, as
a dissimilarity that grows with the distance does at its minimum. Reference: Rasmussen & Williams (2006), section 4.2.1.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Shaped

from hilbo.errors import InputError
from hilbo.numerics.shown import check_positive, float_dtype, floats, numbers, shown

__all__ = ["RBF", "Kernel", "Levels", "Matern32", "Stationary", "embedded", "gram", "theta_of"]


def __dir__() -> list[str]:
    return __all__


@runtime_checkable
class Kernel(Protocol):
    """Interface of a covariance function."""

    def __call__(self, x: Float[Array, " d"], y: Float[Array, " d"], /) -> Float[Array, ""]:
        """Covariance of the latent function at two points, (d,) each; a scalar."""
        ...

    def diagonal(self, x: Float[Array, " d"], /) -> Float[Array, ""]:
        """Prior variance of the latent function at a point: k(x, x), computed without rounding error.

        `x` (d,) -> a scalar.
        """
        ...


class RBF(eqx.Module):
    """Squared-exponential covariance, variance * exp(-theta |x - x'|^2).

    **Arguments:**

    - `theta`: inverse squared length, > 0, scalar or (d,), per squared unit of x.
    - `variance`: prior variance of the latent function, > 0.
    - `levels`: for each coordinate its number of unordered levels, 0 for a numeric one; default: all numeric.
    - `length_scale`: in place of theta, which is 1 / (2 length_scale^2).

    Raises `InputError` for numbers that are not above 0, and for both or none of theta and length_scale; traced
    negative numbers give NaN.
    """

    theta: Float[Array, "*d"]
    variance: Float[Array, ""]
    levels: tuple[int, ...] = eqx.field(static=True, default=())

    def __init__(
        self,
        theta: ArrayLike | Sequence[float | int] | None = None,
        variance: ArrayLike = 1.0,
        levels: tuple[int, ...] = (),
        *,
        length_scale: ArrayLike | Sequence[float | int] | None = None,
    ):
        if (theta is None) == (length_scale is None):
            raise InputError("RBF: give either theta or length_scale.")
        if theta is None:
            lengths = numbers("RBF", "length_scale", length_scale, float_dtype(length_scale))
            check_positive("RBF", length_scale=lengths)
            theta = 0.5 / lengths**2
        self.theta = numbers("RBF", "theta", theta, float_dtype(theta))
        self.variance = numbers("RBF", "variance", variance, float_dtype(variance))
        self.levels = levels
        check_positive("RBF", theta=self.theta, variance=self.variance)

    @property
    def length_scale(self) -> Float[Array, "*d"]:
        """Length scale of each coordinate, sqrt(1 / (2 theta)); the covariance is exp(-1/2) at this distance."""
        return jnp.sqrt(0.5 / self.theta)

    def __repr__(self) -> str:
        return f"RBF({_numbers_shown(self)})"

    def with_numbers(self, theta: ArrayLike, variance: ArrayLike) -> "RBF":
        """Kernel of the same kind and levels with another theta, a scalar or (d,), and variance, a scalar."""
        return RBF(theta, variance, self.levels)

    def __call__(self, x: Shaped[Array, " d"], y: Shaped[Array, " d"]) -> Float[Array, ""]:
        """Covariance of the latent function at `x` and at `y`, both (d,); a scalar, NaN for a negative theta or
        variance.
        """
        x, y = floats(x, self.variance.dtype), floats(y, self.variance.dtype)
        return _possible(self.variance).astype(x.dtype) * jnp.exp(-_squared(self, x, y))

    def along(self, axis: int, x: Shaped[Array, " n"], y: Shaped[Array, " m"]) -> Float[Array, "n m"]:
        """Factor (n, m) of the numeric coordinate `axis` at its values `x` (n,) and `y` (m,): exp(-theta (x_i -
        y_j)^2).

        The kernel is the product of these factors over all coordinates, times the variance. NaN for a negative theta.
        """
        theta = self.theta[axis] if self.theta.ndim else self.theta
        x, y = floats(x, theta.dtype), floats(y, theta.dtype)
        return jnp.exp(-_possible(theta).astype(x.dtype) * (x[:, None] - y[None, :]) ** 2)

    def diagonal(self, x: Shaped[Array, " d"]) -> Float[Array, ""]:
        """Prior variance at a point, which is the same everywhere. `x` (d,) -> a scalar, NaN for a negative
        variance.
        """
        return _possible(self.variance).astype(floats(x, self.variance.dtype).dtype)


class Matern32(eqx.Module):
    """Matern covariance of smoothness 3/2, variance * (1 + s) exp(-s) with s^2 = 6 theta |x - x'|^2.

    Arguments and errors as for `RBF`, theta a scalar or (d,). Twice differentiable in each point, also where both are
    equal.
    """

    theta: Float[Array, "*d"]
    variance: Float[Array, ""]
    levels: tuple[int, ...] = eqx.field(static=True, default=())

    def __init__(
        self, theta: ArrayLike | Sequence[float | int], variance: ArrayLike = 1.0, levels: tuple[int, ...] = ()
    ):
        self.theta = numbers("Matern32", "theta", theta, float_dtype(theta))
        self.variance = numbers("Matern32", "variance", variance, float_dtype(variance))
        self.levels = levels
        check_positive("Matern32", theta=self.theta, variance=self.variance)

    def __repr__(self) -> str:
        return f"Matern32({_numbers_shown(self)})"

    def with_numbers(self, theta: ArrayLike, variance: ArrayLike) -> "Matern32":
        """Kernel of the same kind and levels with another theta, a scalar or (d,), and variance, a scalar."""
        return Matern32(theta, variance, self.levels)

    def __call__(self, x: Shaped[Array, " d"], y: Shaped[Array, " d"]) -> Float[Array, ""]:
        """Covariance of the latent function at `x` and at `y`, both (d,); a scalar, NaN for a negative theta or
        variance.
        """
        x, y = floats(x, self.variance.dtype), floats(y, self.variance.dtype)
        return _possible(self.variance).astype(x.dtype) * _matern32(6.0 * _squared(self, x, y))

    def diagonal(self, x: Shaped[Array, " d"]) -> Float[Array, ""]:
        """Prior variance at a point, which is the same everywhere. `x` (d,) -> a scalar, NaN for a negative
        variance.
        """
        return _possible(self.variance).astype(floats(x, self.variance.dtype).dtype)


Stationary = RBF | Matern32
"""Kernels that depend only on the distance theta |x - x'|^2."""


class Levels(NamedTuple):
    """Categorical coordinate: number of unordered levels, and correlation of the latent function between two."""

    count: int
    correlation: float


def theta_of(kernel: type[Stationary], correlation: float) -> float:
    """theta of a categorical coordinate for which two different levels have this correlation, other coordinates equal.

    `kernel`: the class, `RBF` or `Matern32`; `correlation`: above 0 and below 1, not checked.
    """
    if kernel is RBF:
        return -math.log(correlation)
    from scipy.special import lambertw  # loaded only where a study has levels

    # (1 + s) exp(-s) = c has s = -1 - W(-c/e) on the lower branch of Lambert's function.
    return (-1.0 - float(lambertw(-correlation / math.e, -1).real)) ** 2 / 6.0


def embedded(kernel: Stationary, x: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n e"]:
    """Map points (n, d) of the unit cube to coordinates (n, e) in which the squared Euclidean distance is theta |x -
    x'|^2.

    A numeric coordinate is multiplied by the root of its theta; a categorical one of k levels becomes k coordinates,
    all 0 but that of the level, which is the root of theta / 2.
    """
    theta = np.broadcast_to(np.asarray(kernel.theta), x.shape[1])
    columns = []
    for i, count in enumerate(kernel.levels or (0,) * x.shape[1]):
        if count:
            columns.append(np.sqrt(theta[i] / 2) * np.eye(count)[np.rint(x[:, i] * (count - 1)).astype(int)])
        else:
            columns.append(x[:, i : i + 1] * np.sqrt(theta[i]))
    return np.concatenate(columns, axis=1)


def _numbers_shown(kernel: Stationary) -> str:
    """Arguments of a kernel as text for its repr: theta, variance, and levels if it has any."""
    levels = f", levels={kernel.levels}" if kernel.levels else ""
    return f"theta={shown(kernel.theta)}, variance={shown(kernel.variance)}{levels}"


def _possible(value: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """The values of a parameter, NaN where they are negative: traced values cannot raise an error."""
    return jnp.where(value < 0, jnp.nan, value)


def _squared(kernel: Stationary, x: Float[Array, " d"], y: Float[Array, " d"]) -> Float[Array, ""]:
    """Scaled squared distance theta |x - y|^2 of two points, a scalar: over categorical coordinates the sum of theta
    where the levels differ. NaN for a negative theta.

    Summed coordinate by coordinate: under vmap this becomes one fused loop over pairs, about three times faster than a
    reduction over an axis of length d, and it avoids the cancellation in |x|^2 + |y|^2 - 2xy.
    """
    theta = jnp.broadcast_to(_possible(kernel.theta), x.shape).astype(x.dtype)
    counts = kernel.levels or (0,) * x.shape[0]

    def part(i):
        if counts[i] == 0:
            return theta[i] * (x[i] - y[i]) ** 2
        steps = counts[i] - 1
        return jnp.where(jnp.round(steps * x[i]) == jnp.round(steps * y[i]), jnp.zeros_like(theta[i]), theta[i])

    return sum((part(i) for i in range(1, x.shape[0])), part(0))


# With r = s^2 the correlation has the slope -exp(-s) / 2, whose slope exp(-s) / (4 s) is infinite for equal points,
# where it is multiplied by the slope of r, which is 0. Explicit rules avoid 0 * inf in automatic differentiation.


@jax.custom_jvp
def _matern32(r: Float[Array, ""]) -> Float[Array, ""]:
    """Correlation (1 + s) exp(-s) as a function of r = s^2."""
    root = jnp.sqrt(r)
    return (1.0 + root) * jnp.exp(-root)


@_matern32.defjvp
def _matern32_jvp(primals, tangents):
    """Value of `_matern32` and its derivative along the tangent, from `_matern32_slope`; no 0 * inf at r = 0."""
    return _matern32(*primals), _matern32_slope(*primals) * tangents[0]


@jax.custom_jvp
def _matern32_slope(r: Float[Array, ""]) -> Float[Array, ""]:
    """Derivative of `_matern32` by r: -exp(-s) / 2."""
    return -0.5 * jnp.exp(-jnp.sqrt(r))


@_matern32_slope.defjvp
def _matern32_slope_jvp(primals, tangents):
    """Value of `_matern32_slope` and its derivative along the tangent: exp(-s) / (4 s) times it, taken as 0 at r =
    0.
    """
    (r,) = primals
    apart = r > 0
    root = jnp.sqrt(jnp.where(apart, r, 1.0))
    return _matern32_slope(r), jnp.where(apart, jnp.exp(-root) / (4.0 * root), 0.0) * tangents[0]


def gram(kernel: Kernel, x: Shaped[Array, "n d"], y: Shaped[Array, "m d"]) -> Float[Array, "n m"]:
    """Matrix of covariances between the rows of `x` and the rows of `y`.

    (n, d), (m, d) -> (n, m), in the units of the latent function squared.
    """
    return jax.vmap(lambda p: jax.vmap(lambda r: kernel(p, r))(y))(x)
