"""Features of a smooth function that many people share: from few of the answered points the rest follows.

With Z the pivots of an incomplete Cholesky factorisation of k at all answered points, L L' = k(Z, Z) and the features
phi(x) = L^-1 k(Z, x), k(x, y) = phi(x)'phi(y) to an error that the factorisation states. The kernels have the variance
1 here. Reference: Harbrecht, Peters &
Schneider (2012), Applied Numerical Mathematics 62:428.
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
_BLOCK, _DISTINCT = 64, 64  # of the sizes of records of all points; eps times it is left of a point that adds nothing
_RANKS = (32, 64, 128, 256, 640, 1024)  # 640: all points of 24 people with 25 answers


class Pivots(NamedTuple):
    """Answered points from which the shared function is known."""

    points: Float[Array, "r d"]
    used: Bool[Array, " r"]
    carry: Bool[Array, " r"]
    """Those that hold the weights of the answers that were given there: the used ones, and of `every_point` all."""
    left: Float[Array, ""]
    """Largest part of the prior variance of g, at an answered point, that they do not explain."""


def pivots_of(
    kernel: Stationary, answers: Tallies, room: int, tolerance: ArrayLike, most: ArrayLike | None = None
) -> Pivots:
    """Of the points that people were asked at, each where the ones before explain least; no more than there is `room`
    for, and than `most`."""
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
    """Rows of the points that are chosen, -1 beyond them; and what they leave."""
    largest = room if most is None else jnp.minimum(room, most)

    def going(state):
        count, _, left, _ = state
        return (count < largest) & (jnp.max(left) > tolerance)

    def choose(state):
        count, rows, left, chosen = state
        place = jnp.argmax(left)
        column = jax.vmap(lambda y: kernel(x[place], y))(x)
        row = (column - rows[:, place] @ rows) / jnp.sqrt(left[place])
        return count + 1, rows.at[count].set(row), (left - row**2).at[place].set(0.0), chosen.at[count].set(place)

    initial = (jnp.asarray(0), jnp.zeros((room, x.shape[0]), x.dtype), asked.astype(x.dtype), jnp.full(room, -1))
    _, _, left, chosen = jax.lax.while_loop(going, choose, initial)
    return chosen, jnp.max(left)


_pivots_of = program(pivots_of)
_rows_of = program(_chosen)


def pivots_for(
    kernel: Stationary, answers: Tallies, tolerance: float = TOLERANCE, fewest: int = 0, most: int = _RANKS[-1]
) -> Pivots:
    """The pivots that leave no more than `tolerance`, `most` at most. Their record has one of a few sizes, `fewest` at
    least: whoever uses it has a program for each size."""
    enough = min(int(np.asarray(answers.asked).sum()), most)
    for room in _ROOMS:
        pivots = _pivots_of(kernel, answers, room, jnp.asarray(tolerance), jnp.asarray(most))
        used = int(pivots.used.sum())
        if room >= enough or used < room:
            break
    rank = next(rank for rank in _RANKS if rank >= max(used, fewest))
    return _with_room(pivots, rank)


def every_point(kernel: Stationary, answers: Tallies) -> Pivots:
    """All answered points, each once: with these the model is exact. As pivots are used what this precision can tell
    from the ones before; the others follow, because the posterior's mean takes their answers where they were given.

    The record's size is a multiple of 64, so that nearly as many points have the same programs.
    """
    points = np.unique(np.asarray(answers.x)[np.asarray(answers.asked)], axis=0)
    count, room = len(points), _BLOCK * -(-len(points) // _BLOCK)
    x, carry = jnp.asarray(np.pad(points, ((0, room - count), (0, 0)))), np.arange(room) < count
    rows, left = _rows_of(kernel, x, jnp.asarray(carry), room, _DISTINCT * jnp.finfo(x.dtype).eps)
    used = np.asarray(rows)[np.asarray(rows) >= 0]
    order = np.concatenate([used, np.setdiff1d(np.arange(room), used)])
    return Pivots(x[order], jnp.arange(room) < len(used), jnp.asarray(carry[order]), left)


def _with_room(pivots: Pivots, rank: int) -> Pivots:
    """With this much room, of which the used ones take less."""
    more = max(rank - len(pivots.used), 0)
    points, used = np.pad(pivots.points[:rank], ((0, more), (0, 0))), np.pad(pivots.used[:rank], (0, more))
    return Pivots(jnp.asarray(points), jnp.asarray(used), jnp.asarray(used), pivots.left)


@program
def unexplained(kernel: Stationary, answers: Tallies, pivots: Pivots) -> Float[Array, ""]:
    """Largest part of the prior variance of g, at an answered point, that pivots leave, by whatever kernel they were
    chosen."""
    explained = jnp.sum(features_of(kernel, pivots, answers.x) ** 2, axis=2)
    return jnp.max(jnp.where(answers.asked, 1.0 - explained, 0.0))


def root_of_pivots(kernel: Stationary, pivots: Pivots) -> Float[Array, "r r"]:
    """L, with ones on the diagonal in place of pivots that are not used."""
    both = pivots.used[:, None] & pivots.used[None, :]
    covariance = gram(kernel, pivots.points, pivots.points)
    return jnp.linalg.cholesky(jnp.where(both, covariance, jnp.eye(len(pivots.used), dtype=covariance.dtype)))


def features_of(kernel: Stationary, pivots: Pivots, x: Float[Array, "M n d"]) -> Float[Array, "M n r"]:
    """phi(x)' of everybody's points."""
    cross = gram(kernel, pivots.points, x.reshape(-1, x.shape[-1]))
    cross = jnp.where(pivots.used[:, None], cross, 0.0)
    solved = solve_triangular(root_of_pivots(kernel, pivots), cross, lower=True)
    return solved.T.reshape(*x.shape[:2], -1)
