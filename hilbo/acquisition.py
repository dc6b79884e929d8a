"""Trial selection: scores of candidate renderings from the posterior, and their maximum over a search space.

A score takes the posterior mean and variance of f at one point. The next rendering maximises it over a candidate set
and is then polished by Newton's method in the optimiser's coordinates, in which the feasible set is a cube.

    UCB (paper, section IV-3):   mu + weight * sigma
    log expected improvement:    log( sigma * h((mu - best) / sigma) ),  h(z) = phi(z) + z Phi(z)
    top category:                log P(highest answer) = log Phi((mu - t) / sqrt(noise^2 + sigma^2))
    mean:                        mu
    Thompson:                    the maximum of one draw of f over the candidates

Log expected improvement after Ament et al. (2023), arXiv:2310.20708: without the logarithm it is 0, and flat, wherever
an improvement is unlikely.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from hilbo.numerics.linalg import eigh
from hilbo.numerics.normal import HALF_LOG_2PI, excess_hazard
from hilbo.numerics.polytope import Polytope, nearest, walls_of_cube

__all__ = ["UCB", "Choice", "LogEI", "Mean", "Score", "TopCategory", "climb", "maximise", "spread", "thompson"]


def __dir__() -> list[str]:
    return __all__


Score = Callable[[Float[Array, ""], Float[Array, ""]], Float[Array, ""]]
"""Posterior mean and variance at a point -> how much we want to ask there."""

_STATIONARY = 1e-8  # gradient of the score in the optimiser's coordinates,
_HOPS, _HIGHER = 40, 1e-9  # over steps, at most; and what a step must gain, of the score
_RESOLUTION = 1e-6  # and the trust radius at a kink of the passive set's wall: in units of the search ranges


class UCB(eqx.Module):
    """Upper confidence bound, mean + weight * sd."""

    weight: Float[Array, ""] = eqx.field(converter=jnp.asarray, default=0.7)

    def __call__(self, mean, variance):
        return mean + self.weight.astype(mean.dtype) * jnp.sqrt(variance)

    def optimistic(self, mean, prior):
        """With all of the prior's variance left; `weight` is not negative."""
        return self(mean, prior)


class LogEI(eqx.Module):
    """Logarithm of the expected improvement over `best`, usually the largest posterior mean among the asked points."""

    best: Float[Array, ""] = eqx.field(converter=jnp.asarray)

    def __call__(self, mean, variance):
        sd = jnp.sqrt(variance)
        return jnp.log(sd) + _log_improvement((mean - self.best.astype(mean.dtype)) / sd)

    def optimistic(self, mean, prior):
        """With all of the prior's variance left: more spread means more improvement."""
        return self(mean, prior)


class TopCategory(eqx.Module):
    """Log probability of the highest category: `threshold` is its lower edge, `noise` the answers' noise."""

    threshold: Float[Array, ""] = eqx.field(converter=jnp.asarray)
    noise: Float[Array, ""] = eqx.field(converter=jnp.asarray)

    def __call__(self, mean, variance):
        spread = jnp.sqrt(self.noise.astype(mean.dtype) ** 2 + variance)
        return jax.scipy.special.log_ndtr((mean - self.threshold.astype(mean.dtype)) / spread)

    def optimistic(self, mean, prior):
        """Certain where the mean is above the threshold, as uncertain as the prior below it."""
        return self(mean, jnp.where(mean > self.threshold.astype(mean.dtype), 0.0, prior))


class Mean(eqx.Module):
    """The posterior mean itself: pure exploitation, and what the final optimum maximises."""

    def __call__(self, mean, variance):
        del variance
        return mean

    def optimistic(self, mean, prior):
        """The mean."""
        del prior
        return mean


def _log_improvement(z: Float[Array, "*m"]) -> Float[Array, "*m"]:
    """log(phi(z) + z Phi(z)). For z < 0 it is phi(z) (1 - |z| Q/phi) = phi(z) * excess / hazard: no cancellation."""
    below = jnp.where(z < 0, -z, 0.0)
    excess = excess_hazard(below)
    left = -0.5 * below**2 - HALF_LOG_2PI + jnp.log(excess) - jnp.log(below + excess)
    above = jnp.where(z < 0, 0.0, z)
    density = jnp.exp(-0.5 * above**2 - HALF_LOG_2PI)
    upper = above + excess_hazard(above)
    right = jnp.log(above + density * (1.0 - above / upper))  # z Phi + phi = z + phi (1 - z / hazard)
    return jnp.where(z < 0, left, right)


class Choice(eqx.Module):
    """The chosen point and how it was found."""

    x: Float[Array, " d"]
    """In the unit cube."""
    value: Float[Array, ""]
    """Its score."""
    candidate: Int[Array, ""]
    """Index of the best candidate, from which or near which it was polished."""
    candidate_value: Float[Array, ""]
    """That candidate's score; `value` is never below it."""


