"""Exact ordinal posterior by sampling, with standard errors: the reference for the approximations.

With z = f + noise * e an ordinal response is the event that z_i lies between two thresholds. All responses together are
a box of z ~ N(0, S), S = K + noise^2 I = L L', and f given z is Gaussian, so that with x = L^-1 z

    p(responses) = P(box),   E f* = k*' L^-T E[x],   Var f* = k** - |L^-1 k*|^2 + k*' L^-T Cov[x] L^-1 k*,

expectations over the box. They are sampled by minimax exponential tilting: coordinate after coordinate, x_i is drawn
from N(mu_i, 1) truncated to the interval given the earlier coordinates, with the weight exp(psi(x, mu)),

    psi(x, mu) = sum_i [mu_i^2 / 2 - mu_i x_i + log P(N(mu_i, 1) in interval_i(x_1 .. x_{i-1}))],

concave in x and convex in mu. At its saddle point the weights vary little even for improbable boxes, and none exceeds
`exp(psi*)`, so that accepting x with probability `exp(psi - psi*)` gives independent exact draws. The variables are
ordered by the probability of their intervals, and the uniform numbers are scrambled Sobol points: independent scrambles
are the replicates from which the standard errors come.

Suitable for up to about 100 responses. Any tilting gives an unbiased result with a valid standard error; a poor one
gives a large error. References: Botev (2017), JRSS B 79:125; Genz (1992), J. Comput. Graph. Stat. 1:141; Gibson,
Glasbey & Elston (1994) for the order of the variables.
"""

from collections.abc import Callable
from typing import NoReturn

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from hilbo.errors import InputError
from hilbo.gaussian import Matrix, Scalar, Vector
from hilbo.inference.tilting import Box, Tilt, accepted, ordered_box, propose, tilting
from hilbo.numerics.linalg import eigh
from hilbo.numerics.sobol import scrambled_sobol

__all__ = ["ExactPosterior", "SamplingCertificate", "exact"]

_REPLICATES = 32


class SamplingCertificate(eqx.Module):
    """Accuracy of a sampled posterior."""

    residual: Scalar
    """The larger of the two standard errors below; infinite where the variance of f given z is below rounding."""
    tolerance: Scalar
    """Largest accepted residual: 0.02."""
    log_evidence_error: Scalar
    """Standard error of the log evidence, and a bound on its rounding: eps |log evidence| max S / min of L's diagonal
    squared, which matters for contradictory responses under a prior that is much wider than the noise."""
    mean_error: Scalar
    """Largest standard error of a latent mean at an observed point, in prior standard deviations."""
    effective_samples: Scalar
    """Squared sum of the weights over their sum of squares."""
    iterations: Int[Array, ""]
    """Newton steps to the tilting, rejected ones included."""
    jitter: Scalar
    """Largest relative amount by which a sampled variance exceeded the prior's; the excess is dropped."""
    converged: Bool[Array, ""]
    """residual <= tolerance."""


