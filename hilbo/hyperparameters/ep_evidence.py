"""Log evidence of expectation propagation as a function of a few hyperparameters: value, gradient and Hessian.

In closed form. The covariance K and the terms L depend on p hyperparameters x. In the notation of `hilbo.inference.ep`,
with C = (K + 1/T)^-1, P = I - K C, S = P K and K_k = dK/dx_k, the evidence is stationary in the cavities (m, v), so
that its gradient is

    sum_i dL_i/dx_k at fixed cavities, + a'K_k a / 2 - tr(C K_k) / 2.

The Hessian is the gradient's derivative along the fixed point, whose cavities move with x_j by m_j and v_j:

    m_j = W v_j + (1 + v t) [P (K_j a - v a_x) + S a_x],     J v_j = (1 + v t)^2 p_j - Q (dt/dm (1 + v t) [...] + t_x),

a_x and t_x being the changes of slopes and precisions at fixed cavities, p_j = diag(P K_j P'), W, Q and J those of
Newton's steps. With A_j and T_j the total changes of a and t,

    sum_i [d2L_i/dx_k dx_j + a_x m_j + (a a_x - t_x / (2 (1 + v t)^2)) v_j]
    + a'K_k A_j - p_k'T_j / 2 + [a'K_kj a - tr(C K_kj) + tr(C K_k C K_j)] / 2;

the bracket of v_j is d2L/dx dv, by the heat equation dL/dv = (a^2 + da/dm) / 2 with da/dm = -t / (1 + v t). The
extrapolated cavities are the start for the next hyperparameters: three steps instead of ten.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from hilbo.gaussian import Matrix, Vector
from hilbo.hyperparameters.laplace_evidence import Conditioned, Evidence, certified, conditioned
from hilbo.inference.ep_search import Cavities, find, residual_of
from hilbo.inference.ep_sites import Joint, Tilted, coupling, sites_of, solve

__all__ = ["ep_evidence"]

_STEPS = 200


def ep_evidence(
    covariance: Callable[[Float[Array, " k"]], Matrix],
    terms: Callable[[Float[Array, " l"]], Tilted],
    of_terms: Float[Array, " l"],
    shape: Float[Array, " k"],
    start: tuple[Vector, Vector],
) -> Evidence:
    """Value, gradient and Hessian of EP's log evidence in x = (of_terms, shape).

    `terms` is a function of the coordinates `of_terms` (l,), the `covariance` K (n, n) one of `shape` (k,). `start`:
    means and log variances (n,) of cavities from which the fixed point is searched, as in the result's `place`;
    variances that are not positive or not finite mark no start. Extrapolating logarithms saves a quarter of the steps
    that variances would take. Never raises: read `certified`.
    """
    matrix, slopes = covariance(shape), jax.jacfwd(covariance)(shape)
    tilted = terms(of_terms)
    settled = _found_fixed_point(tilted, matrix, Cavities(start[0], jnp.exp(start[1])))
    (mean, variance), post = settled.cavities, settled.post
    values, weights, precision = tilted(mean, variance)
    moves = _moves(terms, of_terms, settled.cavities, post, slopes)

    def explicit(of_terms):
        return jnp.sum(terms(of_terms)(mean, variance)[0])

    def curvature_at(eta):
        return tilted(eta - variance * weights, variance)[2]

    def paired(shape):
        return jnp.sum(covariance(shape) * pairing)

    pairing = 0.5 * (weights[:, None] * weights[None, :] - post.inverse)
    gradient = jnp.concatenate([jax.jacfwd(explicit)(of_terms), jnp.einsum("ij,ijk->k", pairing, slopes)])
    hessian = _bilinear(weights, precision, variance, moves)
    hessian = hessian.at[: of_terms.size, : of_terms.size].add(jax.jacfwd(jax.jacfwd(explicit))(of_terms))
    hessian = hessian.at[of_terms.size :, of_terms.size :].add(
        jax.jacfwd(jax.jacfwd(paired))(shape) + _trace_term(post, slopes)
    )

    joined = jnp.sum(values + 0.5 * jnp.log1p(variance * precision))
    value = joined - 0.5 * weights @ mean - 0.5 * post.log_determinant
    gaussian = mean + variance * weights, weights, precision
    sure = settled.met & certified(value, matrix, gaussian, post, curvature_at)
    place, moved = (mean, jnp.log(variance)), (moves.mean, moves.variance / variance[:, None])
    return Evidence(value, gradient, hessian, place, moved, sure)


class _Attempt(NamedTuple):
    """Result of an attempt: cavities, their posterior, whether the residual was met, and number of attempts left."""

    cavities: Cavities
    post: Conditioned
    met: Bool[Array, ""]
    left: Int[Array, ""]  # attempts


def _found_fixed_point(terms: Tilted, matrix: Matrix, start: Cavities) -> _Attempt:
    """Search for the fixed point: first a `hasty` search; if its residual, computed afterwards, is not met, a full one.

    Returns the last attempt, which may not have met its residual (`met`).
    """

    def attempt(last: _Attempt) -> _Attempt:
        mean, variance, search = find(terms, matrix, last.cavities, _STEPS, last.left == 2)
        cavities = Cavities(mean, variance)
        _, weights, precision = terms(*cavities)
        post = conditioned(matrix, precision)
        posterior = post.variance, lambda y: post.inverse @ y
        measured = residual_of(matrix, cavities, weights, precision, posterior)
        unmeasured = jnp.isinf(search.residual)
        met = jnp.where(unmeasured, measured, search.residual) <= search.tolerance
        return _Attempt(cavities, post, met, jnp.where(met | ~unmeasured, 0, last.left - 1))

    shapes = jax.eval_shape(conditioned, matrix, start.mean)
    post = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    initial = _Attempt(start, post, jnp.asarray(False), jnp.asarray(2))
    return jax.lax.while_loop(lambda last: last.left > 0, attempt, initial)


class _Moves(NamedTuple):
    """Derivatives by each hyperparameter, (n, p) each.

    Those of m, v, a (A) and t (T); at fixed cavities a_x and t_x; K_k a; p_k.
    """

    mean: Float[Array, "n p"]
    variance: Float[Array, "n p"]
    slope: Float[Array, "n p"]
    precision: Float[Array, "n p"]
    slope_x: Float[Array, "n p"]
    precision_x: Float[Array, "n p"]
    pulled: Float[Array, "n p"]
    widened: Float[Array, "n p"]


def _moves(
    terms: Callable[[Float[Array, " l"]], Tilted],
    of_terms: Float[Array, " l"],
    cavities: Cavities,
    post: Conditioned,
    slopes: Float[Array, "n n k"],
) -> _Moves:
    """Derivatives of the fixed point by the p = l + k hyperparameters, (n, p) each.

    `slopes` (n, n, k): dK/dx of the covariance's hyperparameters, which come after the terms' `of_terms` (l,).
    """
    mean, variance = cavities
    sites = sites_of(terms(of_terms), mean, variance)
    ratio = (1.0 + variance * sites.precision)[:, None]
    joint = Joint(post.covariance, post.variance, 1.0 / ratio[:, 0])
    follow, spread, matrix = coupling(sites, joint, variance)

    without = jnp.zeros((mean.size, slopes.shape[2]), mean.dtype)
    slope_x, precision_x = (
        jnp.concatenate([by_own, without], axis=1)
        for by_own in jax.jacfwd(lambda of_terms: terms(of_terms)(mean, variance)[1:])(of_terms)
    )
    fixed = jnp.zeros((mean.size, of_terms.size), mean.dtype)
    pulled = jnp.concatenate([fixed, jnp.einsum("ijk,j->ik", slopes, sites.slope)], axis=1)
    widened = [jnp.sum(post.transfer * (slopes[:, :, k] @ post.transfer), axis=0) for k in range(slopes.shape[2])]
    widened = jnp.concatenate([fixed, jnp.stack(widened, axis=1)], axis=1) if widened else fixed

    free = ratio * (post.transfer.T @ (pulled - variance[:, None] * slope_x) + post.covariance @ slope_x)
    wider = widened * ratio**2 - spread @ (sites.precision_m[:, None] * free + precision_x)
    by_variance = solve(matrix, wider)
    by_mean = free + follow @ by_variance
    slope = slope_x - sites.precision[:, None] / ratio * by_mean + sites.slope_v[:, None] * by_variance
    precision = precision_x + sites.precision_m[:, None] * by_mean + sites.precision_v[:, None] * by_variance
    return _Moves(by_mean, by_variance, slope, precision, slope_x, precision_x, pulled, widened)


def _bilinear(weights: Vector, precision: Vector, variance: Vector, moves: _Moves) -> Float[Array, "p p"]:
    """Part (p, p) of the Hessian made of products of two first derivatives of `moves`, symmetrised."""
    stretch = (1.0 + variance * precision)[:, None]
    by_variance = weights[:, None] * moves.slope_x - 0.5 * moves.precision_x / stretch**2
    by_terms = moves.slope_x.T @ moves.mean + by_variance.T @ moves.variance
    by_matrix = moves.pulled.T @ moves.slope - 0.5 * moves.widened.T @ moves.precision
    return 0.5 * (by_terms + by_matrix + (by_terms + by_matrix).T)


def _trace_term(post: Conditioned, slopes: Float[Array, "n n k"]) -> Float[Array, "k k"]:
    """Matrix (k, k) of tr(C K_k C K_j) / 2, a part of the Hessian; `slopes` (n, n, k): the K_k."""
    through = jnp.einsum("ij,jlk->kil", post.inverse, slopes)
    return 0.5 * jnp.einsum("kil,jli->kj", through, through)
