"""Sampling of a Gaussian confined to a box: order of the variables, minimax tilting, proposals and accepted draws.

z ~ N(0, S), S = L L', is confined to a box; x = L^-1 z. With the rows of L divided by its diagonal, the interval of
variable i in units of that diagonal is (lower_i, upper_i) minus the contribution (below x)_i of the earlier variables.
Equations and references: `hilbo.inference.exact`.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from hilbo.gaussian import Matrix, Scalar, Vector
from hilbo.numerics.linalg import cholesky, one_at_a_time, solve_lower
from hilbo.numerics.normal import HALF_LOG_2PI, excess_hazard
from hilbo.numerics.truncated_normal import confined_normal

__all__ = ["Box", "Tilt", "accepted", "ordered_box", "propose", "tilting"]


class Box(eqx.Module):
    """Box in x with ordered variables; edges and `below` (L without its diagonal) are in units of L's diagonal.

    `half` is L^-1, its columns in the caller's order, its rows 0 for rows without a response; `answered` is in the
    order of the box.
    """

    lower: Vector
    upper: Vector
    below: Matrix
    half: Matrix
    """L^-1, its columns in the caller's order, its rows 0 for rows without a response."""
    answered: Bool[Array, " n"]


class Tilt(eqx.Module):
    """Saddle point of psi: `mu`, the tilting that minimises the variation of the weights; `highest`, the upper bound
    psi* of psi(x, mu); norm of the gradient at the end, near 0 if the search converged; and number of steps.
    """

    mu: Vector
    highest: Scalar
    """psi*, upper bound of psi(x, mu)."""
    gradient: Scalar
    iterations: Int[Array, ""]


class _Ordering(NamedTuple):
    """State of the ordering: columns of the root of S, expected values, order, and flags of the ordered variables."""

    columns: Matrix
    values: Vector
    order: Int[Array, " n"]
    is_ordered: Bool[Array, " n"]


def ordered_box(covariance: Matrix, lower: Vector, upper: Vector, noise: Scalar, answered: Bool[Array, " n"]) -> Box:
    """Box with its variables in greedy order: next the least probable interval given the expected earlier values.

    `covariance` K (n, n); `lower`, `upper` (n,): edges of f + noise; `noise`: its standard deviation. Rows without a
    response come last and are unbounded.
    """
    n = covariance.shape[0]
    both = answered[:, None] & answered[None, :]
    matrix = jnp.where(both, covariance, 0.0) + jnp.diag(jnp.where(answered, noise**2, 1.0))
    lower, upper = jnp.where(answered, lower, -jnp.inf), jnp.where(answered, upper, jnp.inf)

    def next_variable(k, state: _Ordering) -> _Ordering:
        columns, values, order, is_ordered = state
        spread = jnp.sqrt(jnp.diagonal(matrix) - jnp.sum(columns**2, axis=1))
        shift = columns @ values
        edges = (lower - shift) / spread, (upper - shift) / spread
        log_mass, mean, _ = _intervals(jnp.zeros_like(shift), *edges, answered)
        row = jnp.argmin(jnp.where(is_ordered, 2.0, jnp.where(answered, log_mass, 1.0))).astype(order.dtype)
        column = (matrix[:, row] - columns @ columns[row]) / spread[row]
        column = jnp.where(is_ordered, 0.0, column).at[row].set(spread[row])
        return _Ordering(
            columns.at[:, k].set(column),
            values.at[k].set(mean[row]),
            order.at[k].set(row),
            is_ordered.at[row].set(True),
        )

    state = _Ordering(jnp.zeros_like(matrix), jnp.zeros_like(lower), jnp.zeros(n, jnp.int32), jnp.zeros(n, bool))
    order = jax.lax.fori_loop(0, n, next_variable, state).order
    root = cholesky(matrix[order][:, order])
    diagonal = jnp.diagonal(root)
    half = solve_lower(root, jnp.eye(n, dtype=root.dtype))
    answered_in_order = answered[order]
    half = jnp.zeros_like(half).at[:, order].set(jnp.where(answered_in_order[:, None], half, 0.0))
    below = jnp.tril(root / diagonal[:, None], -1)
    return Box(lower[order] / diagonal, upper[order] / diagonal, below, half, answered_in_order)


