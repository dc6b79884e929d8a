"""Expectation propagation for latent values with a Gaussian prior and a product of pointwise likelihood terms.

Model: eta ~ N(0, K), p(data | eta) = prod_i p_i(eta_i), each log-concave. The posterior is approximated by a Gaussian
that has the mean and the variance of every *tilted* distribution p_i(eta_i) N(eta_i; m_i, v_i), where the cavity N(m_i,
v_i) is the approximate distribution of eta_i given all other responses. A term has to provide L_i(m, v) = log of the
integral of p_i(eta) N(eta; m, v), its slope a_i = dL_i/dm, and the precision t_i >= 0 of the Gaussian site that stands
for it. With these the fixed point reads

    m + v a = K a  (the means agree),      v_i = s_i / (1 - t_i s_i),  s = diag (K^-1 + T)^-1  (the variances agree),

that is, the posterior N(K a, K - K C K), C = (K + 1/T)^-1, has Laplace's form with a for the slopes and t for the
curvatures, and `predict`, the committee machine and the acquisition work on it unchanged. The log evidence is

    log Z = sum_i [L_i + log(1 + t_i v_i) / 2] - a'm / 2 - log|I + KT| / 2,

Rasmussen & Williams' (3.65) without its differences of large terms, and without 1/t, so that t = 0 is no special case.

- Coordinates as in `laplace`: eta = R w, R the eigenvector root of K, and only I + R'TR >= 1 is factorised. K may be
  singular (repeated stimuli); nothing is added to it.
- The search begins at Laplace's mode, which is near, or at `start`, and with S = K - K C K, which needs no root. Where
  it does not end below the tolerance it restarts with R and from the prior; where S lost digits it continues with R.
- For given v the means are the maximum of a concave function, so that only v needs a careful search. Far from the fixed
  point damped parallel updates, near it Newton's steps in (m, v), the mean eliminated: n unknowns. A Newton step that
  does not halve the mismatch returns the search to updates, which are damped more the longer they take.
- Derivatives by the implicit function theorem with the matrix of the Newton steps. The evidence is stationary in the
  sites, so that its gradient, a'dK a / 2 - tr(C dK) / 2 + sum_i dL_i, needs none of them.

References: Minka (2001), UAI; Rasmussen & Williams (2006), section 3.6; Seeger (2005), "Expectation propagation for
exponential families". The elimination of the mean is derived in docs/design.md, "Expectation propagation".
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from hilbo.gaussian import (
    GaussianPosterior,
    Matrix,
    Scalar,
    Vector,
    certify,
    factor,
    inverse_and_log_determinant,
    square_root,
    still,
)
from hilbo.inference.ep_search import Found, find
from hilbo.inference.ep_sites import Joint, Sites, Tilted, coupling, joint_of, sites_of
from hilbo.numerics.linalg import one_at_a_time

__all__ = ["ep", "fixed_point", "gaussian", "inverse_of", "joint_at"]


def ep(covariance: Matrix, terms: Tilted, *, start: Vector | None = None, max_steps: int = 200) -> GaussianPosterior:
    """Approximate p(eta | data) by the Gaussian that matches the tilted moments (expectation propagation).

    **Arguments:**

    - `covariance`: K, (n, n), symmetric, positive semi-definite. Terms that always return 0 (padding) change nothing.
    - `terms`: cavity means and variances (n,) -> L, slopes and precisions, (n,) each; a pytree (e.g. an `eqx.Module`)
      if it contains arrays that are traced.
    - `start`: `weights` (n,) of an earlier, similar fit (also Laplace's); changes the number of steps, not the result.
    - `max_steps`: largest number of steps of each search.

    **Returns:** the posterior in the record of [`laplace`][hilbo.laplace.laplace]: `mode` is its mean, `weights` are
    the slopes a. Differentiable in `covariance` and in the arrays of `terms`. Never raises: check
    `certificate.converged`. In the certificate, `residual` is the largest mismatch of a mean, in prior standard
    deviations, or of a log variance, whichever is larger relative to its tolerance.
    """
    return gaussian(terms, covariance, *fixed_point(terms, covariance, start, max_steps))


def gaussian(terms: Tilted, covariance: Matrix, mean: Vector, variance: Vector, cavities: Found) -> GaussianPosterior:
    """Posterior and certificate for given cavities, such as those at which `fixed_point` ended.

    `mean`, `variance` (n,): of the cavities; `cavities`: record of their search, for the certificate.
    """
    _, slope, precision = terms(mean, variance)
    inverse, _ = inverse_and_log_determinant(covariance, precision)
    log_evidence = _log_evidence(terms, covariance, mean, variance)
    fixed = jax.lax.stop_gradient((covariance, precision))
    root, condition = factor(*fixed)
    terms, (fixed_mean, fixed_variance, weights) = still(terms), jax.lax.stop_gradient((mean, variance, slope))
    certificate = certify(
        fixed[0],
        fixed_mean + fixed_variance * weights,
        weights,
        fixed[1],
        root,
        lambda eta: terms(eta - fixed_variance * weights, fixed_variance)[2],
        jax.lax.stop_gradient(log_evidence),
        residual=cavities.residual,
        tolerance=cavities.tolerance,
        iterations=cavities.iterations,
        jitter=cavities.changed / jnp.max(jnp.diagonal(fixed[0])),
        condition=condition,
    )
    return GaussianPosterior(covariance @ slope, slope, root, inverse, log_evidence, jax.lax.stop_gradient(certificate))


# --- the fixed point


@eqx.filter_custom_jvp
def fixed_point(
    terms: Tilted, covariance: Matrix, start: Vector | None, max_steps: int
) -> tuple[Vector, Vector, Found]:
    """Cavity means and variances (n,) at the fixed point, and the record of the search, which may not have converged.

    `start`: weights (n,), or None for Laplace's mode; `max_steps`: of each search. Means and variances are
    differentiable in the arrays of `terms` and in `covariance`.
    """
    return find(terms, covariance, start, max_steps)


@jax.custom_jvp
def _joint(covariance: Matrix, precision: Vector, root: Matrix) -> Matrix:
    """S = (K^-1 + T)^-1, (n, n), from a root R of K, without the cancellation in K - K C K.

    `precision` (n,): T. Differentiable in `covariance` and `precision`; the root must be that of `covariance` and needs
    no derivative.
    """
    return joint_of(covariance, root, precision).covariance


@_joint.defjvp
def _joint_jvp(primals: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple[Matrix, Matrix]:
    """Result of `_joint` and its tangent dS = (I - S T) dK (I - S T)' - S dT S."""
    joint = _joint(*primals)
    transfer = jnp.eye(joint.shape[0], dtype=joint.dtype) - joint * primals[1][None, :]
    return joint, transfer @ tangents[0] @ transfer.T - (joint * tangents[1][None, :]) @ joint


def joint_at(covariance: Matrix, sites: Sites, variance: Vector) -> tuple[Joint, Matrix]:
    """Joint posterior at the fixed point, and the transfer matrix I - S T, (n, n), both in differentiable form.

    `variance` (n,): of the cavities.
    """
    root, _ = square_root(jax.lax.stop_gradient(covariance))
    joint = _joint(covariance, sites.precision, root)
    transfer = jnp.eye(variance.shape[0], dtype=variance.dtype) - joint * sites.precision[None, :]
    return Joint(joint, jnp.diagonal(joint), 1.0 / (1.0 + variance * sites.precision)), transfer


@jax.custom_jvp
@one_at_a_time
def inverse_of(matrix: Matrix) -> Matrix:
    """Inverse of a matrix (n, n), with an explicit derivative rule. A singular one gives inf or NaN."""
    return jnp.linalg.inv(matrix)


@inverse_of.defjvp
def _inverse_of_jvp(primals: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple[Matrix, Matrix]:
    """Result of `inverse_of` and its tangent -A⁻¹ dA A⁻¹."""
    inverse = inverse_of(*primals)
    return inverse, -inverse @ tangents[0] @ inverse


@fixed_point.def_jvp
def _fixed_point_jvp(primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]) -> tuple[PyTree, PyTree]:
    """Result of `fixed_point` and its tangents, by the implicit function theorem; the record of the search has none.

    With P = I - K C = I - S T both matching conditions give

        dm = W dv + (1 + v t) [P (dK a - v da) + S da],    J dv = diag(P dK P') / left^2 - Q (dt/dm (dm - W dv) + dt),

    where da and dt are the changes of slopes and precisions at fixed cavities.
    """
    terms, covariance, _, _ = primals
    mean, variance, search = fixed_point(*primals)
    sites = sites_of(terms, mean, variance)
    posterior, transfer = joint_at(covariance, sites, variance)
    joint, ratio = posterior.covariance, 1.0 / posterior.left
    follow, spread, matrix = coupling(sites, posterior, variance)

    def changes(terms, covariance):
        _, slope, precision = terms(mean, variance)
        moved = transfer @ (covariance @ sites.slope - variance * slope) + joint @ slope
        return moved, precision, jnp.sum((transfer @ covariance) * transfer, axis=1)

    values, tangent = eqx.filter_jvp(changes, (terms, covariance), tangents[:2])
    # An output that does not depend on the perturbed inputs has the tangent None.
    moved, d_precision, widened = (
        jnp.zeros_like(value) if change is None else change for value, change in zip(values, tangent, strict=True)
    )
    free = ratio * moved
    dv = inverse_of(matrix) @ (widened * ratio**2 - spread @ (sites.precision_m * free + d_precision))
    return (mean, variance, search), (free + follow @ dv, dv, jax.tree.map(lambda _: None, search))


# --- the evidence


@eqx.filter_custom_jvp
def _log_evidence(terms: Tilted, covariance: Matrix, mean: Vector, variance: Vector) -> Scalar:
    """Log evidence of EP at the given cavities, whose means and variances are (n,): a scalar, in nats."""
    values, slope, precision = terms(mean, variance)
    _, log_determinant = inverse_and_log_determinant(covariance, precision)
    joined = jnp.sum(values + 0.5 * jnp.log1p(variance * precision))
    return joined - 0.5 * slope @ mean - 0.5 * log_determinant


@_log_evidence.def_jvp
def _log_evidence_jvp(primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]) -> tuple[Scalar, Scalar | None]:
    """Result of `_log_evidence` and its tangent, by the arrays of the terms and the covariance.

    Valid at the fixed point, where the evidence is stationary in the cavities, so that their tangents drop out.
    """
    terms, covariance, mean, variance = primals
    _, slope, precision = terms(mean, variance)
    inverse, _ = inverse_and_log_determinant(covariance, precision)

    def explicit(terms, covariance):
        quadratic = 0.5 * slope @ covariance @ slope - 0.5 * jnp.sum(inverse * covariance)
        return jnp.sum(terms(mean, variance)[0]) + quadratic

    _, tangent = eqx.filter_jvp(explicit, (terms, covariance), tangents[:2])
    return _log_evidence(*primals), tangent
