"""Gaussian approximation of a posterior, N(K a, K - K C K) with C = (K + 1/W)^-1, and its linear algebra.

Laplace's method and expectation propagation end in this form, W being curvatures or the precisions of sites. K is never
inverted, nothing is added to it, and W = 0 (padding, or an uninformative response) is no special case. At new points,
`k*` the prior covariances with eta, the mean is `k*'a` and the variance `k - k*'C k*`.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hilbo.numerics.linalg import cholesky, eigh, solve_lower
from hilbo.numerics.shown import has_values, shown

__all__ = [
    "Certificate",
    "GaussianPosterior",
    "Matrix",
    "Scalar",
    "Vector",
    "certify",
    "distance",
    "evidence_error",
    "evidence_known",
    "evidence_rounding",
    "evidence_tolerance",
    "factor",
    "factorise",
    "inverse_and_log_determinant",
    "mean_and_explained",
    "residual_tolerance",
    "shortfall",
    "square_root",
    "still",
]


def __dir__() -> list[str]:
    return __all__


Scalar = Float[Array, ""]
Vector = Float[Array, " n"]
"""One number for each latent value."""
Matrix = Float[Array, "n n"]
"""A number for each pair of latent values."""
Terms = TypeVar("Terms")
_NATS, _SHARE = 0.02, 1e-5  # absolute and relative tolerance of a log evidence
_ROUNDING_FACTORS = np.array([3.0, 5.0, 7.0, 11.0])  # factors to multiply and divide by, to provoke rounding


class Certificate(eqx.Module):
    """Convergence diagnostics of a fit; every number is measured."""

    residual: Scalar
    """|R' grad l - v| at the mode: a bound on its distance from the exact mode, in prior standard deviations."""
    tolerance: Scalar
    """Tolerance of the residual: eps^(2/3), or the rounding error of the residual itself if that is larger."""
    iterations: Int[Array, ""]
    """Newton steps taken, rejected ones included."""
    jitter: Scalar
    """Largest change of the prior covariance by its square root, over the largest prior variance; nothing is added."""
    condition: Scalar
    """Upper bound on the condition number of I + W^(1/2) K W^(1/2), the only matrix that is factorised."""
    smallest_variance: Scalar
    """Smallest posterior variance among the eta's with informative data."""
    variance_resolution: Scalar
    """Rounding error to expect in a posterior variance: eps * largest prior variance * sqrt(n)."""
    evidence_error: Scalar
    """Error of the log evidence due to the distance from the exact mode and the rounding of K a, to first order."""
    evidence_tolerance: Scalar
    """Tolerance of the evidence error: 0.02 + eps^(1/2) |log evidence|."""
    evidence_rounding: Scalar
    """Error of the log evidence due to the rounding of K."""
    converged: Bool[Array, ""]
    """residual <= tolerance, evidence_error <= evidence_tolerance, evidence_error + evidence_rounding <= 0.02 +
    max(eps^(1/2), 1e-5) |log evidence|, no variance below its resolution, all finite."""

    def __repr__(self) -> str:
        return f"Certificate({', '.join(f'{name}={shown(value)}' for name, value in vars(self).items())})"


class GaussianPosterior(eqx.Module):
    """Gaussian approximation N(mode, K - K C K) of p(eta | data), C = (K + 1/W)^-1."""

    mode: Vector
    weights: Vector
    """a = grad l at the mode; the posterior mean of any jointly Gaussian f* is k*'a."""
    factor: Matrix
    """V with V'V = C, for values; its derivative is not defined where W = 0, so it carries none."""
    inverse: Matrix
    """C, for derivatives."""
    log_evidence: Scalar
    certificate: Certificate

    def __repr__(self) -> str:
        if not has_values(self.mode, self.log_evidence) or self.mode.ndim != 1:
            return eqx.tree_pformat(self)
        return f"GaussianPosterior({self.mode.shape[0]} values, log evidence {shown(self.log_evidence)})"


