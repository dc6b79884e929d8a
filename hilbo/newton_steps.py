"""Newton's method for the mode of a log-concave posterior, as two root finders of optimistix.

Full steps on the weights, and damped steps in any coordinates. A separate module because optimistix is slow to
import: `hilbo.laplace` imports it only when a fit is traced.
"""

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Int, PyTree

from hilbo.gaussian import Matrix, Scalar, Vector, distance, factorise, residual_tolerance
from hilbo.numerics.linalg import cholesky, solve_lower, solve_lower_transposed

__all__ = ["Ascent", "DampedNewton", "FullNewton", "Height", "Whitened", "climbed"]

Terms = Callable[[Vector], tuple[Vector, Vector, Vector]]
"""Log-likelihood terms, their slopes and curvatures, as `hilbo.laplace` has them."""


class _FullState(eqx.Module):
    """State at the weights evaluated last."""

    eta: Vector  # K a
    objective: Scalar
    residual: Scalar
    risen: Bool[Array, ""]


class FullNewton(optx.AbstractRootFinder):
    """Full Newton steps on the weights a, eta = K a, as long as the log posterior rises (R & W, algorithm 3.1).

    The function whose root is sought is ignored: `args` are the terms and K. One evaluation per iteration, the first of
    them at the start.
    """

    rtol: float = 0.0
    atol: float = 0.0
    norm: Callable = optx.two_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        """Initial state, before any evaluation: log posterior -inf, residual inf; arguments of optimistix."""
        del fn, args, options, f_struct, aux_struct, tags
        infinite = jnp.asarray(jnp.inf, y.dtype)
        return _FullState(y, -infinite, infinite, jnp.asarray(True))

    def step(self, fn, y, args, options, state, tags):
        """Evaluate log posterior and residual at the weights `y` (n,), and take a full Newton step from there.

        Returns the next weights, the state with the values at `y`, and None (no auxiliary output).
        """
        del fn, options, tags
        terms, covariance = args
        eta = covariance @ y
        values, slope, curvature = terms(eta)
        root, _, lower = factorise(covariance, curvature)
        target = curvature * eta + slope
        half = solve_lower(lower, (root * (covariance @ target))[:, None])
        following = target - root * solve_lower_transposed(lower, half)[:, 0]
        mismatch = slope - y
        residual = distance(mismatch, covariance @ mismatch)
        objective = jnp.sum(values) - 0.5 * y @ eta
        slack = 4.0 * jnp.finfo(y.dtype).eps * (jnp.sum(jnp.abs(values)) + jnp.abs(y @ eta))
        return following, _FullState(eta, objective, residual, objective >= state.objective - slack), None

    def terminate(self, fn, y, args, options, state, tags):
        """Whether the last evaluated residual is at most the tolerance, or the log posterior did not rise; and the
        result code, which is always success: the caller has to compare the residual.
        """
        del fn, args, options, tags
        return ~(state.risen & (state.residual > self.tolerance(y.dtype))), optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        """Return the weights and the auxiliary output unchanged, and no statistics."""
        del fn, args, options, state, tags, result
        return y, aux, {}

    @staticmethod
    def tolerance(dtype: DTypeLike) -> Scalar:
        """Tolerance of the residual in this dtype, in standard deviations of the prior: eps^(2/3). A scalar."""
        return residual_tolerance(jnp.zeros((), dtype))


class Height(eqx.Module):
    """Log posterior at a point, its rounding error, a bound on the distance to the mode (`residual`, in standard
    deviations of the prior), and the tolerance of that residual; scalars.
    """

    objective: Scalar
    rounding: Scalar
    """Rounding error of the objective."""
    residual: Scalar
    """A bound on the distance to the mode, in standard deviations of the prior."""
    tolerance: Scalar
    """What the residual has to reach."""


@runtime_checkable
class Ascent(Protocol):
    """Interface of a concave log posterior in coordinates of any shape, which `DampedNewton` maximises."""

    def at(self, point: Array, /) -> tuple[Height, PyTree]:
        """The `Height` at a point (log posterior, its rounding error, a bound on the distance to the mode and the
        tolerance of that), and intermediate results there, which are passed to `towards`."""
        ...

    def towards(self, point: Array, known: PyTree, /) -> tuple[Array, Scalar]:
        """Newton step from a point, of the point's shape, and the slope of the log posterior along it.

        `known`: the second result of `at` for that point.
        """
        ...


class _Search(eqx.Module):
    """The height of the best point so far, and the step from it that is evaluated next."""

    height: Height
    direction: Array
    scale: Scalar  # of the next step along `direction`
    gain: Scalar  # rate of ascent along `direction`


