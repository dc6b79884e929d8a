"""Screening of an acquisition function on a tensor grid of the unit cube, with few exponentials and variances.

For a kernel that is a product over coordinates, its values on a grid of g nodes per coordinate are products of n·d·g
numbers, and the posterior mean at all g^d nodes is one matrix product (n, g)' (n, g^(d-1)): no exponential per pair.
The nodes of one *column* differ in one coordinate only. With mechanics that is K1, and a column ends at the passivity
boundary, between grid points: its ends are additional points.

A variance is computed only where it may matter. A score has an upper bound over all variances between 0 and the prior's
(`optimistic`), so that columns whose bound is below a value already found cannot contain the maximum; columns are
processed in the order of their bounds, `_BATCH` at a time, until the next bound is below the best value. The maximum
over the lattice is the same as if every variance had been computed, to rounding.

A maximum between nodes is higher than the nodes. In regions without data a score equals its bound, and is flat: no
local search improves it, yet a thousand such nodes may exceed those near a small mode that data support. So points
other than the maximum are ranked by *hope*, the value plus a fraction of its distance to the bound.
"""

import math
from collections.abc import Callable
from typing import NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from hilbo.kernels import RBF, gram

__all__ = ["Lattice", "OptimisticScore", "Screened", "nodes_for", "screen", "screen_points"]

_BATCH = 32  # columns
_PER_LENGTH = 3.0  # nodes per length scale,
_FEWEST, _MOST = 12, 32  # and per coordinate
_PROMISE = 0.2  # the share; with 0 and 0.4 some hills are missed (docs/design.md)
_SLACK = 16.0  # rounding errors of a mean, in units of eps times the sum of its terms' sizes


@runtime_checkable
class OptimisticScore(Protocol):
    """Score of posterior means and variances that has an upper bound over variances."""

    def __call__(self, mean: Float[Array, "..."], variance: Float[Array, "..."], /) -> Float[Array, "..."]:
        """Score of posterior means and variances, elementwise."""
        ...

    def optimistic(self, mean: Float[Array, "..."], prior: Float[Array, ""], /) -> Float[Array, "..."]:
        """Upper bound of the score given the posterior mean, over variances from 0 to `prior`.

        Monotone in the mean, or with one maximum.
        """
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
        """Points (..., d) of the unit cube in these rows and columns; rows are a column's nodes, then its ends."""
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

    def everywhere(self) -> tuple[Float[Array, "m d"], Bool[Array, " m"]]:
        """All points (m, d) of nodes, ends and extra points, and the mask (m,) of the feasible ones."""
        usable = jnp.concatenate([self.inside, self.present])
        of_lattice = self.points(*jnp.indices(usable.shape)).reshape(-1, self.dim)
        points = jnp.concatenate([of_lattice, self.extra.astype(of_lattice.dtype)])
        return points, jnp.concatenate([usable.reshape(-1), jnp.ones(len(self.extra), bool)])


def nodes_for(theta: float) -> int:
    """Number of nodes per coordinate for a kernel with this (largest) theta: about three per length scale, 12 to 32."""
    return min(max(1 + math.ceil(_PER_LENGTH * math.sqrt(2.0 * theta)), _FEWEST), _MOST)


class Screened(NamedTuple):
    """The highest value; and points (1 + c + p, d) from which to search on, with their hopes (1 + c + p,).

    First the highest point itself, with hope infinity; then the most hopeful one of each column, -inf for columns that
    cannot contain the maximum; then the extra points. Without feasible points all are -inf.
    """

    value: Float[Array, ""]
    hopes: Float[Array, " s"]
    points: Float[Array, "s d"]