def certify(
    covariance: Matrix,
    mode: Vector,
    weights: Vector,
    curvature: Vector,
    factor: Matrix,
    curvature_at: Callable[[Vector], Vector],
    log_evidence: Scalar,
    **search: Any,
) -> Certificate:
    """Compute the certificate of the posterior with these `weights` a, `curvature` W and `factor` V.

    `covariance` and `factor` (n, n); `mode`, `weights` and `curvature` (n,); `curvature_at`: eta (n,) -> W (n,);
    `search`: the fields of the certificate that the search determined, residual, tolerance, iterations, jitter and
    condition. The certificate is converged only if `mode` and K a, which predictions use and which should be equal
    except for rounding, differ by at most eps^(1/4) prior standard deviations. Never raises.
    """
    epsilon, prior = jnp.finfo(weights.dtype).eps, jnp.diagonal(covariance)
    largest, sd = jnp.max(prior), jnp.sqrt(prior)
    variance = prior - jnp.sum((factor @ covariance) ** 2, axis=0)
    post = variance, lambda y: factor.T @ (factor @ y)
    error = evidence_error(covariance, mode, weights, curvature, post, curvature_at)
    rounding = evidence_rounding(covariance, weights[None, :])
    smallest = jnp.min(jnp.where(curvature > 0, variance, largest))
    resolution = epsilon * largest * weights.shape[0] ** 0.5
    difference = jnp.abs(mode - covariance @ weights)
    met = (search["residual"] <= search["tolerance"]) & jnp.all(difference <= epsilon**0.25 * sd)
    evidence_close = evidence_known(log_evidence, error, rounding)
    return Certificate(
        **search,
        smallest_variance=smallest,
        variance_resolution=resolution,
        evidence_error=error,
        evidence_tolerance=evidence_tolerance(log_evidence),
        evidence_rounding=rounding,
        converged=met & evidence_close & (smallest >= resolution),
    )


def evidence_error(
    covariance: Matrix,
    mode: Vector,
    weights: Vector,
    curvature: Vector,
    posterior: tuple[Vector, Callable[[Float[Array, "n k"]], Float[Array, "n k"]]],
    curvature_at: Callable[[Vector], Vector],
) -> Scalar:
    """Bound, to first order, on the error of Laplace's log evidence due to an inexact `mode`: a scalar >= 0, in nats.

    `covariance` (n, n); `mode`, `weights` a and `curvature` W at the mode, (n,); `posterior`: variances (n,), and a
    function that multiplies columns (n, k) by C; `curvature_at`: eta (n,) -> W (n,).

    To first order the mode has the error d = P (K a - mode), P = (I + KW)^-1 = I - K C, plus the rounding P eps |K| |a|
    + eps |mode|. The log posterior being stationary, the sums in the log evidence change by at most sum W d^2 / 2;
    log|I + KW| / 2 changes by sum s dW / 2, s being the posterior variances, dW the change of the curvatures within d.
    Where the noise is far below the prior's standard deviation, this detects errors that a residual in units of the
    latter cannot.
    """
    epsilon, (variance, multiply_by_C) = jnp.finfo(weights.dtype).eps, posterior
    rounding = epsilon * (jnp.abs(covariance) @ jnp.abs(weights))
    steps = jnp.stack([mode - covariance @ weights, rounding], axis=1)
    mode_error = jnp.sum(jnp.abs(steps - covariance @ multiply_by_C(steps)), axis=1) + epsilon * jnp.abs(mode)
    below, above = jax.vmap(curvature_at)(jnp.stack([mode - mode_error, mode + mode_error]))
    change = jnp.maximum(jnp.abs(below - curvature), jnp.abs(above - curvature))
    return 0.5 * (jnp.sum(curvature * mode_error**2) + jnp.sum(jnp.abs(variance) * change))


def evidence_rounding(covariance: Matrix, weights: Float[Array, "k n"]) -> Scalar:
    """Error in the sum of a'K a / 2 over the rows a of `weights` due to the rounding of K: a scalar >= 0, in nats.

    Estimated by rounding K once more in several ways, and taking the differences. Equal elements of K are rounded
    alike, so contradictory responses at one point cause no error. `covariance` (n, n), `weights` (k, n).
    """
    factors = jnp.asarray(_ROUNDING_FACTORS, weights.dtype)[:, None, None]
    rounded = covariance[None, :, :] * factors / factors - covariance[None, :, :]
    return 0.5 * jnp.linalg.norm(jnp.einsum("ki,wij,kj->w", weights, rounded, weights))


def evidence_known(value: Scalar, error: Scalar, rounding: Scalar) -> Bool[Array, ""]:
    """Whether a log evidence with this `error` and `rounding` is finite and accurate enough (see [`Certificate`][]).

    All are scalars, in nats.
    """
    share = max(float(jnp.finfo(value.dtype).eps) ** 0.5, _SHARE)
    near = error + rounding <= _NATS + share * jnp.abs(value)
    return jnp.isfinite(value) & (error <= evidence_tolerance(value)) & near


