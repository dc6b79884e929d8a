"""Projection onto a polytope in any quadratic metric, for searches between linear walls.

    minimise (v - target)' (spread spread')^-1 (v - target)   where   normals v <= offsets,   offsets >= 0

Dual active-set method: starting from the target, the most violated wall enters the active set; walls whose multipliers
would become negative leave it. The result is exact, including faces, edges and vertices, and redundant walls are
harmless. Reference: Goldfarb & Idnani (1983), Math. Programming 27:1.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from hilbo.numerics.linalg import cholesky, eigh, solve_lower, solve_lower_transposed

__all__ = ["Nearest", "Polytope", "nearest", "projector", "walls_of_cube"]

_ROUNDING = 64.0  # tolerated violation of a wall, in eps times the length of its normal
_DEPENDENT = 1e-10  # fraction of a normal's squared length outside the span of the others, below which it is dependent
_STEPS = 4  # for each wall, as a limit in case rounding causes a cycle


class Polytope(NamedTuple):
    """Polytope of the points w (d,) with `normals` (k, d) w <= `offsets` (k,); normals of length 1."""

    normals: Float[Array, "k d"]
    offsets: Float[Array, " k"]


class Nearest(NamedTuple):
    """Nearest point (d,), and the multipliers (k,) of the walls, positive for active ones."""

    point: Float[Array, " d"]
    multipliers: Float[Array, " k"]


def walls_of_cube(walls: Polytope, held: Bool[Array, " d"], point: Float[Array, " d"]) -> Polytope:
    """The walls and those of the unit cube relative to a `point`: normals v <= offsets for a step v from it.

    Returns k + 2d walls; the `held` coordinates of their normals are 0. Negative offsets (a point slightly outside)
    become 0.
    """
    unit = jnp.eye(point.size, dtype=point.dtype)
    free = jnp.where(held, 0.0, 1.0).astype(point.dtype)
    normals = jnp.concatenate([walls.normals.astype(point.dtype), unit, -unit]) * free[None, :]
    left = walls.offsets.astype(point.dtype) - walls.normals.astype(point.dtype) @ point
    return Polytope(normals, jnp.maximum(jnp.concatenate([left, 1.0 - point, point]), 0.0))


def projector(normals: Float[Array, "k d"], active: Bool[Array, " k"]) -> Float[Array, "d d"]:
    """Matrix (d, d) that removes the components of a vector along the normals of the active walls."""
    rows = jnp.where(active[:, None], normals, 0.0)
    eigenvalues, vectors = eigh(rows.T @ rows)
    free = jnp.where((eigenvalues <= _DEPENDENT)[None, :], vectors, 0.0)
    return free @ free.T


class _Turned(NamedTuple):
    """Walls in coordinates in which the metric is Euclidean."""

    normals: Float[Array, "k d"]
    sizes: Float[Array, " k"]  # of the normals
    usable: Bool[Array, " k"]  # walls with a normal
    beyond: Float[Array, " k"]  # how far the target is beyond each wall
    tolerance: Float[Array, " k"]

    def violations(self, multipliers: Float[Array, " k"]) -> Float[Array, " k"]:
        """Signed violation (k,) of each wall at the point with these multipliers; positive outside the polytope."""
        return self.beyond - self.normals @ (self.normals.T @ multipliers)


class _State(NamedTuple):
    """State of the active-set method."""

    active: Bool[Array, " k"]
    multipliers: Float[Array, " k"]
    entering: Int[Array, ""]  # index of the wall that is being taken in, -1: the next is to be chosen
    count: Int[Array, ""]


def nearest(walls: Polytope, target: Float[Array, " d"], spread: Float[Array, "d d"]) -> Nearest:
    """Project the target onto the polytope, which must contain 0.

    `spread` is a square root of the inverse metric, the identity for the Euclidean one. Stops after a fixed number of
    steps, without an error, if rounding causes a cycle.
    """
    normals = walls.normals @ spread
    sizes = jnp.sqrt(jnp.sum(normals**2, axis=1))
    eps = jnp.finfo(target.dtype).eps
    tolerance = _ROUNDING * eps * (1.0 + jnp.sqrt(jnp.sum(walls.normals**2, axis=1)))
    turned = _Turned(normals, sizes, sizes > 0.0, walls.normals @ target - walls.offsets, tolerance)

    def going(state):
        wrong = jnp.where(turned.usable & ~state.active, turned.violations(state.multipliers) - tolerance, -1.0)
        return ((state.entering >= 0) | jnp.any(wrong > 0.0)) & (state.count < _STEPS * len(walls.offsets))

    none = jnp.zeros(len(walls.offsets), target.dtype)
    start = _State(none > 0, none, jnp.asarray(-1, jnp.int32), jnp.asarray(0, jnp.int32))
    multipliers = jax.lax.while_loop(going, lambda state: _step(turned, state), start).multipliers
    return Nearest(target - spread @ (normals.T @ multipliers), multipliers)


def _step(turned: _Turned, state: _State) -> _State:
    """One step towards the entering wall: until it is reached, or until an active wall has to leave the set.

    If no wall is entering, the most violated one is chosen first.
    """
    left = turned.violations(state.multipliers)
    entering = jnp.where(state.entering >= 0, state.entering, _worst(turned, state, left))
    normal = turned.normals[entering]
    share = _in_the_span_of(turned.normals, state.active, normal)
    outside = normal - turned.normals.T @ share
    square = outside @ outside
    blocked = state.active & (share > 0.0)
    lengths = jnp.where(blocked, state.multipliers / jnp.where(blocked, share, 1.0), jnp.inf)
    partial = jnp.min(lengths)
    free = square > _DEPENDENT * (normal @ normal)
    full = jnp.where(free, left[entering] / jnp.where(free, square, 1.0), jnp.inf)
    length = jnp.minimum(partial, full)
    ends = ~jnp.isfinite(length)  # a wall that no point can keep: rounding alone
    length = jnp.where(ends, 0.0, length)
    multipliers = (state.multipliers - length * share).at[entering].add(length)
    whole = full <= partial
    active = jnp.where(whole, state.active.at[entering].set(~ends), state.active.at[jnp.argmin(lengths)].set(False))
    kept = active | (jnp.arange(len(active), dtype=entering.dtype) == entering)
    multipliers = jnp.where(kept, jnp.maximum(multipliers, 0.0), 0.0)
    count = jnp.where(ends, _STEPS * len(active), state.count + 1)
    return _State(active, multipliers, jnp.where(whole | ends, -1, entering), count)


def _worst(turned: _Turned, state: _State, left: Float[Array, " k"]) -> Int[Array, ""]:
    """Index of the most violated inactive wall; `left`: violation (k,) of each, still to be divided by `sizes`."""
    violated = turned.usable & ~state.active & (left > turned.tolerance)
    worst = jnp.argmax(jnp.where(violated, left / jnp.where(turned.usable, turned.sizes, 1.0), -jnp.inf))
    return worst.astype(state.entering.dtype)


def _in_the_span_of(
    normals: Float[Array, "k d"], active: Bool[Array, " k"], normal: Float[Array, " d"]
) -> Float[Array, " k"]:
    """Coefficients (k,) of the active normals whose combination is nearest to `normal` (least squares); else 0."""
    rows = jnp.where(active[:, None], normals, 0.0)
    gram = rows @ rows.T + jnp.diag(jnp.where(active, 0.0, 1.0).astype(rows.dtype))
    factor = cholesky(gram)
    right = rows @ normal
    return jnp.where(active, solve_lower_transposed(factor, solve_lower(factor, right[:, None]))[:, 0], 0.0)
