"""Expectation propagation corrected by the leading terms of its error.

EP replaces each tilted distribution by a normal with the same mean and variance. Its error starts with the third
cumulants of the tilted distributions, for pairs of observations. With a, t, m, v, S and C as in `hilbo.inference.ep`
and e_i = dt_i/dm (1 + v_i t_i), which is minus the third cumulant over the third power of the variance,

    log Z = EP's + R,      R = 1/12 sum_{i != j} e_i e_j S_ij^3.

Under the true posterior log Z, as a function of the prior mean h at the observed points, has the slope K^-1 (E f - h)
and the second derivative -C; these give the corrected mean and covariance without further moments:

    a becomes a + dR/dh,       C becomes -d2 log Z_EP / dh2 = C - (I - T S) e (I + V)^-1 ... e (I - S T) / 2,

the latter EP's linear response: the derivative of its mean by h, including the cavities. Both come from the matrix
J of EP's Newton steps in one inversion, so that the correction costs little more than two more steps. For Gaussian
terms e = 0, and nothing changes. For many identical responses the series converges slowly; `docs/methods/inference.md`
has the errors.

References: Opper, Paquet & Winther (2013), JMLR 14:2857, equations for R at second order in the third cumulants; Opper
& Winther (2005), JMLR 6:2177, for linear response.
"""

import equinox as eqx
import jax
import jax.numpy as jnp

from hilbo.gaussian import GaussianPosterior, Matrix, Scalar, Vector
from hilbo.inference.ep import fixed_point, gaussian, inverse_of, joint_at
from hilbo.inference.ep_sites import Tilted, coupling, sites_of
from hilbo.numerics.linalg import cholesky

__all__ = ["ep_corrected"]


def ep_corrected(
    covariance: Matrix, terms: Tilted, *, start: Vector | None = None, max_steps: int = 200
) -> GaussianPosterior:
    """Expectation propagation with evidence and means corrected to second order, and covariances by linear response.

    Arguments, certificate and derivatives as in [`ep`][hilbo.inference.ep.ep]. Also not converged if the corrected
    covariance is not positive definite.
    """
    mean, variance, search = fixed_point(terms, covariance, start, max_steps)
    uncorrected = gaussian(terms, covariance, mean, variance, search)
    sites = sites_of(terms, mean, variance)
    posterior, transfer = joint_at(covariance, sites, variance)
    follow, spread, matrix = coupling(sites, posterior, variance)
    response = inverse_of(matrix)
    skew, skew_slopes = _skewness(terms, mean, variance)
    cumulants = _Cumulants(skew, skew_slopes, posterior.covariance, sites.precision_m, sites.precision_v)

    r_mean, r_variance = _correction_slopes(cumulants)
    through = spread.T @ (response.T @ (follow.T @ r_mean + r_variance))
    weights = uncorrected.weights + transfer.T @ (r_mean / posterior.left - skew * through)
    widened = -0.5 * posterior.left[:, None] ** 2 * (response @ spread)
    scaled = skew[:, None] * transfer
    inverse = uncorrected.inverse + scaled.T @ widened @ scaled
    root = _corrected_factor(*jax.lax.stop_gradient((uncorrected.factor, sites.precision, skew, widened)))
    log_evidence = uncorrected.log_evidence + _correction(cumulants)
    finite = jnp.all(jnp.isfinite(root)) & jnp.isfinite(log_evidence)
    certificate = eqx.tree_at(
        lambda c: c.converged, uncorrected.certificate, uncorrected.certificate.converged & finite
    )
    return GaussianPosterior(covariance @ weights, weights, root, inverse, log_evidence, certificate)


class _Cumulants(eqx.Module):
    """Inputs of the correction: e and its slopes (in mean and variance), S, and the slopes of t by mean and
    variance.
    """

    skew: Vector
    skew_slopes: tuple[Vector, Vector]
    covariance: Matrix
    precision_m: Vector
    precision_v: Vector


def _skewness(terms: Tilted, mean: Vector, variance: Vector) -> tuple[Vector, tuple[Vector, Vector]]:
    """e (n,), and its slopes (n,) in cavity mean and variance; `mean`, `variance` (n,): of the cavities."""

    def skew(mean: Vector, variance: Vector) -> Vector:
        (_, _, precision), (_, _, slope) = jax.jvp(lambda m: terms(m, variance), (mean,), (jnp.ones_like(mean),))
        return slope * (1.0 + variance * precision)

    value, push = jax.linearize(skew, mean, variance)
    ones, zeros = jnp.ones_like(mean), jnp.zeros_like(mean)
    return value, (push(ones, zeros), push(zeros, ones))


def _off_diagonal(covariance: Matrix) -> Matrix:
    """Covariances between different observations: the diagonal set to 0."""
    return covariance - jnp.diag(jnp.diagonal(covariance))


def _correction(cumulants: _Cumulants) -> Scalar:
    """R, the correction of the log evidence: a scalar, in nats."""
    return cumulants.skew @ (_off_diagonal(cumulants.covariance) ** 3 @ cumulants.skew) / 12.0


def _correction_slopes(cumulants: _Cumulants) -> tuple[Vector, Vector]:
    """dR/dm and dR/dv, (n,) each, including the part through S: dS = -S dT S."""
    covariance = _off_diagonal(cumulants.covariance)
    by_skew = covariance**3 @ cumulants.skew / 6.0
    pairs = cumulants.skew[:, None] * covariance**2 * cumulants.skew[None, :]
    by_precision = -0.25 * jnp.sum((cumulants.covariance @ pairs) * cumulants.covariance, axis=1)
    in_mean = by_skew * cumulants.skew_slopes[0] + by_precision * cumulants.precision_m
    return in_mean, by_skew * cumulants.skew_slopes[1] + by_precision * cumulants.precision_v


def _corrected_factor(factor: Matrix, precision: Vector, skew: Vector, widened: Matrix) -> Matrix:
    """V (n, n) with V'V = the corrected C: a factor of I + A X A' (near I) times EP's own `factor`, to avoid
    cancellation.

    `precision` t and `skew` e (n,); `widened` X (n, n). NaN if the corrected C is not positive definite.
    """
    informed = precision > 0
    ratio = jnp.where(informed, skew / jnp.where(informed, precision, 1.0), 0.0)
    around = factor * ratio[None, :]
    middle = jnp.eye(len(skew), dtype=skew.dtype) + around @ widened @ around.T
    return cholesky(0.5 * (middle + middle.T)).T @ factor
