"""An acquisition function on a tensor grid of the unit cube, without most of the exponentials and the variances.

Where a kernel is a product over coordinates, its values on a grid of g nodes per coordinate are products of n·d·g
numbers, and the posterior mean at all g^d nodes is one matrix product (n, g)' (n, g^(d-1)): no exponential per pair.
The nodes of one *column* differ in one coordinate only. With mechanics that is K1, and a column ends at the passive
wall, which no grid meets: its ends are points of their own.

A variance is computed only where it may matter. A score is at most what it would be with the best variance between 0
and the prior's (`optimistic`), so that columns whose bound is below a value already found cannot hold the maximum;
columns are taken in the order of their bounds, `_BATCH` at a time, until the next bound is below the best value.
The maximum over the lattice is the same as if every variance had been computed, to the rounding of the numbers.
"""

import math
from collections.abc import Callable
from typing import Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from hilbo.kernels import RBF, gram

__all__ = ["Lattice", "OptimisticScore", "nodes_for", "screen", "screen_points"]

_BATCH = 48  # columns
_PER_LENGTH = 3.0  # nodes per length scale,
_FEWEST, _MOST = 12, 32  # and per coordinate
_SLACK = 16.0  # rounding errors of a mean, in units of eps times the sum of its terms' sizes


@runtime_checkable
class OptimisticScore(Protocol):
    """A score of means and variances that can bound itself."""

    def __call__(self, mean: Float[Array, "..."], variance: Float[Array, "..."], /) -> Float[Array, "..."]: ...

    def optimistic(self, mean: Float[Array, "..."], prior: Float[Array, ""], /) -> Float[Array, "..."]:
        """The largest score with this mean and any variance between 0 and `prior`; does not fall with the mean."""
        ...


class Lattice(eqx.Module):
    """Nodes of the unit cube, the same on every coordinate, in columns along one of them.

    `nodes` (g,); `inside` (g, c): which nodes of the c columns are feasible; `ends` (e, c): where columns end between
    nodes, and `present` (e, c) whether they do. Columns run over the other coordinates, the last one fastest.
    `extra` (p, d): feasible points of any place, where columns are too far apart.
    """

    nodes: Float[Array, " g"]
    inside: Bool[Array, "g c"]
    ends: Float[Array, "e c"]
    present: Bool[Array, "e c"]
    extra: Float[Array, "p d"]
    along: int = eqx.field(static=True)
    dim: int = eqx.field(static=True)

    def points(self, row: Int[Array, "*k"], column: Int[Array, "*k"]) -> Float[Array, "*k d"]:
        """Points (..., d) of the unit cube: `row` counts the nodes of a column, then its ends."""
        count = self.nodes.shape[0]
        at_node = self.nodes[jnp.minimum(row, count - 1)]
        height = at_node
        if self.ends.shape[0]:
            at_end = self.ends[jnp.maximum(row - count, 0), column]
            height = jnp.where(row < count, at_node, at_end)
        others = jnp.unravel_index(column, (count,) * (self.dim - 1)) if self.dim > 1 else ()
        coordinates = [self.nodes[i] for i in others]
        coordinates.insert(self.along, height)
        return jnp.stack(coordinates, axis=-1)


def nodes_for(theta: float) -> int:
    """Nodes per coordinate for a kernel with this (largest) theta: about three per length scale, 12 to 32."""
    return min(max(1 + math.ceil(_PER_LENGTH * math.sqrt(2.0 * theta)), _FEWEST), _MOST)