def evidence_tolerance(log_evidence: Scalar) -> Scalar:
    """Tolerance of a log evidence: 0.02 + eps^(1/2) |log evidence|. Scalars, in nats."""
    return _NATS + jnp.finfo(log_evidence.dtype).eps ** 0.5 * jnp.abs(log_evidence)


def distance(off: Float[Array, "..."], moved: Float[Array, "..."]) -> Scalar:
    """Upper bound sqrt(|off| |K off|) of sqrt(off' K off), the distance of weights a from the mode in standard
    deviations of the prior: a scalar. `off` is slope - a and `moved` is K off, of one shape. Rounding does not make it
    negative.
    """
    return jnp.sqrt(jnp.linalg.norm(off) * jnp.linalg.norm(moved))


def residual_tolerance(rounding: Float[Array, "..."]) -> Float[Array, "..."]:
    """Tolerance of the residual of a search for a mode or a fixed point: 4 eps `rounding`, but at least eps^(2/3) and
    at most eps^(1/4), elementwise. `rounding`, of any shape: size of the terms whose sum is the residual; 0 if their
    rounding error is not to count.
    """
    epsilon = jnp.finfo(rounding.dtype).eps
    return jnp.clip(4.0 * epsilon * rounding, epsilon ** (2 / 3), epsilon**0.25)


def shortfall(certificate: Any, log_evidence: Scalar) -> str:
    """Explain why a certificate is not converged, with possible remedies, as the second half of a sentence.

    Such as "not found: its residual is ...; use a larger noise, float64", after which the caller names a last remedy.
    `certificate` may also be that of a sampled posterior. The values must be known, not traced.
    """
    remedy, residual = "use a larger noise, float64", f"{float(certificate.residual):.3g}"
    if not bool(certificate.residual <= certificate.tolerance) and not bool(jnp.isnan(certificate.tolerance)):
        steps, tolerance = int(certificate.iterations), float(certificate.tolerance)
        return (
            f"not found: its residual is {residual} after {steps} steps and should be at most {tolerance:.3g}; {remedy}"
        )
    if not bool(jnp.isfinite(log_evidence)):
        return (
            f"not found: its log evidence is not finite, though its residual is {residual}; check that the thresholds"
            " rise"
        )
    beginning = f"found (residual {residual}), but"
    if bool(certificate.smallest_variance < certificate.variance_resolution):
        return (
            f"{beginning} the responses leave too small a fraction of the prior variance for this precision; {remedy}"
        )
    error, rounding = certificate.evidence_error, certificate.evidence_rounding
    if not bool(evidence_known(log_evidence, error, rounding)):
        off = f"{float(error + rounding):.3g}"
        return f"{beginning} not closely enough for its evidence, whose error is up to {off}; {remedy}"
    return (
        f"{beginning} not closely enough for the mean, which comes out differently in another order of sums; {remedy}"
    )


def still(terms: Terms) -> Terms:
    """Copy of a pytree whose arrays are constants to differentiation (`stop_gradient`)."""
    return jax.tree.map(lambda leaf: jax.lax.stop_gradient(leaf) if eqx.is_array(leaf) else leaf, terms)