class ExactPosterior(eqx.Module):
    """Moments of p(f | responses) in the form of the other posteriors, and the samples behind them.

    `mode` (n,) is the posterior mean at the tested points; `samples` (n, R, B): x in R replicates of B samples, with
    the weights `shares` (R, B), which sum to 1.
    """

    mode: Vector
    """Posterior mean of the latent values at the observed points."""
    weights: Vector
    factor: Matrix
    inverse: Matrix
    log_evidence: Scalar
    certificate: SamplingCertificate
    samples: Float[Array, "n R B"]
    """x of every replicate, 0 in rows without a response."""
    shares: Float[Array, "R B"]
    """Normalised weight of each sample; they sum to 1."""
    box: Box
    tilt: Tilt

    def expectation(
        self, of: Callable[[Scalar, Scalar], Float[Array, "*out"]], cross: Vector, prior_variance: Scalar
    ) -> tuple[Float[Array, "*out"], Float[Array, "*out"]]:
        """Posterior expectation of a function of f* and its Monte Carlo standard error, of the function's shape.

        **Arguments:** `of`: mean and variance of a normal f* -> its expectation under that normal; `cross` (n,) and
        `prior_variance`: prior covariances of f* with the latent values, and its own variance.
        """
        along = self.box.half @ cross
        values = jax.vmap(jax.vmap(lambda mean: of(mean, prior_variance - along @ along)))(
            jnp.tensordot(along, self.samples, 1)
        )
        return _weighted(self.shares, values)

    def moment_errors(self, cross: Float[Array, "n m"]) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
        """Monte Carlo standard errors of the posterior means and variances at m points.

        `cross` (n, m): prior covariances of the tested and the new points -> (m,), (m,).
        """

        def one(along):
            values = jnp.tensordot(along, self.samples, 1)
            mean, error = _weighted(self.shares, values)
            return error, _weighted(self.shares, (values - mean) ** 2)[1]

        return jax.lax.map(one, (self.box.half @ cross).T)

    def draw(
        self, key: PRNGKeyArray, cross: Float[Array, "n m"], prior: Float[Array, "m m"], count: int
    ) -> Float[Array, "count m"]:
        """Independent exact draws (count, m) of the latent function at m points, by rejection; all NaN if the tilting
        was not found, and NaN for draws not filled after 1000 rounds of proposals.

        `cross` (n, m) and `prior` (m, m) are prior covariances with the latent values and among the m points.
        """
        accept, finish = jax.random.split(key)
        along = self.box.half @ cross
        eigenvalues, vectors = eigh(prior - along.T @ along)
        root = vectors * jnp.sqrt(jnp.where(eigenvalues > 0, eigenvalues, 0.0))[None, :]
        x = accepted(accept, self.box, self.tilt, count)
        return x @ along + jax.random.normal(finish, (count, cross.shape[1]), x.dtype) @ root.T