def screen(
    kernel: RBF,
    x: Float[Array, "n d"],
    weights: Float[Array, " n"],
    factor: Float[Array, "n n"],
    lattice: Lattice,
    score: OptimisticScore,
    allowed: Callable[[Float[Array, " d"]], Bool[Array, ""]] | None = None,
) -> tuple[Float[Array, " s"], Float[Array, "s d"]]:
    """The best value of each column and those of the extra points (c + p,), and where they are (c + p, d); -inf for
    columns that cannot hold the maximum.

    **Arguments:** the `kernel`, asked points `x` (n, d), `weights` and `factor` of a posterior; `allowed`: which
    points may be chosen at all, e.g. none too near to earlier ones.
    """
    prior = kernel.diagonal(x[0])
    down, across, ends = _factors(kernel, x, lattice)
    usable = jnp.concatenate([lattice.inside, lattice.present])
    if allowed is not None:
        row, column = jnp.indices(usable.shape)
        usable &= jax.vmap(jax.vmap(allowed))(lattice.points(row, column))
    at_ends = (across[:, None, :] * ends).reshape(x.shape[0], -1)
    mean = jnp.concatenate([(weights[:, None] * down).T @ across, (weights @ at_ends).reshape(-1, across.shape[1])])
    slack = _SLACK * jnp.finfo(mean.dtype).eps * jnp.sum(jnp.abs(weights)) * prior
    bounds = jnp.max(jnp.where(usable, score.optimistic(mean + slack, prior), -jnp.inf), axis=0)
    value_of = _Values(prior, jnp.concatenate([factor, weights[None, :]]), score)

    def evaluate(state):
        bounds, best, row = state
        _, chosen = jax.lax.top_k(bounds, batch)
        u = across[:, chosen]
        cross = jnp.concatenate([down[:, :, None] * u[:, None, :], ends[:, :, chosen] * u[:, None, :]], axis=1)
        value = value_of(cross.reshape(x.shape[0], -1)).reshape(-1, batch)
        value = jnp.where(usable[:, chosen], value, -jnp.inf)
        return (
            bounds.at[chosen].set(-jnp.inf),
            best.at[chosen].set(jnp.max(value, axis=0)),
            row.at[chosen].set(jnp.argmax(value, axis=0).astype(row.dtype)),
        )

    others = value_of(gram(kernel, x, lattice.extra.astype(x.dtype)))
    if allowed is not None:
        others = jnp.where(jax.vmap(allowed)(lattice.extra), others, -jnp.inf)
    highest = jnp.max(others, initial=-jnp.inf)
    batch = min(_BATCH, bounds.shape[0])
    nothing = jnp.full_like(bounds, -jnp.inf)
    first = evaluate((bounds, nothing, jnp.zeros(bounds.shape, jnp.int32)))
    _, best, row = jax.lax.while_loop(
        lambda state: jnp.max(state[0]) > jnp.maximum(jnp.max(state[1]), highest), evaluate, first
    )
    at_best = lattice.points(row, jnp.arange(bounds.shape[0]))
    return jnp.concatenate([best, others]), jnp.concatenate([at_best, lattice.extra])


def screen_points(
    kernel: RBF,
    x: Float[Array, "n d"],
    weights: Float[Array, " n"],
    factor: Float[Array, "n n"],
    points: Float[Array, "m d"],
    score: OptimisticScore,
    batch: int = 512,
) -> Float[Array, " m"]:
    """Values (m,) of a score at any points, -inf at those that cannot hold the maximum and got no variance."""
    prior = kernel.diagonal(x[0])
    mean = gram(kernel, points, x) @ weights
    slack = _SLACK * jnp.finfo(mean.dtype).eps * jnp.sum(jnp.abs(weights)) * prior
    value_of = _Values(prior, jnp.concatenate([factor, weights[None, :]]), score)

    def evaluate(state):
        bounds, values = state
        _, chosen = jax.lax.top_k(bounds, min(batch, bounds.shape[0]))
        found = value_of(gram(kernel, x, points[chosen]))
        # A point that comes twice, because all bounds are used up, keeps its value.
        return bounds.at[chosen].set(-jnp.inf), values.at[chosen].set(found)

    first = evaluate((score.optimistic(mean + slack, prior), jnp.full_like(mean, -jnp.inf)))
    return jax.lax.while_loop(lambda state: jnp.max(state[0]) > jnp.max(state[1]), evaluate, first)[1]


class _Values(eqx.Module):
    """A score where the prior covariances with the asked points are the columns of `cross`."""

    prior: Float[Array, ""]
    product: Float[Array, "r n"]
    score: OptimisticScore

    def __call__(self, cross):
        both = self.product @ jax.lax.optimization_barrier(cross)
        left = self.prior - jnp.sum(both[:-1] ** 2, axis=0)
        # Rounding may leave less than nothing of a variance, and these numbers only rank; what is none ranks last.
        value = self.score(both[-1], jnp.where(left > 0, left, 0.0))
        return jnp.where(value > -jnp.inf, value, -jnp.inf)


def _factors(kernel, x, lattice):
    """Covariances as products: (n, g) along the columns, (n, c) across them, and (n, e, c) at their ends."""
    nodes, ends = lattice.nodes.astype(x.dtype), lattice.ends.astype(x.dtype)
    factors = [kernel.along(i, x[:, i], nodes) for i in range(lattice.dim)]
    across = kernel.diagonal(x[0]) * jnp.ones_like(x[:, :1])
    for i, factor in enumerate(factors):
        if i != lattice.along:
            across = (across[:, :, None] * factor[:, None, :]).reshape(x.shape[0], -1)
    at_ends = kernel.along(lattice.along, x[:, lattice.along], ends.reshape(-1))
    return factors[lattice.along], across, at_ends.reshape(x.shape[0], *ends.shape)
