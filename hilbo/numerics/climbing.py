"""Maximisation of a function over a feasible set of the unit cube, by Newton's method from several starts."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from hilbo.numerics.polytope import Polytope, nearest, walls_of_cube

__all__ = ["Choice", "climb", "spread"]

_Point = Float[Array, " d"]
_Score = Callable[[_Point], Float[Array, ""]]
_Map = Callable[[_Point], _Point]
_Test = Callable[[_Point], Bool[Array, ""]]
_Neighbours = Callable[[_Point], Float[Array, "k d"]]
_STATIONARY = 1e-8  # gradient of the score in the optimiser's coordinates,
_HOPS, _HIGHER = 40, 1e-9  # over steps, at most; and what a step must gain, of the score
_RESOLUTION = 1e-6  # and the trust radius at a kink of the passive set's wall: in units of the search ranges


class Choice(eqx.Module):
    """Maximum of a search and how it was found."""

    x: _Point
    """In the unit cube."""
    value: Float[Array, ""]
    """Its score."""
    candidate: Int[Array, ""]
    """Index of the candidate with the highest score."""
    candidate_value: Float[Array, ""]
    """That candidate's score; `value` is never below it."""


def climb(
    starts: Float[Array, "s d"],
    usable: Bool[Array, " s"],
    score: _Score,
    *,
    from_box: _Map,
    to_box: _Map,
    feasible: _Test,
    allowed: _Test | None = None,
    walls: Polytope | None = None,
    held: Bool[Array, " d"] | bool = False,
    dependent: Bool[Array, " d"] | bool = False,
    neighbours: _Neighbours | None = None,
    steps: int = 50,
    gain: ArrayLike = 0.0,
) -> Choice:
    """Maximise `score` from several starts by Newton's method; return the best point found.

    The result is never below the best usable start, which is returned itself for `steps` = 0. Without a usable start
    its value is -inf.

    **Arguments:**

    - `starts` (s, d): feasible points of the unit cube; `usable` (s,): mask of those to search from. The result's
      `candidate` is a row of these.
    - `score`: differentiable function of one point (d,) of the unit cube.
    - `from_box`, `to_box`: maps between the optimiser's coordinates, in [0, 1]^d, and the unit cube.
    - `feasible`: whether a point is feasible.
    - `allowed`: further condition on the end of a search, e.g. not too close to earlier points.
    - `walls`: linear constraints in the optimiser's coordinates; None if all of [0, 1]^d is feasible there. Only with
      `walls` are these three used: `held`: mask of the coordinates that do not move, discrete or dependent;
      `dependent`: mask of those of them that `from_box` computes from the others; `neighbours`: the points one discrete
      step away, tried at the end of each search.
    - `steps`: largest number of Newton steps of a search.
    - `gain`: a search ends where the score could rise by less than this (see `TrustRegionNewton`).
    """

    def may_end(x):
        return feasible(x) & (True if allowed is None else allowed(x))

    if walls is None:
        return _Straight(score, from_box, to_box, may_end, steps, gain).best(starts, usable)
    held = jnp.broadcast_to(held, starts.shape[1:])
    fixed = held if dependent is False else held & ~jnp.broadcast_to(dependent, starts.shape[1:])
    within = _Within(score, from_box, to_box, may_end, walls, held, fixed, neighbours)
    return _best_of(*jax.lax.map(lambda of: within.climbed(of[0], of[1], steps, gain), (starts, usable)))


