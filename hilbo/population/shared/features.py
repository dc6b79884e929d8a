"""Features of a smooth function that participants share, computed from a few of the tested points (pivots).

With Z the pivots of an incomplete Cholesky factorisation of k at all tested points, L L' = k(Z, Z) and the features
phi(x) = L^-1 k(Z, x), k(x, y) = phi(x)'phi(y) up to an error that the factorisation returns. The kernels have the
variance 1 here. Reference: Harbrecht, Peters & Schneider (2012), Applied Numerical Mathematics 62:428.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from hilbo.kernels import Stationary, gram
from hilbo.numerics.tracing import program
from hilbo.population.shared.tallies import Tallies

__all__ = [
    "TOLERANCE",
    "Pivots",
    "every_point",
    "features_of",
    "pivots_for",
    "pivots_of",
    "root_of_pivots",
    "unexplained",
]

TOLERANCE = 1e-6
"""Largest part of the prior variance of g that the features may leave at an answered point."""
_ROOMS = (64, 256, 1024)  # of the programs that choose pivots
_GROWING = (128, 256, 512)  # rows for which there is room at first in such a program
_BLOCK, _DISTINCT = 64, 64  # of the sizes of records of all points; eps times it is left of a point that adds nothing
_RANKS = (32, 64, 128, 256, 640, 1024)  # 640: all points of 24 people with 25 answers


class Pivots(NamedTuple):
    """Tested points (r, d) from which the shared function is known.

    `used` (r,): False in rows that are padding, or points that the others explain to rounding; `carry` (r,): rows that
    receive the weights of the responses given there; `left`: largest part of g's prior variance at a tested point that
    the pivots do not explain.
    """

    points: Float[Array, "r d"]
    used: Bool[Array, " r"]
    carry: Bool[Array, " r"]
    """Those with the weights of the responses that were given there: the used ones, and of `every_point` all."""
    left: Float[Array, ""]
    """Largest part of the prior variance of g, at an answered point, that they do not explain."""


def pivots_of(
    kernel: Stationary, answers: Tallies, room: int, tolerance: ArrayLike, most: ArrayLike | None = None
) -> Pivots:
    """Choose pivots among the tested points, each where the earlier ones explain least, until at most `tolerance` of
    the prior variance is left, or `room` or `most` are chosen.

    Returns a record with `room` rows. Can be traced.
    """
    x = answers.x.reshape(-1, answers.x.shape[-1])
    rows, left = _chosen(kernel, x, answers.asked.reshape(-1), room, tolerance, most)
    used = rows >= 0
    return Pivots(x[jnp.where(used, rows, 0)], used, used, left)


def _chosen(
    kernel: Stationary,
    x: Float[Array, "N d"],
    asked: Bool[Array, " N"],
    room: int,
    tolerance: ArrayLike,
    most: ArrayLike | None = None,
) -> tuple[Int[Array, "{room}"], Float[Array, ""]]:
    """Rows of `x` that are chosen as pivots, (room,), -1 after the last; and the largest unexplained part of the
    variance, a scalar.

    `asked` (N,): which rows are tested points; other arguments as for `pivots_of`.
    """
    largest = room if most is None else jnp.minimum(room, most)

    def choose(state):
        count, rows, left, chosen = state
        place = jnp.argmax(left)
        column = jax.vmap(lambda y: kernel(x[place], y))(x)
        row = (column - rows[:, place] @ rows) / jnp.sqrt(left[place])
        return count + 1, rows.at[count].set(row), (left - row**2).at[place].set(0.0), chosen.at[count].set(place)

    state = (jnp.asarray(0), jnp.zeros((0, x.shape[0]), x.dtype), asked.astype(x.dtype), jnp.full(room, -1))
    for size in (*(size for size in _GROWING if size < room), room):  # a step costs as much as there is room for rows
        count, rows, *others = state
        state = (count, jnp.pad(rows, ((0, size - len(rows)), (0, 0))), *others)
        limit = jnp.minimum(size, largest)
        state = jax.lax.while_loop(lambda s, limit=limit: (s[0] < limit) & (jnp.max(s[2]) > tolerance), choose, state)
    _, _, left, chosen = state
    return chosen, jnp.max(left)


_pivots_of = program(pivots_of)
_rows_of = program(_chosen)


def pivots_for(
    kernel: Stationary, answers: Tallies, tolerance: float = TOLERANCE, fewest: int = 0, most: int = _RANKS[-1]
) -> Pivots:
    """`pivots_of`, with a record of the smallest of a few sizes that fits the pivots and `fewest` rows; compiled
    functions exist for each size.

    `most`: largest number of pivots, with which more than `tolerance` may be left. Not under `jit`.
    """
    enough = min(int(np.asarray(answers.asked).sum()), most)
    for room in _ROOMS:
        pivots = _pivots_of(kernel, answers, room, jnp.asarray(tolerance), jnp.asarray(most))
        used = int(pivots.used.sum())
        if room >= enough or used < room:
            break
    rank = next(rank for rank in _RANKS if rank >= max(used, fewest))
    return _with_room(pivots, rank)


def every_point(kernel: Stationary, answers: Tallies) -> Pivots:
    """All distinct tested points as pivots: with these the model is exact.

    `used` are those not explained by the others to rounding, which come first; `carry` are all, since the mean's
    weights of a response are kept at the point where it was given. The number of rows is a multiple of 64, so that
    similar numbers of points share compiled functions. Not under `jit`.
    """
    points = np.unique(np.asarray(answers.x)[np.asarray(answers.asked)], axis=0)
    count, room = len(points), _BLOCK * -(-len(points) // _BLOCK)
    x, carry = jnp.asarray(np.pad(points, ((0, room - count), (0, 0)))), np.arange(room) < count
    rows, left = _rows_of(kernel, x, jnp.asarray(carry), room, _DISTINCT * jnp.finfo(x.dtype).eps)
    used = np.asarray(rows)[np.asarray(rows) >= 0]
    order = np.concatenate([used, np.setdiff1d(np.arange(room), used)])
    return Pivots(x[order], jnp.arange(room) < len(used), jnp.asarray(carry[order]), left)


def _with_room(pivots: Pivots, rank: int) -> Pivots:
    """The pivots, used ones first, with `rank` rows, cut or padded with unused rows; `carry` becomes `used`."""
    more = max(rank - len(pivots.used), 0)
    points, used = np.pad(pivots.points[:rank], ((0, more), (0, 0))), np.pad(pivots.used[:rank], (0, more))
    return Pivots(jnp.asarray(points), jnp.asarray(used), jnp.asarray(used), pivots.left)


@program
def unexplained(kernel: Stationary, answers: Tallies, pivots: Pivots) -> Float[Array, ""]:
    """Largest part of the prior variance of g at a tested point that the pivots do not explain, a scalar from 0 to 1.

    `kernel`: may differ from the one with which the pivots were chosen.
    """
    explained = jnp.sum(features_of(kernel, pivots, answers.x) ** 2, axis=2)
    return jnp.max(jnp.where(answers.asked, 1.0 - explained, 0.0))


def root_of_pivots(kernel: Stationary, pivots: Pivots) -> Float[Array, "r r"]:
    """Lower Cholesky factor L (r, r) of the pivots' covariance, with rows of the unit matrix for unused pivots."""
    both = pivots.used[:, None] & pivots.used[None, :]
    covariance = gram(kernel, pivots.points, pivots.points)
    return jnp.linalg.cholesky(jnp.where(both, covariance, jnp.eye(len(pivots.used), dtype=covariance.dtype)))


def features_of(kernel: Stationary, pivots: Pivots, x: Float[Array, "M n d"]) -> Float[Array, "M n r"]:
    """Features phi(x) of stacked points (M, n, d): (M, n, r), 0 for unused pivots."""
    cross = gram(kernel, pivots.points, x.reshape(-1, x.shape[-1]))
    cross = jnp.where(pivots.used[:, None], cross, 0.0)
    solved = solve_triangular(root_of_pivots(kernel, pivots), cross, lower=True)
    return solved.T.reshape(*x.shape[:2], -1)
