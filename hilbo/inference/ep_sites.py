"""The sites of expectation propagation, the Gaussian posterior that they make, and how cavities move together.

Notation and equations are those of `hilbo.inference.ep`.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hilbo.gaussian import factorise
from hilbo.numerics.linalg import cholesky, one_at_a_time, solve_lower

__all__ = ["Joint", "Sites", "Tilted", "coupling", "joint_of", "sites_of", "solve"]

Tilted = Callable[
    [Float[Array, " n"], Float[Array, " n"]], tuple[Float[Array, " n"], Float[Array, " n"], Float[Array, " n"]]
]
"""Cavity means and variances -> L_i, its slopes in the mean, and the sites' precisions t_i >= 0, elementwise."""


class Sites(eqx.Module):
    """Slopes and precisions of the sites, and how they change with the cavities (elementwise)."""

    slope: Float[Array, " n"]
    precision: Float[Array, " n"]
    slope_v: Float[Array, " n"]
    precision_m: Float[Array, " n"]
    precision_v: Float[Array, " n"]


def sites_of(terms: Tilted, mean: Float[Array, " n"], variance: Float[Array, " n"]) -> Sites:
    """The sites that belong to these cavities, by differentiating the terms once in each direction."""
    (_, slope, precision), push = jax.linearize(terms, mean, variance)
    ones, zeros = jnp.ones_like(mean), jnp.zeros_like(mean)  # the terms are independent: one tangent serves them all
    _, _, precision_m = push(ones, zeros)
    _, slope_v, precision_v = push(zeros, ones)
    return Sites(slope, precision, slope_v, precision_m, precision_v)


class Joint(eqx.Module):
    """The Gaussian posterior of all latent values, prior and sites together."""

    covariance: Float[Array, "n n"]  # S = (K^-1 + T)^-1
    variance: Float[Array, " n"]
    left: Float[Array, " n"]  # 1 - t s: the share of the variance that is left when the site joins its cavity


def joint_of(covariance: Float[Array, "n n"], root: Float[Array, "n n"] | None, precision: Float[Array, " n"]) -> Joint:
    """S = G'G with L G = R', LL' = I + R'TR: a sum of squares, no inverse of K or T; without R, S = K - K C K."""
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


def coupling(
    sites: Sites, posterior: Joint, variance: Float[Array, " n"]
) -> tuple[Float[Array, "n n"], Float[Array, "n n"], Float[Array, "n n"]]:
    """W: how the means follow the cavity variances; Q: how these follow the precisions; J = I + Q (dt/dv + dt/dm W).

    The means' equation has the inverse diag(1 + v t) (I - S T); dv_i = -(s_i / left_i s_i)^2 sum_{j != i} S_ij^2 dt_j.
    """
    eye = jnp.eye(variance.shape[0], dtype=variance.dtype)
    moved = posterior.covariance * sites.slope_v[None, :]
    held = (eye - posterior.covariance * sites.precision[None, :]) * (variance * sites.slope_v + sites.slope)[None, :]
    follow = (1.0 + variance * sites.precision)[:, None] * (moved - held)
    spread = posterior.covariance**2 * (1.0 - eye) / (posterior.left**2)[:, None]
    matrix = eye + spread * sites.precision_v[None, :] + spread @ (sites.precision_m[:, None] * follow)
    return follow, spread, matrix


@one_at_a_time
def solve(matrix: Float[Array, "n n"], right: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """X with `matrix` X = `right`, by elimination."""
    return jnp.linalg.solve(matrix, right)
