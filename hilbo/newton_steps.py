"""Newton's method for the mode of a log-concave posterior, as two root finders of optimistix.

Full steps on the weights, and damped steps in whitened coordinates. A module of its own because optimistix is slow to
import: `hilbo.laplace` imports it only when a fit is traced.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.typing import DTypeLike
from jaxtyping import Array, Bool

from hilbo.gaussian import Matrix, Scalar, Vector, factorise
from hilbo.numerics.linalg import cholesky, solve_lower, solve_lower_transposed

__all__ = ["DampedNewton", "FullNewton"]

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

    `args` are the terms and K. One evaluation per iteration, the first of them at the start.
    """

    rtol: float = 0.0
    atol: float = 0.0
    norm: Callable = optx.two_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        """Initial state, before any evaluation."""
        del fn, args, options, f_struct, aux_struct, tags
        infinite = jnp.asarray(jnp.inf, y.dtype)
        return _FullState(y, -infinite, infinite, jnp.asarray(True))

    def step(self, fn, y, args, options, state, tags):
        """Evaluate the weights `y` and take a full Newton step."""
        del fn, options, tags
        terms, covariance = args
        eta = covariance @ y
        values, slope, curvature = terms(eta)
        root, _, lower = factorise(covariance, curvature)
        target = curvature * eta + slope
        half = solve_lower(lower, (root * (covariance @ target))[:, None])
        following = target - root * solve_lower_transposed(lower, half)[:, 0]
        mismatch = slope - y
        # |off| |K off| >= off' K off, and unlike it cannot be rounded to less than 0.
        residual = jnp.sqrt(jnp.linalg.norm(mismatch) * jnp.linalg.norm(covariance @ mismatch))
        objective = jnp.sum(values) - 0.5 * y @ eta
        slack = 4.0 * jnp.finfo(y.dtype).eps * (jnp.sum(jnp.abs(values)) + jnp.abs(y @ eta))
        return following, _FullState(eta, objective, residual, objective >= state.objective - slack), None

    def terminate(self, fn, y, args, options, state, tags):
        """Whether the residual is below the tolerance, or the log posterior has stopped rising."""
        del fn, args, options, tags
        return ~(state.risen & (state.residual > self.tolerance(y.dtype))), optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        del fn, args, options, state, tags, result
        return y, aux, {}

    @staticmethod
    def tolerance(dtype: DTypeLike) -> Scalar:
        """Tolerance of the residual, in standard deviations of the prior."""
        return jnp.asarray(jnp.finfo(dtype).eps ** (2 / 3), dtype)


class _NewtonState(eqx.Module):
    """Best point so far, and the step to be evaluated next."""

    v: Vector  # the mode in whitened coordinates, eta = R v
    direction: Vector
    scale: Scalar  # of the next step along `direction`
    gain: Scalar  # rate of ascent along `direction`
    objective: Scalar
    residual: Scalar
    tolerance: Scalar


class DampedNewton(optx.AbstractRootFinder):
    """Newton steps damped by Armijo's rule in whitened coordinates; one evaluation per iteration.

    The point `v + scale * direction` is accepted if the log posterior rose by a fraction of the increase predicted by
    the slope (beyond its own rounding), else the scale is halved. `options` hold the root R and the start v.
    """

    rtol: float = 0.0
    atol: float = 0.0
    norm: Callable = optx.two_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        """Initial state at `options["start"]`, before any evaluation."""
        del fn, args, f_struct, aux_struct, tags
        infinite = jnp.asarray(jnp.inf, y.dtype)
        zero, one = jnp.zeros_like(infinite), jnp.ones_like(infinite)
        return _NewtonState(options["start"], jnp.zeros_like(y), one, zero, -infinite, infinite, zero)

    def step(self, fn, y, args, options, state, tags):
        """Evaluate the planned point; accept it, or halve the step."""
        del fn, tags
        root = options["root"]
        trial = state.v + state.scale * state.direction
        taken, slack = _newton_state(args[0], root, trial)
        risen = taken.objective >= state.objective + 1e-4 * state.scale * state.gain - slack
        # A start without a finite objective ends the search.
        halved = jnp.where(jnp.isfinite(state.objective), 0.5 * state.scale, 0.0)
        refused = eqx.tree_at(lambda s: s.scale, state, halved)
        state = jax.tree.map(lambda new, old: jnp.where(risen, new, old), taken, refused)
        return jnp.where(risen, root @ trial, y), state, None

    def terminate(self, fn, y, args, options, state, tags):
        """Whether the residual is below its tolerance, or the step has become negligible."""
        del fn, y, args, options, tags
        return (state.residual <= state.tolerance) | (state.scale < 1e-12), optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        del fn, args, options, state, tags, result
        return y, aux, {}


def _newton_state(terms: Terms, root: Matrix, v: Vector) -> tuple[_NewtonState, Scalar]:
    """State at `v`: objective, residual with its tolerance, and next direction.

    Also the rounding error of the objective.
    """
    values, slope, curvature = terms(root @ v)
    uphill = root.T @ slope - v
    newton_matrix = jnp.eye(v.shape[0], dtype=v.dtype) + (root.T * curvature[None, :]) @ root
    lower = cholesky(newton_matrix)
    half = solve_lower(lower, uphill[:, None])
    direction = solve_lower_transposed(lower, half)[:, 0]
    epsilon, magnitude = jnp.finfo(v.dtype).eps, jnp.abs(root)
    summed = magnitude.T @ (jnp.abs(slope) + curvature * (magnitude @ jnp.abs(v))) + jnp.abs(v)
    state = _NewtonState(
        v=v,
        direction=direction,
        scale=jnp.ones_like(v[0]),
        gain=uphill @ direction,
        objective=jnp.sum(values) - 0.5 * v @ v,
        residual=jnp.linalg.norm(uphill),
        tolerance=jnp.clip(4.0 * epsilon * jnp.linalg.norm(summed), epsilon ** (2 / 3), epsilon**0.25),
    )
    # Rounding of the values, and of R v times the slopes, which dominates at little noise.
    return state, 4.0 * epsilon * (jnp.sum(jnp.abs(values)) + 0.5 * v @ v + jnp.abs(slope) @ (magnitude @ jnp.abs(v)))