def _intervals(
    mean: Float[Array, "*n"], lower: Float[Array, "*n"], upper: Float[Array, "*n"], answered: Bool[Array, "*n"]
) -> tuple[Float[Array, "*n"], Float[Array, "*n"], Float[Array, "*n"]]:
    """Log mass of N(mean, 1) between `lower` and `upper`, and shift of the mean and reduction of the variance by
    truncation; elementwise, all 0 for rows without a response.
    """
    lower = jnp.where(answered, lower, 0.0)
    log_mass, shift, curvature = jnp.vectorize(confined_normal, signature="(),(),()->(),(),()")(
        mean, lower, jnp.where(answered, upper, jnp.inf)
    )
    return jnp.where(answered, log_mass, 0.0), jnp.where(answered, shift, 0.0), jnp.where(answered, curvature, 0.0)


class _Saddle(eqx.Module):
    """Iterate of the search for the saddle point, with Newton's step from it."""

    x: Vector
    mu: Vector
    gradient: Float[Array, " 2*n"]  # in x and in mu
    matrix: Float[Array, "2*n 2*n"]  # its derivative
    step: Float[Array, " 2*n"]
    scale: Scalar
    size: Scalar  # of the gradient
    psi: Scalar
    count: Int[Array, ""]


def tilting(box: Box, max_steps: int = 100) -> Tilt:
    """Search for the saddle point of psi by Newton's method, in at most `max_steps` steps; never raises.

    A step is shortened until the simplified step that would follow, by the same matrix, is shorter: a test that is
    invariant to the units of x and mu, which conflicting repeats stretch by sd / noise (Deuflhard 2011, 3.3).
    """
    n = box.lower.shape[0]
    initial = _saddle(box, _expected(box), jnp.zeros_like(box.lower))
    small = jnp.finfo(box.lower.dtype).eps ** 0.5

    def unfinished(state):
        return (state.count < max_steps) & (state.size > small) & (state.scale > 1e-8)

    def advance(state):
        trial = _saddle(box, state.x + state.scale * state.step[:n], state.mu + state.scale * state.step[n:])
        following = jnp.linalg.norm(_solve(state.matrix, trial.gradient))
        better = following <= (1.0 - 0.25 * state.scale) * jnp.linalg.norm(state.step)
        refused = eqx.tree_at(lambda s: s.scale, state, 0.5 * state.scale)
        taken = jax.tree.map(lambda new, old: jnp.where(better, new, old), trial, refused)
        return eqx.tree_at(lambda s: s.count, taken, state.count + 1)

    end = jax.lax.while_loop(unfinished, advance, initial)
    return Tilt(end.mu, end.psi, end.size, end.count)


def _expected(box: Box) -> Vector:
    """Initial x (n,) without tilting: each coordinate at its expected value given the earlier ones, inside the box."""

    def one(x, k):
        shift = box.below[k] @ x
        value = _intervals(shift, box.lower[k], box.upper[k], box.answered[k])[1]
        return x.at[k].set(value), None

    return jax.lax.scan(one, jnp.zeros_like(box.lower), jnp.arange(box.lower.shape[0]))[0]


def _saddle(box: Box, x: Vector, mu: Vector) -> _Saddle:
    """Iterate at the point `x`, `mu` (n,): psi, its gradient in x and in mu, and Newton's step; its step count is 0."""
    shift = box.below @ x + mu
    log_mass, mean, curvature = _intervals(shift, box.lower, box.upper, box.answered)
    a, b = box.below.T @ mean - mu, mu - x + mean
    eye = jnp.eye(x.shape[0], dtype=x.dtype)
    bent = curvature[:, None] * box.below
    matrix = jnp.block([[-box.below.T @ bent, -eye - bent.T], [-eye - bent, jnp.diag(1.0 - curvature)]])
    gradient = jnp.concatenate([a, b])
    step = -_solve(matrix, gradient)
    psi = jnp.sum(0.5 * mu**2 - mu * x + log_mass)
    size = jnp.linalg.norm(gradient)
    return _Saddle(x, mu, gradient, matrix, step, jnp.ones_like(psi), size, psi, jnp.zeros((), jnp.int32))


@one_at_a_time
def _solve(matrix: Matrix, right: Vector) -> Vector:
    """Solve a linear system by elimination: (n, n), (n,) -> (n,). A singular matrix gives inf or NaN."""
    return jnp.linalg.solve(matrix, right)


# --- sampling


def propose(box: Box, mu: Vector, uniform: Float[Array, "n N"]) -> tuple[Float[Array, "n N"], Float[Array, " N"]]:
    """Draw N samples x (n, N) from the tilted sequence of truncated normals; also return psi (N,).

    `mu` (n,): the tilting; `uniform` (n, N): numbers between 0 and 1 that determine the draws.
    """
    n, count = uniform.shape

    def one(state, k):
        x, psi = state
        shift = box.below[k] @ x + mu[k]
        value, log_mass = _confined(uniform[k], box.lower[k] - shift, box.upper[k] - shift)
        value = value + mu[k]
        return (x.at[k].set(value), psi + 0.5 * mu[k] ** 2 - mu[k] * value + log_mass), None

    start = jnp.zeros((n, count), uniform.dtype), jnp.zeros(count, uniform.dtype)
    return jax.lax.scan(one, start, jnp.arange(n))[0]


