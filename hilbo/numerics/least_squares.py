"""Nonlinear least squares in a box, for few parameters and many residuals: Levenberg-Marquardt on normal equations.

Minimise |r(q)|² over lower <= q <= upper. A step solves (JᵀJ + λ diag JᵀJ) d = -Jᵀr in the free parameters only: those
that are not at an active bound, nor fixed by lower = upper. It is cut off at the box and taken if it
improves. The Jacobian is exact (forward mode) and only its products of size (p, p) leave an evaluation, so that the
solver maps over starts, fixed values and data sets, and a fixed parameter is the same compiled function.
Normal equations square the condition number; `identification` chooses coordinates in which it is about 30.

References: Kanzow, Yamashita & Fukushima (2004), J. Comput. Appl. Math. 172:375 (projected Levenberg-Marquardt);
Nielsen (1999), IMM report 1999-05 (damping).
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from hilbo.numerics import linalg

__all__ = ["Solution", "least_squares", "solve_symmetric"]

_FIRST_DAMPING = 1e-3
_STALLED = 1e10  # a damping with which no step changes anything


class Solution(eqx.Module):
    """Result of `least_squares`: point q, |r|², JᵀJ and Jᵀr there, number of iterations, and whether it converged."""

    q: Float[Array, " p"]
    cost: Float[Array, ""]
    normal: Float[Array, "p p"]
    gradient: Float[Array, " p"]
    iterations: Int[Array, ""]
    converged: Bool[Array, ""]


class _Evaluation(NamedTuple):
    """|r|², Jᵀr and JᵀJ at a point."""

    cost: Float[Array, ""]
    gradient: Float[Array, " p"]
    normal: Float[Array, "p p"]


class _State(NamedTuple):
    """State of the iteration."""

    q: Float[Array, " p"]
    cost: Float[Array, ""]
    gradient: Float[Array, " p"]
    normal: Float[Array, "p p"]
    damping: Float[Array, ""]
    growth: Float[Array, ""]  # of the damping at the next failure
    steps: Int[Array, ""]
    done: Bool[Array, ""]


def least_squares(
    residuals: Callable[[Float[Array, " p"]], Float[Array, " m"]],
    start: Float[Array, " p"],
    lower: Float[Array, " p"],
    upper: Float[Array, " p"],
    *,
    max_steps: int = 100,
    enough: float | None = None,
) -> Solution:
    """Minimise |`residuals`(q)|² over the box from `start`; parameters with lower = upper stay there.

    Ends when a step promises to lower the cost by less than `enough` of it (eps^0.75, 2e-12 in float64, by default), or
    when rounding lets no step improve. Not converged after `max_steps`, or if residuals at the start are not finite;
    nothing is raised.
    """
    start = jnp.clip(start, lower, upper)
    eps = jnp.finfo(start.dtype).eps
    tiny, least = eps**0.6, eps**0.75 if enough is None else enough

    def evaluate(q: Float[Array, " p"]) -> _Evaluation:
        r, forward = jax.linearize(residuals, q)
        rows = jax.vmap(forward)(jnp.eye(q.size, dtype=q.dtype))
        return _Evaluation(r @ r, rows @ r, rows @ rows.T)

    def step(state: _State) -> _State:
        q = jnp.clip(state.q + _direction(state, lower, upper), lower, upper)
        return _judged(state, q, evaluate(q), tiny, least)

    cost, gradient, normal = evaluate(start)
    damping, growth = (jnp.asarray(value, start.dtype) for value in (_FIRST_DAMPING, 2))
    first = _State(start, cost, gradient, normal, damping, growth, jnp.asarray(0), ~jnp.isfinite(cost))
    last = jax.lax.while_loop(lambda state: ~state.done & (state.steps < max_steps), step, first)
    ended = last.done & jnp.isfinite(last.cost)
    return Solution(last.q, last.cost, last.normal, last.gradient, last.steps, ended)


def _judged(state: _State, q: Float[Array, " p"], trial: _Evaluation, tiny: ArrayLike, least: ArrayLike) -> _State:
    """State after the step to `q`: moved there if the cost fell, else unchanged but for a larger damping.

    `trial`: evaluation at `q`; `tiny`: relative step that counts as no step; `least`: fraction of the cost that a step
    must promise, below which the search is done.
    """
    cost, gradient, normal = trial
    moved = q - state.q
    better = cost < state.cost
    gain = -(2 * state.gradient + state.normal @ moved) @ moved  # predicted
    # A step that was cut off may promise nothing: then the damping grows until it goes downhill along the box.
    settled = ((gain >= 0) & (gain <= least * state.cost)) | jnp.all(jnp.abs(moved) <= tiny * jnp.abs(state.q))
    trust = (state.cost - cost) / gain  # 1 where the model is right
    eased = state.damping * jnp.clip(1 - (2 * trust - 1) ** 3, 0.1, 2.0)
    damping = jnp.where(better, eased, jnp.maximum(state.growth * state.damping, jnp.finfo(q.dtype).eps))
    growth = jnp.where(better, 2, 2 * state.growth)
    reached = (settled & (state.damping < 1)) | (damping > _STALLED)
    tried = _State(q, cost, gradient, normal, damping, growth, state.steps + 1, reached)
    stayed = state._replace(damping=damping, growth=growth, steps=state.steps + 1, done=reached)
    return jax.tree.map(lambda new, old: jnp.where(better, new, old), tried, stayed)


def _direction(state: _State, lower: Float[Array, " p"], upper: Float[Array, " p"]) -> Float[Array, " p"]:
    """Damped step (p,) of the free parameters; 0 for parameters that are fixed, at an active bound, or without
    effect."""
    held = ((state.q <= lower) & (state.gradient >= 0)) | ((state.q >= upper) & (state.gradient <= 0))
    free = ~held & (lower < upper)
    size = jnp.diag(state.normal)
    moves = free & (size > 0)
    both = moves[:, None] & moves[None, :]
    scale = jnp.sqrt(jnp.where(moves, size, 1))
    scaled = jnp.where(both, state.normal / (scale[:, None] * scale[None, :]), 0)
    matrix = scaled + jnp.diag(jnp.where(moves, state.damping, 1))
    return -solve_symmetric(matrix, jnp.where(moves, state.gradient / scale, 0)) / scale


def solve_symmetric(matrix: Float[Array, "p p"], right: Float[Array, " p"]) -> Float[Array, " p"]:
    """Solve matrix · x = right for a symmetric positive definite matrix; may be mapped by `vmap` (see `linalg`)."""
    factor = linalg.cholesky(matrix)
    return linalg.solve_lower_transposed(factor, linalg.solve_lower(factor, right[:, None]))[:, 0]