@eqx.filter_custom_jvp
def exact(
    key: PRNGKeyArray,
    covariance: Matrix,
    lower: Vector,
    upper: Vector,
    noise: Scalar,
    answered: Bool[Array, " n"],
    samples: int = 512 * _REPLICATES,
) -> ExactPosterior:
    """Sample the posterior of f ~ N(0, K) given that f + noise * e lies between `lower` and `upper` where `answered`.

    **Arguments:**

    - `key`: another key gives other samples, hence another error of the stated size.
    - `covariance`: K, (n, n), of any rank.
    - `lower`, `upper`: edges (n,), infinite at the ends.
    - `noise`: standard deviation of the noise, a scalar; `answered` (n,): False in rows without a response.
    - `samples`: total number, a power of 2 times 32. The error falls slightly less than in proportion to it.

    **Returns:** an [`ExactPosterior`][]; read `certificate.converged`. It has no derivatives: differentiating it raises
    `InputError`.
    """
    box = ordered_box(covariance, lower, upper, noise, answered)
    tilt = tilting(box)
    uniform = scrambled_sobol(key, _REPLICATES, samples // _REPLICATES, covariance.shape[0], covariance.dtype)
    x, psi = propose(box, tilt.mu, uniform.reshape(-1, covariance.shape[0]).T)
    x = jnp.where(box.answered[:, None], x, 0.0).reshape(-1, _REPLICATES, samples // _REPLICATES)
    relative = jnp.exp(psi - tilt.highest).reshape(x.shape[1:])
    total = jnp.sum(relative)
    shares = relative / total
    mean, _ = _weighted(shares, jnp.moveaxis(x, 0, -1))
    narrowed, excess = _narrowed(x, shares, mean, box.answered)
    factor = narrowed @ box.half
    weights = box.half.T @ mean
    log_evidence = tilt.highest + jnp.log(total / samples)
    wide = (jnp.max(jnp.diagonal(covariance)) + noise**2) * jnp.max(jnp.sum(box.half**2, axis=1))
    rounding = jnp.finfo(x.dtype).eps * wide * jnp.abs(log_evidence)
    certificate = _certificate(covariance, box, tilt, x, shares, excess, rounding)
    certificate = _checked_resolution(certificate, covariance, box.half, answered)
    return ExactPosterior(
        covariance @ weights, weights, factor, factor.T @ factor, log_evidence, certificate, x, shares, box, tilt
    )  # fmt: skip


@exact.def_jvp
def _exact_jvp(primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]) -> NoReturn:
    """Refuse differentiation: always raise `InputError`."""
    raise InputError('inference "exact" is sampled and has no derivatives; use "ep" where they are needed.')


def _narrowed(
    x: Float[Array, "n R B"], shares: Float[Array, "R B"], mean: Vector, answered: Bool[Array, " n"]
) -> tuple[Matrix, Scalar]:
    """Root (n, n) of I - Cov[x], and the largest eigenvalue of Cov[x] - I, clipped at 0, a scalar.

    The box is convex, so that any positive part is sampling error; the root is computed without it. Rows without a
    response count as 0.
    """
    centred = x - mean[:, None, None]
    lessened = jnp.diag(answered.astype(x.dtype)) - jnp.tensordot(centred * shares[None], centred, [(1, 2), (1, 2)])
    eigenvalues, vectors = eigh(lessened)
    root = jnp.sqrt(jnp.where(eigenvalues > 0, eigenvalues, 0.0))[:, None] * vectors.T
    return root, jnp.where(eigenvalues[0] < 0, -eigenvalues[0], 0.0)


def _certificate(
    covariance: Matrix,
    box: Box,
    tilt: Tilt,
    x: Float[Array, "n R B"],
    shares: Float[Array, "R B"],
    excess: Scalar,
    rounding: Scalar,
) -> SamplingCertificate:
    """Certificate of the samples `x` with the weights `shares`.

    `excess`: excess of a sampled variance over 1; `rounding`: rounding error of the log evidence.
    """
    total = jnp.sum(shares, axis=1)
    log_error = jnp.hypot(jnp.std(total, ddof=1) / jnp.mean(total) / total.shape[0] ** 0.5, rounding)
    latent = jnp.moveaxis(x, 0, -1) @ (box.half @ covariance)
    mean_error = jnp.max(_weighted(shares, latent)[1] / jnp.sqrt(jnp.diagonal(covariance)))
    worst = jnp.maximum(log_error, mean_error)
    tolerance = jnp.asarray(0.02, x.dtype)
    return SamplingCertificate(
        residual=worst,
        tolerance=tolerance,
        log_evidence_error=log_error,
        mean_error=mean_error,
        effective_samples=1.0 / jnp.sum(shares**2),
        iterations=tilt.iterations,
        jitter=excess,
        converged=worst <= tolerance,
    )


def _checked_resolution(
    certificate: SamplingCertificate, covariance: Matrix, half: Matrix, answered: Bool[Array, " n"]
) -> SamplingCertificate:
    """The certificate; with an infinite residual and not converged if rounding hides the variance of an observed value
    given z (about noise^2). `half` (n, n): L^-1.
    """
    prior = jnp.diagonal(covariance)
    variance = prior - jnp.sum((half @ covariance) ** 2, axis=0)
    resolution = jnp.finfo(prior.dtype).eps * prior.shape[0] ** 0.5 * jnp.max(prior)
    resolved = jnp.all(~answered | (variance >= resolution))
    residual = jnp.where(resolved, certificate.residual, jnp.inf)
    return eqx.tree_at(lambda c: (c.residual, c.converged), certificate, (residual, certificate.converged & resolved))


def _weighted(
    shares: Float[Array, "R B"], values: Float[Array, "R B *out"]
) -> tuple[Float[Array, "*out"], Float[Array, "*out"]]:
    """Weighted mean of `values` (R, B, ...) and its standard error, (...) each, as of a ratio of two means.

    The error comes from the differences between the R replicates. `shares` (R, B) sum to 1.
    """
    weight = shares.reshape(shares.shape + (1,) * (values.ndim - 2))
    numerator = jnp.sum(weight * values, axis=1)
    mean = jnp.sum(numerator, axis=0)
    replicates = shares.shape[0]
    denominator = jnp.sum(weight, axis=1)
    deviation = numerator - mean[None] * denominator  # in units of 1 / replicates
    return mean, jnp.sqrt(jnp.sum(deviation**2, axis=0) * replicates / (replicates - 1))