def maximise(
    values: Float[Array, " m"],
    candidates: Float[Array, "m d"],
    score: Callable[[Float[Array, " d"]], Float[Array, ""]],
    *,
    from_box: Callable[[Float[Array, " d"]], Float[Array, " d"]],
    to_box: Callable[[Float[Array, " d"]], Float[Array, " d"]],
    feasible: Callable[[Float[Array, " d"]], Bool[Array, ""]],
    allowed: Callable[[Float[Array, " d"]], Bool[Array, ""]] | None = None,
    walls: Polytope | None = None,
    held: Bool[Array, " d"] | bool = False,
    neighbours: Callable[[Float[Array, " d"]], Float[Array, "k d"]] | None = None,
    starts: int = 3,
    steps: int = 50,
    gain: ArrayLike = 0.0,
) -> Choice:
    """The best of the candidates and of `starts` polished ones.

    **Arguments:**

    - `values`: scores (m,) of the `candidates` (m, d), feasible points of the unit cube. They only rank the
      candidates, so single precision will do: the best ones are scored again.
    - `score`: the same score for one point, differentiable.
    - `from_box`, `to_box`: between the optimiser's cube, in which everything is feasible, and the unit cube.
    - `feasible`: whether a polished point may be rendered (candidates are known to).
    - `allowed`: which points may be chosen at all, e.g. none too near to earlier ones.
    - `walls`: linear ones within the optimiser's cube, if not everything in it is feasible; `held`: coordinates that
      have steps, and `neighbours`: the points a step away from one, which are tried where polishing ends.
    - `starts`, `steps`: how many candidates, at least 0.1 apart, are polished, and at most how many Newton steps each
      may take; 0 starts means no polishing.
    - `gain`: polishing ends where the score could rise by less than that within the cube (`TrustRegionNewton`).
    """
    if allowed is not None:
        values = jnp.where(jax.vmap(allowed)(candidates), values, -jnp.inf)
    rows = spread(values, candidates, max(starts, 1))
    choice = climb(
        candidates[rows],
        values[rows] > -jnp.inf,
        score,
        from_box=from_box,
        to_box=to_box,
        feasible=feasible,
        allowed=allowed,
        walls=walls,
        held=held,
        neighbours=neighbours,
        steps=steps if starts else 0,
        gain=gain,
    )
    return eqx.tree_at(lambda c: c.candidate, choice, rows[choice.candidate])


def climb(
    starts: Float[Array, "s d"],
    usable: Bool[Array, " s"],
    score: Callable[[Float[Array, " d"]], Float[Array, ""]],
    *,
    from_box: Callable[[Float[Array, " d"]], Float[Array, " d"]],
    to_box: Callable[[Float[Array, " d"]], Float[Array, " d"]],
    feasible: Callable[[Float[Array, " d"]], Bool[Array, ""]],
    allowed: Callable[[Float[Array, " d"]], Bool[Array, ""]] | None = None,
    walls: Polytope | None = None,
    held: Bool[Array, " d"] | bool = False,
    neighbours: Callable[[Float[Array, " d"]], Float[Array, "k d"]] | None = None,
    steps: int = 50,
    gain: ArrayLike = 0.0,
) -> Choice:
    """The best of the usable starts and of where Newton's method leads from them; arguments as in [`maximise`][].

    The search goes through the unit cube itself. Only where that ends outside the feasible set, on a hill higher than
    what was found before, does another follow in the optimiser's coordinates, from the wall beside that end or from the
    start, whichever is better: there walls are flat, but the function inside is bent wherever the wall is.
    One start after the other: each stops when it is done, where a batch would wait for its slowest, or on the way to
    where an earlier one ended: once a hill stands out, most good starts are on its slopes.
    Between `walls`, and where coordinates have steps, the search is in the optimiser's coordinates alone.
    `starts` (s, d) in the unit cube, `usable` (s,).
    """

    def may_end(x):
        return feasible(x) & (True if allowed is None else allowed(x))

    if walls is not None:
        within = _Within(score, from_box, to_box, may_end, walls, jnp.broadcast_to(held, starts.shape[1:]), neighbours)
        return _best_of(*jax.lax.map(lambda of: within.climbed(of[0], of[1], steps, gain), (starts, usable)))

    def along_the_wall(x, outside):
        aside = from_box(jnp.clip(to_box(outside), 0.0, 1.0))
        start = jnp.where(score(aside) > score(x), aside, x)
        w, value = _polish(lambda w: score(from_box(w)), to_box(start), steps, gain, {})
        end = from_box(w)
        return end, jnp.where(may_end(end), value, -jnp.inf)

    def one(state, start):
        (highest, earlier_ends), (x, may, index) = state, start
        start_value = jnp.where(may, score(x), -jnp.inf)
        if steps == 0:
            return state, (x, start_value, start_value)
        straight, height = _polish(score, x, steps, gain, {"known": earlier_ends})
        w = to_box(straight)
        inside = jnp.all((w >= 0.0) & (w <= 1.0)) & may_end(straight)
        end, value = jax.lax.cond(
            inside | (height <= highest), lambda: (straight, height), lambda: along_the_wall(x, straight)
        )
        risen = may & (value > start_value) & (inside | (height > highest))
        end, value = jnp.where(risen, end, x), jnp.where(risen, value, start_value)
        return (jnp.maximum(highest, value), earlier_ends.at[index].set(straight)), (end, value, start_value)

    no_ends = jnp.full((), -jnp.inf, starts.dtype), jnp.full_like(starts, jnp.nan)
    _, (ends, values, start_values) = jax.lax.scan(one, no_ends, (starts, usable, jnp.arange(len(starts))))
    return _best_of(ends, values, start_values)