class _Straight(NamedTuple):
    """Search in the unit cube itself, without walls.

    If it ends outside the feasible set, at a higher score than found so far, a second search follows in the optimiser's
    coordinates, from the projection of that end onto the boundary or from the start, whichever is better: there the
    boundary is flat, but the function is distorted where the boundary is curved. Starts are processed one after the
    other: each search stops when it has converged, or when it approaches the end of an earlier one, since good starts
    often share a mode.
    """

    score: _Score
    from_box: _Map
    to_box: _Map
    may_end: _Test
    steps: int
    gain: ArrayLike

    def best(self, starts: Float[Array, "s d"], usable: Bool[Array, " s"]) -> Choice:
        """Search from all usable starts, one after the other, and return the best end.

        `starts` (s, d), `usable` (s,). The value is -inf if no start is usable.
        """
        no_ends = jnp.full((), -jnp.inf, starts.dtype), jnp.full_like(starts, jnp.nan)
        _, (ends, values, start_values) = jax.lax.scan(self._next, no_ends, (starts, usable, jnp.arange(len(starts))))
        return _best_of(ends, values, start_values)

    def _next(self, state, start):
        """Search from one start; a step of `jax.lax.scan`.

        `state`: highest score so far, and the ends (s, d) of the unit-cube searches, feasible or not, NaN for those to
        come. `start`: a point, whether it is usable, and its row. Returns the next state, and (end, score there, score
        of the start). The end is the start itself if the search found nothing higher that is feasible; the scores of an
        unusable start are -inf.
        """
        (highest, earlier_ends), (x, may, row) = state, start
        start_value = jnp.where(may, self.score(x), -jnp.inf)
        if self.steps == 0:
            return state, (x, start_value, start_value)
        straight, height = _polish(self.score, x, self.steps, self.gain, {"known": earlier_ends})
        w = self.to_box(straight)
        inside = jnp.all((w >= 0.0) & (w <= 1.0)) & self.may_end(straight)
        end, value = jax.lax.cond(
            inside | (height <= highest), lambda: (straight, height), lambda: self._along_the_wall(x, straight)
        )
        risen = may & (value > start_value) & (inside | (height > highest))
        end, value = jnp.where(risen, end, x), jnp.where(risen, value, start_value)
        known = jnp.where(may, straight, jnp.nan)  # a search from an unusable start ends where no other is stopped
        return (jnp.maximum(highest, value), earlier_ends.at[row].set(known)), (end, value, start_value)

    def _along_the_wall(self, x, outside):
        """Search in the optimiser's coordinates, after a search from `x` ended `outside` the feasible set.

        Starts at the projection of `outside` or at `x`, whichever scores higher. Returns the end in the unit cube and
        its score, -inf if the end is not feasible or not allowed.
        """
        aside = self.from_box(jnp.clip(self.to_box(outside), 0.0, 1.0))
        start = jnp.where(self.score(aside) > self.score(x), aside, x)
        w, value = _polish(lambda w: self.score(self.from_box(w)), self.to_box(start), self.steps, self.gain, {})
        end = self.from_box(w)
        return end, jnp.where(self.may_end(end), value, -jnp.inf)