class DampedNewton(optx.AbstractRootFinder):
    """Newton steps damped by Armijo's rule; one evaluation per iteration, the first of them at the start.

    A step is accepted if the log posterior rose by a fraction of the increase predicted by the slope (beyond its own
    rounding), else its scale is halved. `args` is an `Ascent`; the function whose root is sought is ignored.
    """

    rtol: float = 0.0
    atol: float = 0.0
    norm: Callable = optx.two_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        """Initial state, before any evaluation: height -inf, residual inf, a step of 0; arguments of optimistix."""
        del fn, args, options, f_struct, aux_struct, tags
        infinite = jnp.asarray(jnp.inf, y.dtype)
        zero, one = jnp.zeros_like(infinite), jnp.ones_like(infinite)
        return _Search(Height(-infinite, zero, infinite, zero), jnp.zeros_like(y), one, zero)

    def step(self, fn, y, args, options, state, tags):
        """Evaluate the point one scaled step from the best point `y`. If the height rose enough, that point becomes the
        best one and its Newton step the next; else the scale of the step is halved.

        Returns the best point, the state, and None. A start whose height is NaN makes the scale 0, which ends the
        search.
        """
        del fn, options, tags
        trial = y + state.scale * state.direction
        reached, known = args.at(trial)
        promised = state.height.objective + 1e-4 * state.scale * state.gain
        risen = reached.objective >= promised - reached.rounding
        direction, gain = jax.lax.cond(  # a factorisation, which neither the mode nor a step that is halved needs
            risen & (reached.residual > reached.tolerance),
            lambda: args.towards(trial, known),
            lambda: (state.direction, state.gain),
        )
        # A start without a finite objective ends the search.
        halved = jnp.where(jnp.isfinite(state.height.objective), 0.5 * state.scale, 0.0)
        scale = jnp.where(risen, jnp.ones_like(halved), halved)
        y, height = jax.tree.map(lambda new, old: jnp.where(risen, new, old), (trial, reached), (y, state.height))
        return y, _Search(height, direction, scale, gain), None

    def terminate(self, fn, y, args, options, state, tags):
        """Whether the residual of the best point is at most its tolerance, or the scale of the step is below 1e-12; and
        the result code, which is always success.
        """
        del fn, y, args, options, tags
        ended = (state.height.residual <= state.height.tolerance) | (state.scale < 1e-12)
        return ended, optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        """Return the best point and the auxiliary output unchanged, and no statistics."""
        del fn, args, options, state, tags, result
        return y, aux, {}


def climbed(ascent: Ascent, start: Array, max_steps: int) -> tuple[Array, Height, Int[Array, ""]]:
    """Maximise `ascent` from the point `start` by damped Newton steps.

    Returns the best point, of the shape of `start`, its height, and the number of evaluations, the start included.
    Never raises: after `max_steps` evaluations the residual may be above its tolerance.
    """
    solution = optx.root_find(_unused_function, DampedNewton(), start, ascent, max_steps=max_steps, throw=False)
    return solution.value, solution.state.height, jnp.asarray(solution.stats["num_steps"], jnp.int32)


def _unused_function(point: Array, ascent: Ascent) -> Array:
    """Return `point`. Optimistix needs a function for its root finder; `DampedNewton` ignores it."""
    del ascent
    return point


class Whitened(eqx.Module):
    """The log posterior in v, eta = R v, in which it is strongly concave with modulus 1."""

    terms: Terms
    root: Matrix

    def at(self, v: Vector) -> tuple[Height, tuple[Vector, Vector]]:
        """Height at `v` (n,); and the gradient R'grad l - v (n,) of the log posterior and the curvatures W (n,)
        there.
        """
        root = self.root
        values, slope, curvature = self.terms(root @ v)
        uphill = root.T @ slope - v
        epsilon, magnitude = jnp.finfo(v.dtype).eps, jnp.abs(root)
        summed = magnitude.T @ (jnp.abs(slope) + curvature * (magnitude @ jnp.abs(v))) + jnp.abs(v)
        # Rounding of the values, and of R v times the slopes, which dominates at little noise.
        size = jnp.sum(jnp.abs(values)) + 0.5 * v @ v + jnp.abs(slope) @ (magnitude @ jnp.abs(v))
        height = Height(
            objective=jnp.sum(values) - 0.5 * v @ v,
            rounding=4.0 * epsilon * size,
            residual=jnp.linalg.norm(uphill),
            tolerance=residual_tolerance(jnp.linalg.norm(summed)),
        )
        return height, (uphill, curvature)

    def towards(self, v: Vector, known: tuple[Vector, Vector]) -> tuple[Vector, Scalar]:
        """Newton step (I + R'WR)^-1 gradient from a point, (n,), and the slope along it; `known` as from `at`."""
        uphill, curvature = known
        root = self.root
        newton_matrix = jnp.eye(v.shape[0], dtype=v.dtype) + (root.T * curvature[None, :]) @ root
        lower = cholesky(newton_matrix)
        half = solve_lower(lower, uphill[:, None])
        direction = solve_lower_transposed(lower, half)[:, 0]
        return direction, uphill @ direction