def screen(
    kernel: RBF,
    x: Float[Array, "n d"],
    weights: Float[Array, " n"],
    factor: Float[Array, "n n"],
    lattice: Lattice,
    score: OptimisticScore,
    allowed: Callable[[Float[Array, " d"]], Bool[Array, ""]] | None = None,
) -> Screened:
    """Maximise a score over a lattice, and return starting points for local searches.

    **Arguments:** the `kernel`, observed points `x` (n, d), `weights` and `factor` of a posterior, with mean k'weights
    and variance k(x, x) - |factor k|² for the prior covariances k with `x`; `allowed`: further condition on a point,
    e.g. not too close to earlier ones.
    """
    usable, may = jnp.concatenate([lattice.inside, lattice.present]), jnp.ones(lattice.extra.shape[:1], bool)
    if allowed is not None:
        row, column = jnp.indices(usable.shape)
        usable &= jax.vmap(jax.vmap(allowed))(lattice.points(row, column))
        may = jax.vmap(allowed)(lattice.extra)
    values = _Values(kernel.diagonal(x[0]), factor, weights, score)
    columns = _Columns(*_factors(kernel, x, lattice), usable, values)
    extra = values(gram(kernel, x, lattice.extra.astype(x.dtype)))
    others, others_hopes = (jnp.where(may, scores, -jnp.inf) for scores in extra)
    search = _best_first(columns, jnp.max(others, initial=-jnp.inf))
    at_top = lattice.points(*search.top)
    if lattice.extra.shape[0]:
        at_top = jnp.where(search.top[0] < 0, lattice.extra[jnp.argmax(others)], at_top)
    first = jnp.where(search.highest > -jnp.inf, jnp.inf, search.highest)
    at_rows = lattice.points(search.rows, jnp.arange(usable.shape[1]))
    return Screened(
        search.highest,
        jnp.concatenate([first[None], search.hopes, others_hopes]),
        jnp.concatenate([at_top[None, :], at_rows, lattice.extra]),
    )


class _Found(NamedTuple):
    """State of the screening."""

    bounds: Float[Array, " c"]  # of columns without variances
    highest: Float[Array, ""]  # value so far,
    top: tuple[Int[Array, ""], Int[Array, ""]]  # and its row and column; row -1: none of a column
    hopes: Float[Array, " c"]  # the largest of each column with variances, -inf for others,
    rows: Int[Array, " c"]  # and where it is


def _best_first(columns: "_Columns", highest: Float[Array, ""]) -> _Found:
    """Evaluate columns in the order of their bounds, while they may contain a value above `highest`; final state."""

    def step(state):
        _, chosen = jax.lax.top_k(state.bounds, min(_BATCH, state.bounds.shape[0]))
        value, hope = columns.evaluate(chosen)
        best = jnp.max(value, axis=0)
        column = jnp.argmax(best)
        higher = best[column] > state.highest
        row, top_column = state.top
        return _Found(
            state.bounds.at[chosen].set(-jnp.inf),
            jnp.where(higher, best[column], state.highest),
            (jnp.where(higher, _first_largest(value[:, column]), row), jnp.where(higher, chosen[column], top_column)),
            state.hopes.at[chosen].set(jnp.max(hope, axis=0)),
            state.rows.at[chosen].set(_first_largest(hope)),
        )

    bounds, none = columns.bounds(), jnp.asarray(-1, jnp.int32)
    start = _Found(bounds, highest, (none, none), jnp.full_like(bounds, -jnp.inf), jnp.zeros(bounds.shape, jnp.int32))
    return jax.lax.while_loop(lambda state: jnp.max(state.bounds) > state.highest, step, start)


def _first_largest(values: Float[Array, "r *c"]) -> Int[Array, "*c"]:
    """Index of the first maximum along the first axis, as `argmax`.

    XLA makes faster code of a maximum and a minimum than of one `argmax`.
    """
    last = values.shape[0] - 1
    index = jnp.arange(last + 1, dtype=jnp.int32).reshape(-1, *[1] * (values.ndim - 1))
    return jnp.min(jnp.where(values == jnp.max(values, axis=0, keepdims=True), index, last), axis=0)


class _Columns(eqx.Module):
    """Prior covariances between observed points and nodes, as factors along (`down`) and across columns, and at `ends`.

    `usable`: which nodes and ends may be chosen; `values`: the score.
    """

    down: Float[Array, "g n"]
    across: Float[Array, "n c"]
    ends: Float[Array, "n e c"]
    usable: Bool[Array, "r c"]
    values: "_Values"

    def bounds(self) -> Float[Array, " c"]:
        """Upper bound of the score in each column, over its usable points; -inf if it has none."""
        weights = self.values.weights
        at_nodes = (self.down * weights[None, :]) @ self.across
        at_ends = weights @ (self.across[:, None, :] * self.ends).reshape(len(weights), -1)
        mean = jnp.concatenate([at_nodes, at_ends.reshape(-1, self.across.shape[1])])
        return jnp.max(jnp.where(self.usable, self.values.bound(mean), -jnp.inf), axis=0)

    def evaluate(self, chosen: Int[Array, " b"]) -> tuple[Float[Array, "r b"], Float[Array, "r b"]]:
        """Values and hopes (r, b) at the nodes and ends of the `chosen` columns (indices); -inf for unusable points."""
        across = self.across[:, chosen][:, None, :]
        cross = jnp.concatenate([self.down.T[:, :, None] * across, self.ends[:, :, chosen] * across], axis=1)
        scores = self.values(cross.reshape(len(cross), -1))
        value, hope = (jnp.where(self.usable[:, chosen], score.reshape(-1, len(chosen)), -jnp.inf) for score in scores)
        return value, hope