class _Within(NamedTuple):
    """Search with walls or discrete coordinates, in the optimiser's coordinates. Fields as the arguments of `climb`."""

    score: _Score
    from_box: _Map
    to_box: _Map
    may_end: _Test
    walls: Polytope
    held: Bool[Array, " d"]
    fixed: Bool[Array, " d"]
    """The coordinates that are held, but for the dependent ones."""
    neighbours: _Neighbours | None

    def climbed(
        self, start: _Point, usable: Bool[Array, ""], steps: int, gain: ArrayLike
    ) -> tuple[_Point, Float[Array, ""], Float[Array, ""]]:
        """Search from one start: Newton's method, then the best neighbour, repeated while a neighbour is higher.

        Returns the end in the unit cube, its score, and the score of the start; for an unusable start the start and
        -inf.
        """
        start_value = jnp.where(usable, self.score(start), -jnp.inf)
        if steps == 0:
            return start, start_value, start_value

        def going(state):
            return state[2] & (state[3] < _HOPS)

        def hop(state):
            x, value, _, count = state
            end, height = self._polished(x, value, steps, gain)
            if self.neighbours is None:
                return end, height, jnp.asarray(False), count + 1
            near, heights = self._around(end)
            best = jnp.argmax(heights)
            higher = heights[best] > height + _HIGHER * (1.0 + jnp.abs(height))
            return jnp.where(higher, near[best], end), jnp.where(higher, heights[best], height), higher, count + 1

        end, value, _, _ = jax.lax.while_loop(going, hop, (start, start_value, usable, jnp.asarray(0)))
        return end, value, start_value

    def _polished(self, x, value, steps, gain):
        """Run Newton's method from `x`, whose score is `value`, with the discrete coordinates fixed.

        Returns the end and its score, or `x` and `value` if the end is not higher or not allowed.
        """
        options = {"walls": self.walls, "held": self.held}
        w, height = _polish(lambda w: self.score(self.from_box(w)), self.to_box(x), steps, gain, options)
        end = jnp.where(self.fixed, x, self.from_box(jnp.clip(w, 0.0, 1.0)))  # a step may end a rounding error outside
        better = (height > value) & self.may_end(end)
        return jnp.where(better, end, x), jnp.where(better, height, value)

    def _around(self, x):
        """Neighbours (k, d) of `x`, projected between the walls, and their scores (k,), -inf if not allowed."""
        assert self.neighbours is not None
        near = self.neighbours(x)
        if self.walls.normals.shape[0]:
            near = jax.lax.map(self._between, near)
        may = jax.vmap(self.may_end)(near)
        return near, jnp.where(may, jax.vmap(self.score)(near), -jnp.inf)

    def _between(self, x):
        """Move `x` to the nearest point between the walls with the same discrete coordinates; unit cube in and out."""
        w = self.to_box(x)
        cube = walls_of_cube(self.walls, self.held, w)
        left = self.walls.offsets.astype(w.dtype) - self.walls.normals.astype(w.dtype) @ w
        seen = cube._replace(offsets=cube.offsets.at[: left.size].set(left))
        moved = w + nearest(seen, jnp.zeros_like(w), jnp.eye(w.size, dtype=w.dtype)).point
        return jnp.where(self.fixed, x, self.from_box(jnp.clip(moved, 0.0, 1.0)))


def _best_of(ends: Float[Array, "s d"], values: Float[Array, " s"], start_values: Float[Array, " s"]) -> Choice:
    """`Choice` of the end with the highest of `values` and of the start with the highest of `start_values`."""
    best, best_start = jnp.argmax(values), jnp.argmax(start_values)
    return Choice(ends[best], values[best], best_start, start_values[best_start])


def spread(
    values: Float[Array, " m"], candidates: Float[Array, "m d"], count: int, apart: float = 0.1
) -> Int[Array, " count"]:
    """Rows of high values at distinct locations: the maximum, the maximum at least `apart` from it, and so on.

    `values` (m,), `candidates` (m, d) -> (count,) row numbers; `apart`: Euclidean distance to all rows chosen before.
    If no candidate is left, or no finite value, row 0 fills the rest.
    """

    def pick(remaining, _):
        row = jnp.argmax(remaining)
        near = jnp.sum((candidates - candidates[row][None, :]) ** 2, axis=1) < apart**2
        return jnp.where(near, -jnp.inf, remaining), row

    return jax.lax.scan(pick, values, None, length=count)[1]


def _polish(
    score: _Score,
    start: _Point,
    steps: int,
    gain: Any,
    options: dict[str, Any],
) -> tuple[_Point, Float[Array, ""]]:
    """Maximise `score` from `start` by Newton's method within [0, 1]^d; return the end and its score.

    `steps`: largest number of steps; reaching it is no error. `gain`: the search ends where the score could rise by
    less than this. `options`: further options of `TrustRegionNewton`, such as "walls".
    """
    import optimistix as optx  # slow to import, and needed only where a search is traced

    from hilbo.numerics.newton import TrustRegionNewton

    solution = optx.minimise(
        lambda w, _: -score(w),
        TrustRegionNewton(atol=_STATIONARY, resolution=_RESOLUTION, gain=gain),
        start,
        options={"lower": jnp.zeros_like(start), "upper": jnp.ones_like(start)} | options,
        max_steps=steps,
        throw=False,
    )
    return solution.value, -solution.state.here.value