def _best_of(ends: Float[Array, "s d"], values: Float[Array, " s"], start_values: Float[Array, " s"]) -> Choice:
    best, best_start = jnp.argmax(values), jnp.argmax(start_values)
    return Choice(ends[best], values[best], best_start, start_values[best_start])


class _Within(NamedTuple):
    """A search between walls, and over steps: the arguments of [`climb`][], and whether a search may end at a point."""

    score: Callable[[Float[Array, " d"]], Float[Array, ""]]
    from_box: Callable[[Float[Array, " d"]], Float[Array, " d"]]
    to_box: Callable[[Float[Array, " d"]], Float[Array, " d"]]
    may_end: Callable[[Float[Array, " d"]], Bool[Array, ""]]
    walls: Polytope
    held: Bool[Array, " d"]
    neighbours: Callable[[Float[Array, " d"]], Float[Array, "k d"]] | None

    def climbed(
        self, start: Float[Array, " d"], usable: Bool[Array, ""], steps: int, gain: ArrayLike
    ) -> tuple[Float[Array, " d"], Float[Array, ""], Float[Array, ""]]:
        """Where the search from a start ends, the score there, and that of the start."""
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
        """The end of Newton's method from x; x itself if that is no higher, or may not be rendered."""
        options = {"walls": self.walls, "held": self.held}
        w, height = _polish(lambda w: self.score(self.from_box(w)), self.to_box(x), steps, gain, options)
        end = jnp.where(self.held, x, self.from_box(jnp.clip(w, 0.0, 1.0)))  # a step may end a rounding error outside
        better = (height > value) & self.may_end(end)
        return jnp.where(better, end, x), jnp.where(better, height, value)

    def _around(self, x):
        """The points a step away, brought between the walls; and their scores, -inf where they may not be."""
        assert self.neighbours is not None
        near = self.neighbours(x)
        if self.walls.normals.shape[0]:
            near = jax.lax.map(self._between, near)
        may = jax.vmap(self.may_end)(near)
        return near, jnp.where(may, jax.vmap(self.score)(near), -jnp.inf)

    def _between(self, x):
        """The nearest point between the walls with the same steps."""
        w = self.to_box(x)
        cube = walls_of_cube(self.walls, self.held, w)
        left = self.walls.offsets.astype(w.dtype) - self.walls.normals.astype(w.dtype) @ w
        seen = cube._replace(offsets=cube.offsets.at[: left.size].set(left))
        moved = w + nearest(seen, jnp.zeros_like(w), jnp.eye(w.size, dtype=w.dtype)).point
        return jnp.where(self.held, x, self.from_box(jnp.clip(moved, 0.0, 1.0)))


def spread(values: Float[Array, " m"], candidates: Float[Array, "m d"], count: int, apart: float = 0.1):
    """Rows of good candidates from different places: the best, the best further than `apart` from it, and so on.

    `values` (m,), `candidates` (m, d) -> (count,) row numbers.
    """

    def pick(remaining, _):
        row = jnp.argmax(remaining)
        near = jnp.sum((candidates - candidates[row][None, :]) ** 2, axis=1) < apart**2
        return jnp.where(near, -jnp.inf, remaining), row

    return jax.lax.scan(pick, values, None, length=count)[1]


def _polish(
    score: Callable[[Float[Array, " d"]], Float[Array, ""]],
    start: Float[Array, " d"],
    steps: int,
    gain: Any,
    options: dict[str, Any],
) -> tuple[Float[Array, " d"], Float[Array, ""]]:
    """Newton's method within the unit cube, or between the walls of `options`: where it ends, and the score there."""
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


def thompson(
    key: PRNGKeyArray, mean: Float[Array, " m"], covariance: Float[Array, "m m"]
) -> tuple[Int[Array, ""], Float[Array, " m"]]:
    """Row of the maximum of one joint draw of f at m candidates, and the draw (m,).

    `covariance` is the joint posterior covariance, (m, m); its eigenvector root needs no jitter.
    """
    eigenvalues, vectors = eigh(covariance)
    root = vectors * jnp.sqrt(jnp.where(eigenvalues > 0, eigenvalues, 0.0))[None, :]
    draw = mean + root @ jax.random.normal(key, mean.shape, mean.dtype)
    return jnp.argmax(draw), draw