@jax.custom_jvp
def mean_and_explained(
    weights: Vector, factor: Matrix, inverse: Matrix, cross: Float[Array, "n m"]
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Posterior mean `k*'a` at m points, and the explained variance `k*'C k*`: prior minus posterior variance; (m,)
    each.

    The latter is a sum of squares: never negative, and without cancellation.

    **Arguments:** `weights`, `factor` and `inverse` of a posterior; `cross`, prior covariances (n, m) of eta and f*.
    The values come from `factor`, the derivatives from `inverse`.
    """
    del inverse
    # One product for both; the barrier keeps XLA from computing every covariance once more for each row of it.
    product = jnp.concatenate([factor, weights[None, :]]) @ jax.lax.optimization_barrier(cross)
    return product[-1], jnp.sum(product[:-1] ** 2, axis=0)


@mean_and_explained.defjvp
def _mean_and_explained_jvp(
    primals: tuple[Array, ...], tangents: tuple[Array, ...]
) -> tuple[tuple[Float[Array, " m"], Float[Array, " m"]], tuple[Float[Array, " m"], Float[Array, " m"]]]:
    """Result of `mean_and_explained` and its tangents, by weights, inverse and covariances, not by the factor."""
    weights, _, inverse, cross = primals
    d_weights, _, d_inverse, d_cross = tangents
    d_mean = d_weights @ cross + weights @ d_cross
    d_explained = jnp.sum((d_inverse @ cross) * cross + 2.0 * (inverse @ cross) * d_cross, axis=0)
    return mean_and_explained(*primals), (d_mean, d_explained)


def square_root(covariance: Matrix) -> tuple[Matrix, Scalar]:
    """R with R R' = K up to rounding, (n, n), and the largest absolute element of R R' - K, a scalar.

    One Cholesky step removes the component common to all eta's, the largest part of a large K; the eigenvectors of the
    rest are found to eps times a much smaller norm. The rest is positive semi-definite, so negative eigenvalues are
    rounding errors and set to 0; the resulting change of K is measured. `covariance` (n, n), of any rank.
    """
    first = covariance[0, 0]
    shared = covariance[:, 0] / jnp.sqrt(jnp.where(first > 0, first, 1.0))
    root = jnp.zeros_like(covariance).at[:, 0].set(shared)
    if covariance.shape[0] > 1:
        eigenvalues, vectors = eigh(covariance[1:, 1:] - shared[1:, None] * shared[None, 1:])
        remaining = vectors * jnp.sqrt(jnp.where(eigenvalues > 0, eigenvalues, 0.0))[None, :]
        root = root.at[1:, 1:].set(remaining)
    return root, jnp.max(jnp.abs(root @ root.T - covariance))


def factorise(covariance: Matrix, curvature: Vector) -> tuple[Vector, Matrix, Matrix]:
    """W^(1/2) as a vector (n,), B = I + W^(1/2) K W^(1/2), (n, n), and its lower Cholesky factor L, (n, n).

    `covariance` K (n, n), `curvature` W >= 0 (n,).
    """
    root = jnp.sqrt(curvature)
    matrix = jnp.eye(root.shape[0], dtype=root.dtype) + root[:, None] * covariance * root[None, :]
    return root, matrix, cholesky(matrix)


def factor(covariance: Matrix, curvature: Vector) -> tuple[Matrix, Scalar]:
    """V = L^-1 W^(1/2) with B = L L', so that V'V = C; and an upper bound on the condition number of B.

    The bound is the Frobenius norm of B, whose eigenvalues are >= 1. `covariance` K (n, n), `curvature` W (n,) -> (n,
    n) and a scalar.
    """
    root, matrix, lower = factorise(covariance, curvature)
    return solve_lower(lower, jnp.diag(root)), jnp.linalg.norm(matrix)


@jax.custom_jvp
def inverse_and_log_determinant(covariance: Matrix, curvature: Vector) -> tuple[Matrix, Scalar]:
    """C = (K + 1/W)^-1, and log|I + K W|. `covariance` K (n, n), `curvature` W (n,) -> (n, n) and a scalar."""
    root, _, lower = factorise(covariance, curvature)
    factor = solve_lower(lower, jnp.diag(root))
    return factor.T @ factor, 2.0 * jnp.sum(jnp.log(jnp.diagonal(lower)))


@inverse_and_log_determinant.defjvp
def _inverse_and_log_determinant_jvp(
    primals: tuple[Array, ...], tangents: tuple[Array, ...]
) -> tuple[tuple[Matrix, Scalar], tuple[Matrix, Scalar]]:
    """Result of `inverse_and_log_determinant` and its tangents.

    With T = I - C K: dC = -C dK C + T dW T' and d log|B| = tr(C dK) + tr(K T dW); no 1/W, no W^(1/2).
    """
    covariance, _ = primals
    d_covariance, d_curvature = tangents
    inverse, log_determinant = inverse_and_log_determinant(*primals)
    transfer = jnp.eye(inverse.shape[0], dtype=inverse.dtype) - inverse @ covariance
    d_inverse = (transfer * d_curvature[None, :]) @ transfer.T - inverse @ d_covariance @ inverse
    posterior_variance = jnp.sum(covariance * transfer.T, axis=1)
    d_log_determinant = jnp.sum(inverse * d_covariance) + posterior_variance @ d_curvature
    return (inverse, log_determinant), (d_inverse, d_log_determinant)
