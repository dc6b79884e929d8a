"""The Gaussian that approximates a posterior: N(K a, K - K C K), C = (K + 1/W)^-1, and the algebra it takes.

Laplace's method and expectation propagation end in this form, W being curvatures or the precisions of sites. K is never
inverted, nothing is added to it, and W = 0 (padding, or an answer that says nothing) is no special case. At new points,
k* the prior covariances with eta, the mean is k*'a and the variance k - k*'C k*.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from hilbo.linalg import cholesky, eigh, solve_lower

__all__ = [
    "Certificate",
    "GaussianPosterior",
    "factor",
    "factorise",
    "inverse_and_log_determinant",
    "mean_and_explained",
    "square_root",
]


class Certificate(eqx.Module):
    """What a fit can say of its own accuracy; every number is measured, none assumed."""

    residual: Float[Array, ""]
    """|R' grad l - v| at the mode: a bound on its distance from the exact mode, in prior standard deviations."""
    tolerance: Float[Array, ""]
    """What the residual had to reach: eps^(2/3), or the rounding error of the residual itself where that is larger."""
    iterations: Int[Array, ""]
    """Newton steps taken, rejected ones included."""
    jitter: Float[Array, ""]
    """Largest change of the prior covariance by its square root, over the largest prior variance; nothing is added."""
    condition: Float[Array, ""]
    """Upper bound on the condition number of I + W^(1/2) K W^(1/2), the only matrix that is factorised."""
    smallest_variance: Float[Array, ""]
    """Smallest posterior variance among the eta's that the data say anything about."""
    variance_resolution: Float[Array, ""]
    """Rounding error to expect in a posterior variance: eps * largest prior variance * sqrt(n)."""
    converged: Bool[Array, ""]
    """residual <= tolerance, a finite log evidence, and no variance below its resolution."""


class GaussianPosterior(eqx.Module):
    """Gaussian approximation N(mode, K - K C K) of p(eta | data), C = (K + 1/W)^-1."""

    mode: Float[Array, " n"]
    weights: Float[Array, " n"]
    """a = grad l at the mode; the posterior mean of any jointly Gaussian f* is k*'a."""
    factor: Float[Array, "n n"]
    """V with V'V = C, for values; its derivative is not defined where W = 0, so it carries none."""
    inverse: Float[Array, "n n"]
    """C, for derivatives."""
    log_evidence: Float[Array, ""]
    certificate: Certificate


@jax.custom_jvp
def mean_and_explained(
    weights: Float[Array, " n"], factor: Float[Array, "n n"], inverse: Float[Array, "n n"], cross: Float[Array, "n m"]
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Posterior mean k*'a at m points, and k*'C k*, the prior variance less the posterior's.

    The latter is a sum of squares: never negative, with all its digits however little is explained.

    **Arguments:** `weights`, `factor` and `inverse` of a posterior; `cross`, prior covariances (n, m) of eta and f*.
    """
    del inverse
    # One product for both; the barrier keeps XLA from computing every covariance once more for each row of it.
    product = jnp.concatenate([factor, weights[None, :]]) @ jax.lax.optimization_barrier(cross)
    return product[-1], jnp.sum(product[:-1] ** 2, axis=0)


@mean_and_explained.defjvp
def _mean_and_explained_jvp(primals, tangents):
    weights, _, inverse, cross = primals
    d_weights, _, d_inverse, d_cross = tangents
    d_mean = d_weights @ cross + weights @ d_cross
    d_explained = jnp.sum((d_inverse @ cross) * cross + 2.0 * (inverse @ cross) * d_cross, axis=0)
    return mean_and_explained(*primals), (d_mean, d_explained)


def square_root(covariance: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Float[Array, ""]]:
    """R with R R' = K, and the largest element of R R' - K.

    One Cholesky step takes out what all eta's share, which is most of a large K; the eigenvectors of the rest are found
    to eps times a much smaller norm. What is left is positive semi-definite, so a negative eigenvalue is rounding and
    is dropped; what that and all other rounding did to K is measured, as the product says.
    """
    first = covariance[0, 0]
    shared = covariance[:, 0] / jnp.sqrt(jnp.where(first > 0, first, 1.0))
    root = jnp.zeros_like(covariance).at[:, 0].set(shared)
    if covariance.shape[0] > 1:
        eigenvalues, vectors = eigh(covariance[1:, 1:] - shared[1:, None] * shared[None, 1:])
        own = vectors * jnp.sqrt(jnp.where(eigenvalues > 0, eigenvalues, 0.0))[None, :]
        root = root.at[1:, 1:].set(own)
    return root, jnp.max(jnp.abs(root @ root.T - covariance))


def factorise(
    covariance: Float[Array, "n n"], curvature: Float[Array, " n"]
) -> tuple[Float[Array, " n"], Float[Array, "n n"], Float[Array, "n n"]]:
    """W^(1/2) as a vector, B = I + W^(1/2) K W^(1/2), and its Cholesky factor L."""
    root = jnp.sqrt(curvature)
    matrix = jnp.eye(root.shape[0], dtype=root.dtype) + root[:, None] * covariance * root[None, :]
    return root, matrix, cholesky(matrix)


def factor(
    covariance: Float[Array, "n n"], curvature: Float[Array, " n"]
) -> tuple[Float[Array, "n n"], Float[Array, ""]]:
    """V = L^-1 W^(1/2) with B = L L', so V'V = C; and a bound on B's condition, as B has no eigenvalue below 1."""
    root, matrix, lower = factorise(covariance, curvature)
    return solve_lower(lower, jnp.diag(root)), jnp.linalg.norm(matrix)


@jax.custom_jvp
def inverse_and_log_determinant(
    covariance: Float[Array, "n n"], curvature: Float[Array, " n"]
) -> tuple[Float[Array, "n n"], Float[Array, ""]]:
    """C, and log|B| = log|I + K W|."""
    root, _, lower = factorise(covariance, curvature)
    factor = solve_lower(lower, jnp.diag(root))
    return factor.T @ factor, 2.0 * jnp.sum(jnp.log(jnp.diagonal(lower)))


@inverse_and_log_determinant.defjvp
def _inverse_and_log_determinant_jvp(primals, tangents):
    """With T = I - C K: dC = -C dK C + T dW T' and d log|B| = tr(C dK) + tr(K T dW); no 1/W, no W^(1/2)."""
    covariance, _ = primals
    d_covariance, d_curvature = tangents
    inverse, log_determinant = inverse_and_log_determinant(*primals)
    transfer = jnp.eye(inverse.shape[0], dtype=inverse.dtype) - inverse @ covariance
    d_inverse = (transfer * d_curvature[None, :]) @ transfer.T - inverse @ d_covariance @ inverse
    posterior_variance = jnp.sum(covariance * transfer.T, axis=1)
    d_log_determinant = jnp.sum(inverse * d_covariance) + posterior_variance @ d_curvature
    return (inverse, log_determinant), (d_inverse, d_log_determinant)