def _confined(
    uniform: Float[Array, " N"], lower: Float[Array, " N"], upper: Float[Array, " N"]
) -> tuple[Float[Array, " N"], Float[Array, " N"]]:
    """Quantile of a standard normal truncated to (lower, upper), and log of the probability of that interval; (N,)
    each.

    `uniform` (N,): levels of the quantile, 0 to 1. Reflected so that lower + upper >= 0. With Q the upper tail and R =
    Q(high) / Q(low), the quantile t has Q(t) = Q(low) (1 - u (1 - R)): by the inverse normal distribution near the
    centre, by Newton's method in log Q (three steps from a Rayleigh quantile) beyond 3.
    """
    mirrored = lower + upper < 0
    low, high = jnp.where(mirrored, -upper, lower), jnp.where(mirrored, -lower, upper)
    uniform = jnp.where(mirrored, 1.0 - uniform, uniform)
    far = low > 3.0
    bounded = ~jnp.isinf(high)
    near_low = jnp.where(far, 0.0, low)
    tail = 0.5 * jax.lax.erfc(near_low * 0.5**0.5)
    near_share = 1.0 - 0.5 * jax.lax.erfc(jnp.where(far, 1.0, high) * 0.5**0.5) / tail
    near = -jax.scipy.special.ndtri(tail * (1.0 - uniform * near_share))

    low_, high_ = jnp.where(far, low, 4.0), jnp.where(far & bounded, high, 5.0)
    hazard, hazard_high = low_ + excess_hazard(low_), high_ + excess_hazard(high_)
    ratio = jnp.exp(-0.5 * (high_ - low_) * (high_ + low_)) * hazard / hazard_high
    far_share = jnp.where(bounded, 1.0 - ratio, 1.0)
    fallen = -jnp.log1p(-uniform * far_share)  # log Q(low) - log Q(t)
    t = jnp.sqrt(low_**2 + 2.0 * fallen)
    for _ in range(3):
        hazard_t = t + excess_hazard(t)
        t = t - (fallen - 0.5 * (t - low_) * (t + low_) - jnp.log(hazard_t / hazard)) / -hazard_t
    value = jnp.where(far, t, near)
    log_near = jnp.log(tail * near_share)
    log_far = -0.5 * low_**2 - HALF_LOG_2PI - jnp.log(hazard) + jnp.log(far_share)
    return jnp.where(mirrored, -value, value), jnp.where(far, log_far, log_near)


class _Draws(NamedTuple):
    """State of the rejection sampling: accepted draws in the first `filled` rows, the others NaN."""

    key: PRNGKeyArray
    kept: Float[Array, "count n"]
    filled: Int[Array, ""]
    rounds: Int[Array, ""]


def accepted(key: PRNGKeyArray, box: Box, tilt: Tilt, count: int) -> Float[Array, "count n"]:
    """Draw `count` independent x by rejection sampling with acceptance probability exp(psi - psi*): (count, n).

    All NaN if the tilting has not converged; NaN in rows not filled after 1000 rounds. Coordinates of rows without a
    response are 0, in the order of the box.
    """
    n, batch = box.lower.shape[0], 2 * count
    tilted = tilt.gradient <= 1e-3

    def unfilled(state: _Draws):
        return (state.filled < count) & (state.rounds < 1000) & tilted

    def more_draws(state: _Draws) -> _Draws:
        key, kept, filled, rounds = state
        key, first, second = jax.random.split(key, 3)
        tiny = jnp.finfo(kept.dtype).tiny
        x, psi = propose(box, tilt.mu, jax.random.uniform(first, (n, batch), kept.dtype, minval=tiny))
        taken = jnp.log(jax.random.uniform(second, (batch,), kept.dtype, minval=tiny)) < psi - tilt.highest
        place = jnp.where(taken, filled + jnp.cumsum(taken, dtype=filled.dtype) - 1, count)
        x = jnp.where(box.answered[:, None], x, 0.0)
        filled_now = filled + jnp.sum(taken, dtype=filled.dtype)
        return _Draws(key, kept.at[place].set(x.T, mode="drop"), filled_now, rounds + 1)

    empty = jnp.full((count, n), jnp.nan, box.lower.dtype)
    initial = _Draws(key, empty, jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32))
    return jax.lax.while_loop(unfilled, more_draws, initial).kept