def screen_points(
    kernel: RBF,
    x: Float[Array, "n d"],
    weights: Float[Array, " n"],
    factor: Float[Array, "n n"],
    points: Float[Array, "m d"],
    score: OptimisticScore,
    batch: int = 512,
) -> Float[Array, " m"]:
    """Values (m,) of a score at arbitrary points, enough of them to contain the maximum.

    -inf at points that cannot be the maximum and were not evaluated. Arguments as in `screen`; `batch`: points
    evaluated at once.
    """
    value_of = _Values(kernel.diagonal(x[0]), factor, weights, score)

    def evaluate(state):
        bounds, values = state
        _, chosen = jax.lax.top_k(bounds, min(batch, bounds.shape[0]))
        chosen_values, _ = value_of(gram(kernel, x, points[chosen]))
        # A point that comes twice, because all bounds are used up, keeps its value.
        return bounds.at[chosen].set(-jnp.inf), values.at[chosen].set(chosen_values)

    bounds = value_of.bound(gram(kernel, points, x) @ weights)
    first = evaluate((bounds, jnp.full_like(bounds, -jnp.inf)))
    return jax.lax.while_loop(lambda state: jnp.max(state[0]) > jnp.max(state[1]), evaluate, first)[1]


class _Values(eqx.Module):
    """Score as a function of the prior covariances with the observed points; `prior`: variance of the prior."""

    prior: Float[Array, ""]
    factor: Float[Array, "n n"]
    weights: Float[Array, " n"]
    score: OptimisticScore

    def bound(self, mean: Float[Array, "..."]) -> Float[Array, "..."]:
        """Upper bound of the score given the posterior mean, with a margin for rounding."""
        slack = _SLACK * jnp.finfo(mean.dtype).eps * jnp.sum(jnp.abs(self.weights)) * self.prior
        ends = (self.score.optimistic(mean + way * slack, self.prior) for way in (1, -1))
        return jnp.maximum(*ends)

    def __call__(self, cross: Float[Array, "n m"]) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
        """Values and hopes (m,) for prior covariances `cross`; -inf if the score is not a number."""
        product = jnp.concatenate([self.factor, self.weights[None, :]]) @ jax.lax.optimization_barrier(cross)
        mean, left = product[-1], self.prior - jnp.sum(product[:-1] ** 2, axis=0)
        # Rounding may leave less than nothing of a variance, and these numbers only rank; NaN ranks last.
        value = self.score(mean, jnp.where(left > 0, left, 0.0))
        possible = value > -jnp.inf
        hope = value + _PROMISE * (self.score.optimistic(mean, self.prior) - value)
        return jnp.where(possible, value, -jnp.inf), jnp.where(possible, hope, -jnp.inf)


def _factors(
    kernel: RBF, x: Float[Array, "n d"], lattice: Lattice
) -> tuple[Float[Array, "g n"], Float[Array, "n c"], Float[Array, "n e c"]]:
    """Covariances between observed points and lattice as products of factors along and across the columns.

    (g, n) along them at the nodes, (n, c) across them, with the kernel's variance, and (n, e, c) along them at the
    ends.
    """
    nodes, ends = lattice.nodes.astype(x.dtype), lattice.ends.astype(x.dtype)
    across = kernel.diagonal(x[0]) * jnp.ones_like(x[:, :1])
    for i in range(lattice.dim):
        if i != lattice.along:
            across = (across[:, :, None] * kernel.along(i, x[:, i], nodes)[:, None, :]).reshape(x.shape[0], -1)
    asked = x[:, lattice.along]
    at_ends = kernel.along(lattice.along, asked, ends.reshape(-1))
    return kernel.along(lattice.along, nodes, asked), across, at_ends.reshape(x.shape[0], *ends.shape)
