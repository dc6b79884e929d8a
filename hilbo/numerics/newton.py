"""Newton's method with a trust region for a function of a few variables in a box; an optimistix minimiser.

For functions whose exact Hessian costs little more than their value: the evidence as a function of hyperparameters, and
the acquisition function at one point. No scaling is needed, and the result is exact to rounding.

Variables at a bound with the gradient pointing outwards are fixed. Along each eigenvector of the others' Hessian the
step is -g_i / (|h_i| + |g| / radius): Newton's where the gradient is small, never longer than the radius, downhill
along negative curvature; a step that would leave the box is cut off at the bound. Linear walls of any direction are
treated alike: directions blocked by active walls are removed, and the step ends at the nearest point between the walls,
in the metric of its own stiffness (`hilbo.numerics.polytope`). A step is accepted if the function decreases by a
fraction of the decrease predicted by the quadratic model, else the radius shrinks and the step turns towards steepest
descent, so that it converges from every start. One evaluation per iteration. References: Nocedal & Wright (2006),
chapter 4; Bertsekas (1982), SIAM J. Control Optim. 20:221 (fixed variables).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from hilbo.numerics.linalg import eigh
from hilbo.numerics.polytope import Polytope, nearest, projector, walls_of_cube

__all__ = ["Expansion", "TrustRegionNewton", "arrives", "expanded"]

_FIRST_RADIUS = 1.0
_SAME = 1e-2  # distance within which ends count as the same minimum (in logarithmic coordinates)
_TOUCHES = 1e-10  # distance to a wall, in ranges, within which it is active
_ENOUGH, _GOOD = 1e-4, 0.75  # fractions of the predicted decrease: to accept a step, and to enlarge the radius


class Expansion(NamedTuple):
    """Value, gradient and Hessian at a point, and auxiliary output of the function."""

    value: Float[Array, ""]
    gradient: Float[Array, " p"]
    hessian: Float[Array, "p p"]
    aux: PyTree


def expanded(
    function: Callable[[Float[Array, " p"]], tuple[Float[Array, ""], PyTree]], at: Float[Array, " p"]
) -> Expansion:
    """Expand a function that returns (value, aux) at a point (p,) by automatic differentiation."""

    def slope(point):
        value, pull, aux = jax.vjp(function, point, has_aux=True)
        (gradient,) = pull(jnp.ones_like(value))
        return gradient, (value, gradient, aux)

    hessian, (value, gradient, aux) = jax.jacfwd(slope, has_aux=True)(at)
    return Expansion(value, gradient, hessian, aux)


class _State(eqx.Module):
    """Best point so far, and the step from it to be evaluated next."""

    here: Expansion
    move: Float[Array, " p"]  # the next step,
    promised: Float[Array, ""]  # and by how much it lowers the quadratic model
    radius: Float[Array, ""]
    pressing: Float[Array, ""]  # largest component of the gradient without active walls
    ahead: Float[Array, ""]  # decrease of the model within a radius of 1, for any radius


class TrustRegionNewton(optx.AbstractMinimiser):
    """Trust-region Newton minimiser for `optimistix.minimise`. `options` may contain

    - "lower" and "upper": bounds, each like the variables;
    - "walls" (a `Polytope`) and "held": instead of bounds, linear walls within the unit cube, and which variables stay
      fixed. The start is between the walls;
    - "expand": a function of the variables, and of the auxiliary output at the best point so far, that returns an
      [`Expansion`][] in the variables as one vector, instead of automatic differentiation;
    - "begun": the result of "expand" at the start, which then is not evaluated again;
    - "known": ends (k, p) of other searches, NaN where there is none. A search whose next step leads to one stops.

    Stops if no free component of the gradient is above `atol`, if the quadratic model decreases by less than `gain`
    within a radius of 1 (a plateau, on which a gradient may vanish slowly), or if the trust radius is below
    `resolution` (a kink of the function, or its rounding); `state.here` is the expansion at the end. Stops at once if
    the function is not finite at the start.
    """

    rtol: float = 0.0
    atol: float = 1e-6
    norm: Callable = optx.max_norm
    resolution: float = 1e-12
    gain: float | Float[Array, ""] = 0.0

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        """Initial state, with the first step planned if the expansion at the start is given as "begun".

        Otherwise the state is empty, its value inf, and the first step evaluates the start.
        """
        del fn, args, f_struct, tags
        flat, _ = ravel_pytree(y)
        if "begun" in options:
            expansion = options["begun"]
            return _planned(expansion, flat, jnp.full_like(flat[0], _FIRST_RADIUS), options)
        infinite = jnp.full_like(flat, jnp.inf)
        aux = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), aux_struct)
        nowhere = Expansion(infinite[0], infinite, jnp.zeros((flat.size, flat.size), flat.dtype), aux)
        zero = jnp.zeros_like(flat[0])
        return _State(nowhere, jnp.zeros_like(flat), zero, zero + _FIRST_RADIUS, infinite[0], infinite[0])

    def step(self, fn, y, args, options, state, tags):
        """Evaluate the planned step, accept or reject it, and plan the next.

        Returns the best point so far, the next state, and the auxiliary output at that point.
        """
        del tags
        flat, restore = ravel_pytree(y)
        trial = flat + state.move
        expand = options.get("expand")
        expansion = (
            expanded(lambda point: fn(restore(point), args), trial)
            if expand is None
            else expand(restore(trial), state.here.aux)
        )
        achieved = state.here.value - expansion.value
        taken = achieved > _ENOUGH * state.promised  # never if it is not a number
        good = taken & jnp.isfinite(achieved) & (achieved > _GOOD * state.promised)
        radius = state.radius * jnp.where(good, 2.0, jnp.where(taken, 1.0, 0.25))
        best = jax.tree.map(lambda new, old: jnp.where(taken, new, old), expansion, state.here)
        flat = jnp.where(taken, trial, flat)
        return restore(flat), _planned(best, flat, radius, options), best.aux

    def terminate(self, fn, y, args, options, state, tags):
        """Whether to stop, with the result code, which is always "successful".

        Stops where the point is stationary within the box, stuck, on a plateau, or where the next step leads to a known
        end.
        """
        del fn, args, tags
        ended = (state.pressing <= self.atol) | (state.ahead < self.gain) | (state.radius < self.resolution)
        earlier_ends = options.get("known")
        if earlier_ends is not None:
            ended |= arrives(y, state.move, earlier_ends)
        return ended, optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        """Return the point and its auxiliary output unchanged, and empty statistics; required by optimistix."""
        del fn, args, options, state, tags, result
        return y, aux, {}


def arrives(y: PyTree, move: Float[Array, " p"], ends: Float[Array, "k p"]) -> Bool[Array, ""]:
    """Whether the step `move` from `y` leads to one of the known `ends`, to 0.01 in every coordinate; never to NaN."""
    target = ravel_pytree(y)[0] + move
    return jnp.any(jnp.max(jnp.abs(ends - target[None, :]), axis=1) < _SAME)


def _planned(
    expansion: Expansion, point: Float[Array, " p"], radius: Float[Array, ""], options: dict[str, Any]
) -> _State:
    """State at `point` with the next step, between the "walls" of `options`, with its mask "held" of coordinates that
    do not move, or else between its bounds "lower" and "upper" (default: none).

    `expansion`: the function's, at `point`; `radius`: trust radius.
    """
    if "walls" in options:
        return _plan_between(expansion, point, radius, options["walls"], options["held"])
    none = jnp.full_like(point, jnp.inf)
    lower, upper = (ravel_pytree(options.get(side, end))[0] for side, end in (("lower", -none), ("upper", none)))
    return _plan(expansion, point, radius, lower, upper)


def _plan_between(
    expansion: Expansion, point: Float[Array, " p"], radius: Float[Array, ""], walls: Polytope, held: Bool[Array, " p"]
) -> _State:
    """State at `point` with the next step, between linear walls within the unit cube; `held` variables do not move."""
    seen = walls_of_cube(walls, held, point)
    plain = jnp.eye(point.size, dtype=point.dtype)
    touching = seen.offsets <= _TOUCHES
    corner = Polytope(jnp.where(touching[:, None], seen.normals, 0.0), jnp.where(touching, 0.0, 1.0))
    downhill = nearest(corner, jnp.where(held, 0.0, -expansion.gradient), plain)
    pressing = -downhill.point  # projected gradient at active walls
    hessian = jnp.where(held[:, None] | held[None, :], plain, expansion.hessian)
    free = projector(seen.normals, downhill.multipliers > 0.0)
    eigenvalues, vectors = eigh(free @ hessian @ free + (plain - free))
    steepness = jnp.linalg.norm(pressing)
    stiffness = jnp.abs(eigenvalues) + steepness / radius
    stiffness = jnp.where(stiffness > 0, stiffness, 1.0)
    turned = jnp.where(held, 0.0, expansion.gradient) @ vectors
    move = nearest(seen, -vectors @ (turned / stiffness), vectors / jnp.sqrt(stiffness)[None, :]).point
    move = jnp.where(held, 0.0, move)  # a level stays itself to the last bit; products of the eigenvectors round
    along = move @ vectors
    promised = -(turned @ along + 0.5 * along @ (stiffness * along))
    slow = jnp.abs(eigenvalues) + steepness
    fall = 0.5 * jnp.sum((pressing @ vectors) ** 2 / jnp.where(slow > 0, slow, 1.0))
    return _State(expansion, move, promised, radius, jnp.max(jnp.abs(pressing)), fall)


def _plan(
    expansion: Expansion,
    point: Float[Array, " p"],
    radius: Float[Array, ""],
    lower: Float[Array, " p"],
    upper: Float[Array, " p"],
) -> _State:
    """State at `point` with the next step, within the box [lower, upper]."""
    held = (point <= lower) & (expansion.gradient >= 0) | (point >= upper) & (expansion.gradient <= 0)
    gradient = jnp.where(held, 0.0, expansion.gradient)
    hessian = jnp.where(held[:, None] | held[None, :], jnp.eye(point.size, dtype=point.dtype), expansion.hessian)
    eigenvalues, vectors = eigh(hessian)
    turned = gradient @ vectors
    steepness = jnp.linalg.norm(turned)
    stiffness = jnp.abs(eigenvalues) + steepness / radius
    # No gradient, no step; only then may the stiffness be 0.
    move = -vectors @ (turned / jnp.where(stiffness > 0, stiffness, 1.0))
    move = jnp.minimum(jnp.maximum(point + move, lower), upper) - point
    promised = -(gradient @ move + 0.5 * move @ hessian @ move)
    slow = jnp.abs(eigenvalues) + steepness
    fall = 0.5 * jnp.sum(turned**2 / jnp.where(slow > 0, slow, 1.0))
    return _State(expansion, move, promised, radius, jnp.max(jnp.abs(gradient)), fall)
