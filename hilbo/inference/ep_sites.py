"""Sites of expectation propagation, their Gaussian posterior, and the coupling of the cavities in Newton's method.

Notation and equations are those of `hilbo.inference.ep`.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hilbo.gaussian import Matrix, Vector, factorise
from hilbo.numerics.linalg import cholesky, one_at_a_time, solve_lower

__all__ = ["Joint", "Sites", "Tilted", "coupling", "joint_of", "sites_of", "solve"]

Tilted = Callable[[Vector, Vector], tuple[Vector, Vector, Vector]]
"""Cavity means and variances -> L_i, its slopes in the mean, and the sites' precisions t_i >= 0, elementwise."""


class Sites(eqx.Module):
    """Slopes and precisions of the sites, and their derivatives by the cavity means and variances (elementwise)."""

    slope: Vector
    precision: Vector
    slope_v: Vector
    precision_m: Vector
    precision_v: Vector


def sites_of(terms: Tilted, mean: Vector, variance: Vector) -> Sites:
    """Slopes, precisions and their derivatives for the given cavities, from one linearisation of the terms.

    `mean`, `variance` (n,): of the cavities.
    """
    (_, slope, precision), push = jax.linearize(terms, mean, variance)
    ones, zeros = jnp.ones_like(mean), jnp.zeros_like(mean)  # the terms are independent, so one tangent suffices
    _, _, precision_m = push(ones, zeros)
    _, slope_v, precision_v = push(zeros, ones)
    return Sites(slope, precision, slope_v, precision_m, precision_v)


class Joint(eqx.Module):
    """Gaussian posterior of all latent values: covariance S = (K^-1 + T)^-1 (n, n), its diagonal s (n,), and `left`
    (n,), 1 - t s, which is posterior over cavity variance.
    """

    covariance: Matrix  # S = (K^-1 + T)^-1
    variance: Vector
    left: Vector  # 1 - t s: posterior variance / cavity variance


def joint_of(covariance: Matrix, root: Matrix | None, precision: Vector) -> Joint:
    """Joint posterior from prior covariance K (n, n) and site precisions t (n,).

    With a root R of K: S = G'G with L G = R', LL' = I + R'TR; without (`root` None): S = K - K C K, less accurate.
    """
    if root is None:
        scale, _, lower = factorise(covariance, precision)
        through = solve_lower(lower, scale[:, None] * covariance)
        joint = covariance - through.T @ through
        variance = jnp.diagonal(covariance) - jnp.sum(through**2, axis=0)
        return Joint(joint, variance, 1.0 - precision * variance)
    matrix = jnp.eye(root.shape[0], dtype=root.dtype) + (root.T * precision[None, :]) @ root
    half = solve_lower(cholesky(matrix), root.T)
    variance = jnp.sum(half**2, axis=0)
    return Joint(half.T @ half, variance, 1.0 - precision * variance)


def coupling(sites: Sites, posterior: Joint, variance: Vector) -> tuple[Matrix, Matrix, Matrix]:
    """Matrices W, Q and J of Newton's step, (n, n) each.

    W: derivative of the means by the cavity variances; Q: minus that of these by the precisions; J = I + Q (dt/dv +
    dt/dm W). The means' equation has the inverse diag(1 + v t) (I - S T); dv_i = -(1 / left_i)^2 sum_{j != i} S_ij^2
    dt_j. `variance` (n,): of the cavities.
    """
    eye = jnp.eye(variance.shape[0], dtype=variance.dtype)
    from_slopes = posterior.covariance * sites.slope_v[None, :]
    from_transfer = (eye - posterior.covariance * sites.precision[None, :]) * (variance * sites.slope_v + sites.slope)[
        None, :
    ]
    follow = (1.0 + variance * sites.precision)[:, None] * (from_slopes - from_transfer)
    spread = posterior.covariance**2 * (1.0 - eye) / (posterior.left**2)[:, None]
    matrix = eye + spread * sites.precision_v[None, :] + spread @ (sites.precision_m[:, None] * follow)
    return follow, spread, matrix


@one_at_a_time
def solve(matrix: Matrix, right: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """Solve `matrix` X = `right` by elimination: (n, n), (n, ...) -> (n, ...). A singular matrix gives inf or NaN."""
    return jnp.linalg.solve(matrix, right)
