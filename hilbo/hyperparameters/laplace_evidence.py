"""Laplace's log evidence as a function of a few hyperparameters: value, gradient and Hessian, in closed form.

The covariance K and the terms l depend on p hyperparameters x. With weights a for latent variables, eta = K a, the log
evidence is the value at a = g(eta; x), g the terms' slopes and W their curvatures, of

    G(a, x) = sum l - a'K a / 2 - log|I + K W| / 2.

Its Hessian is that of G + mu'(g - a) along the line a + A dx, A = da/dx, where the adjoint mu accounts for the
curvature of the weights. With S = (K^-1 + W)^-1, C = (K + 1/W)^-1, T = I - C K, s = diag(S), and for each
hyperparameter K_i = dK/dx_i,

    lambda = -T (s dW/deta) / 2,   mu = K lambda,   m_i = T'(K_i a + K dg/dx_i),   A_i = dg/dx_i - W m_i,
    w_i = dW/dx_i + (dW/deta) m_i,   t_i = diag(T'K_i T),

the second derivatives are those of <K(x), Q>, Q = a a'/2 + lambda a' - C/2, and of sum (l - s W / 2 + mu g) along eta +
m dx, plus

    lambda'(K_i A_j + K_j A_i) - A_i'K A_j + [tr(C K_i C K_j) - t_i'w_j - t_j'w_i + w_i'(S o S) w_j] / 2.

This takes four products of matrices, and two for each hyperparameter of the covariance; automatic differentiation takes
five times as long. The weights and A give the start for the mode at the next hyperparameters: two or three steps
instead of ten. Reference: Rasmussen & Williams (2006), section 5.5.1, for the gradient.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from hilbo.gaussian import Matrix, Scalar, Vector, evidence_error, evidence_known, evidence_rounding, factorise
from hilbo.laplace import Terms, find_mode
from hilbo.numerics.linalg import solve_lower

__all__ = ["Conditioned", "Evidence", "certified", "conditioned", "laplace_evidence"]


_STEPS = 200


class Evidence(NamedTuple):
    """Log evidence in p hyperparameters x, its derivatives, and the posterior at which it was computed.

    `place`: start for the next hyperparameters, Laplace's weights or means and log variances of EP's cavities, (n,);
    `moved`: its derivatives (n, p); `certified`: whether the search converged and the evidence is accurate.
    """

    value: Scalar
    gradient: Float[Array, " p"]
    hessian: Float[Array, "p p"]
    place: PyTree[Vector]
    """Laplace's weights, or means and log variances of EP's cavities; start for the next hyperparameters."""
    moved: PyTree[Float[Array, "n p"]]
    """Derivatives of `place`."""
    certified: Bool[Array, ""]


class Conditioned(NamedTuple):
    """Prior K conditioned on observations with curvatures W: C, T, S, diag(S) and log|I + KW|."""

    inverse: Matrix  # C
    transfer: Matrix  # T
    covariance: Matrix  # S
    variance: Vector
    log_determinant: Scalar


def conditioned(matrix: Matrix, curvature: Vector) -> Conditioned:
    """C = (K + 1/W)^-1, T = I - C K, S = (K^-1 + W)^-1 with its diagonal, and log|I + KW|.

    `matrix` K (n, n), `curvature` W >= 0 (n,).
    """
    root, _, lower = factorise(matrix, curvature)
    factor = solve_lower(lower, jnp.diag(root))
    through = factor @ matrix
    covariance = matrix - through.T @ through
    transfer = jnp.eye(root.size, dtype=root.dtype) - factor.T @ through
    log_determinant = 2.0 * jnp.sum(jnp.log(jnp.diagonal(lower)))
    return Conditioned(factor.T @ factor, transfer, covariance, jnp.diagonal(covariance), log_determinant)


def certified(
    value: Scalar,
    matrix: Matrix,
    at_mode: tuple[Vector, Vector, Vector],
    post: Conditioned,
    curvature_at: Callable[[Vector], Vector],
) -> Bool[Array, ""]:
    """Whether the evidence `value` is finite and accurate, and no posterior variance is below its rounding error.

    `matrix` K (n, n); `at_mode`: mode, weights, curvatures, (n,) each; `curvature_at`: eta (n,) -> curvatures (n,).
    """
    eta, weights, curvature = at_mode
    largest = jnp.max(jnp.diagonal(matrix))
    smallest = jnp.min(jnp.where(curvature > 0, post.variance, largest))
    resolved = smallest >= jnp.finfo(value.dtype).eps * largest * eta.size**0.5
    explained = post.variance, lambda y: post.inverse @ y
    error = evidence_error(matrix, eta, weights, curvature, explained, curvature_at)
    return evidence_known(value, error, evidence_rounding(matrix, weights[None, :])) & resolved


def laplace_evidence(
    covariance: Callable[[Float[Array, " k"]], Matrix],
    terms: Callable[[Float[Array, " l"]], Terms],
    of_terms: Float[Array, " l"],
    shape: Float[Array, " k"],
    start: Vector,
) -> Evidence:
    """Value, gradient and Hessian of Laplace's log evidence in x = (of_terms, shape).

    `terms` is a function of the coordinates `of_terms` (l,), the `covariance` K (n, n) one of `shape` (k,). `start`
    (n,): weights from which the mode is searched; if that fails it is searched from 0. Never raises: read `certified`.
    """
    matrix, slopes = covariance(shape), jax.jacfwd(covariance)(shape)
    pointwise = terms(of_terms)
    mode = find_mode(pointwise, matrix, start, _STEPS)
    values, weights, curvature = pointwise(mode.eta)
    post = conditioned(matrix, curvature)
    paths = _paths(terms, of_terms, mode.eta, post, slopes, (matrix, weights, curvature))

    bent = matrix @ paths.adjoint

    def along(step):
        value, slope, curved = terms(of_terms + step[: of_terms.size])(mode.eta + paths.mean @ step)
        return jnp.sum(value - 0.5 * post.variance * curved + bent * slope)

    def paired(shape):
        return jnp.sum(covariance(shape) * pairing)

    pairing = 0.5 * (weights + 2.0 * paths.adjoint)[:, None] * weights[None, :] - 0.5 * post.inverse
    no_step = jnp.zeros(of_terms.size + shape.size, mode.eta.dtype)
    first, second = jax.jacfwd(along)(no_step), jax.jacfwd(jax.jacfwd(along))(no_step)
    # `along` moves eta too: what that adds, its slope a + lambda there times m, is no part of the gradient.
    gradient = first - (weights + paths.adjoint) @ paths.mean
    gradient = gradient.at[of_terms.size :].add(jnp.einsum("ij,ijk->k", pairing, slopes))
    hessian = second + _bilinear(matrix, post, slopes, paths)
    hessian = hessian.at[of_terms.size :, of_terms.size :].add(jax.jacfwd(jax.jacfwd(paired))(shape))
    value = jnp.sum(values) - 0.5 * weights @ mode.eta - 0.5 * post.log_determinant
    sure = certified(value, matrix, (mode.eta, weights, curvature), post, lambda eta: pointwise(eta)[2])
    return Evidence(value, gradient, hessian, weights, paths.weights, (mode.residual <= mode.tolerance) & sure)


class _Paths(NamedTuple):
    """Derivatives by each hyperparameter: m, A and w, (n, p) each; and lambda."""

    mean: Float[Array, "n p"]
    weights: Float[Array, "n p"]
    curvature: Float[Array, "n p"]
    adjoint: Vector


def _paths(
    terms: Callable[[Float[Array, " l"]], Terms],
    of_terms: Float[Array, " l"],
    eta: Vector,
    post: Conditioned,
    slopes: Float[Array, "n n k"],
    posterior: tuple[Matrix, Vector, Vector],
) -> _Paths:
    """Derivatives of mode, weights and curvatures by the p = l + k hyperparameters, (n, p) each, and the adjoint (n,).

    `slopes` (n, n, k): dK/dx of the covariance's hyperparameters, which come after the terms' `of_terms` (l,);
    `posterior`: K, weights and curvatures at the mode.
    """
    matrix, weights, curvature = posterior

    def nearby(of_terms, shift):
        return terms(of_terms)(eta + shift)[1:]

    (slope_own, curvature_own), (_, bend) = (
        jax.jacfwd(nearby, argnums=side)(of_terms, jnp.zeros_like(weights[0])) for side in (0, 1)
    )
    unmoved = jnp.zeros((eta.size, slopes.shape[2]), eta.dtype)
    slope_x, curvature_x = (jnp.concatenate([by_own, unmoved], axis=1) for by_own in (slope_own, curvature_own))
    by_matrix = jnp.concatenate([matrix @ slope_own, jnp.einsum("ijk,j->ik", slopes, weights)], axis=1)
    mean = post.transfer.T @ by_matrix
    return _Paths(
        mean,
        slope_x - curvature[:, None] * mean,
        curvature_x + bend[:, None] * mean,
        -0.5 * post.transfer @ (post.variance * bend),
    )


def _bilinear(matrix: Matrix, post: Conditioned, slopes: Float[Array, "n n k"], paths: _Paths) -> Float[Array, "p p"]:
    """Part (p, p) of the Hessian made of products of two first derivatives; `matrix` K (n, n), `slopes` (n, n, k):
    dK/dx.
    """
    terms_count, count = paths.mean.shape[1] - slopes.shape[2], slopes.shape[2]
    through = [post.inverse @ slopes[:, :, k] for k in range(count)]
    narrowed = [jnp.sum(post.transfer * (slopes[:, :, k] @ post.transfer), axis=0) for k in range(count)]
    nothing = jnp.zeros_like(paths.adjoint)
    widened = jnp.stack([nothing] * terms_count + narrowed, axis=1)
    pulled = jnp.stack([nothing] * terms_count + [slopes[:, :, k] @ paths.adjoint for k in range(count)], axis=1)
    crossed = pulled.T @ paths.weights - 0.5 * widened.T @ paths.curvature
    curved = 0.5 * paths.curvature.T @ (post.covariance**2 @ paths.curvature)
    hessian = crossed + crossed.T + curved - paths.weights.T @ matrix @ paths.weights
    twice = jnp.array([[jnp.sum(a * b.T) for a in through] for b in through]) if count else jnp.zeros((0, 0))
    return hessian.at[terms_count:, terms_count:].add(0.5 * twice.astype(matrix.dtype))
