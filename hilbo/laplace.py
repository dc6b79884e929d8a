"""Laplace approximation for latent values with a Gaussian prior and a sum of pointwise log-likelihood terms.

Model: eta ~ N(0, K), log p(data | eta) = sum_i l_i(eta_i), each l_i concave. The terms may depend on any linear
functional of the latent function: a response at x_i has eta_i = f(x_i), a preference between two stimuli eta_i = f(x_i)
- f(x_i'); K is the prior covariance of the eta's, of any rank (repeated stimuli make it singular).

- Coordinates. eta = R v with v ~ N(0, I) and R the symmetric-eigenvector root of K, so K is never inverted and needs no
  jitter. The Newton matrix I + R'WR has no eigenvalue below 1, and the objective is strongly concave with modulus 1:
  the residual |R' grad l - v| *bounds* the distance to the mode, in units of the prior's standard deviations.
- The search begins with full Newton steps on the weights a, eta = K a (R & W, algorithm 3.1), which need no R: there v
  = R'a and the same residual is sqrt(r'Kr), r = grad l - a. If they do not converge, e.g. for contradictory responses
  with little noise, the search restarts in v, where it converges from every start: the steps are damped by Armijo's
  rule (`hilbo.newton_steps`).
- Derivatives of any order come from the stationarity eta = K grad l(eta) by the implicit function theorem, and from C =
  (K + 1/W)^-1 written so that W = 0 is no special case. R, whose derivative may not exist, is not differentiated.

Evidence: log q(data) = sum l - a'eta/2 - log|I + KW|/2, a = grad l(eta) at the mode. References: Rasmussen & Williams
(2006), sections 3.4 and 5.5.1; paper, section IV-1.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PyTree

from hilbo.gaussian import (
    GaussianPosterior,
    Matrix,
    Scalar,
    Vector,
    certify,
    factor,
    inverse_and_log_determinant,
    square_root,
    still,
)
from hilbo.numerics.linalg import one_at_a_time

__all__ = ["Mode", "Pointwise", "Terms", "find_mode", "laplace", "plain_mode"]


def __dir__() -> list[str]:
    return __all__


Terms = Callable[[Vector], tuple[Vector, Vector, Vector]]
"""Log-likelihood terms l_i(eta_i), their slopes l_i' and curvatures -l_i'' >= 0; [`Pointwise`][] derives the latter."""


_PLAIN_STEPS, _STEPS = 20, 200


class Pointwise(eqx.Module):
    """Terms given by their values alone, (n,) -> (n,) elementwise; slopes and curvatures by differentiation."""

    log_likelihood: Callable[[Vector], Vector]

    def __call__(self, eta: Vector) -> tuple[Vector, Vector, Vector]:
        """Values, slopes and minus second derivatives of the terms at `eta` (n,), (n,) each."""
        ones = jnp.ones_like(eta)  # the terms are independent: one tangent serves them all

        def value_and_slope(eta):
            return jax.jvp(self.log_likelihood, (eta,), (ones,))

        (value, slope), (_, second) = jax.jvp(value_and_slope, (eta,), (ones,))
        return value, slope, -second


def laplace(
    covariance: Matrix, terms: Terms, *, start: Vector | None = None, max_steps: int = _STEPS
) -> GaussianPosterior:
    """Approximate p(eta | data) by a Gaussian at its mode.

    **Arguments:**

    - `covariance`: K, (n, n), symmetric, positive semi-definite. Terms that always return 0 (padding) change nothing.
    - `terms`: eta (n,) -> values, slopes and curvatures, (n,) each; a pytree (such as an `eqx.Module`) if it contains
      arrays that are traced. [`Pointwise`][] makes one from values alone.
    - `start`: `weights` (n,) of an earlier, similar fit (default: 0); changes the number of steps, not the result.
    - `max_steps`: largest number of Newton steps of each search.

    **Returns:** a [`GaussianPosterior`][]; differentiable in `covariance` and in the arrays of `terms`. Never raises:
    read `certificate.converged`.
    """
    start = jnp.zeros_like(covariance[0]) if start is None else start
    mode, residual, tolerance, iterations, changed = find_mode(terms, covariance, start, max_steps)
    values, gradient, curvature = terms(mode)
    inverse, log_determinant = inverse_and_log_determinant(covariance, curvature)
    fixed = jax.lax.stop_gradient((covariance, curvature))
    root, condition = factor(*fixed)
    log_evidence = jnp.sum(values) - 0.5 * gradient @ mode - 0.5 * log_determinant
    certificate = certify(
        fixed[0],
        *jax.lax.stop_gradient((mode, gradient, curvature)),
        root,
        lambda eta: still(terms)(eta)[2],
        jax.lax.stop_gradient(log_evidence),
        residual=residual,
        tolerance=tolerance,
        iterations=iterations,
        jitter=changed / jnp.max(jnp.diagonal(fixed[0])),
        condition=condition,
    )
    return GaussianPosterior(mode, gradient, root, inverse, log_evidence, jax.lax.stop_gradient(certificate))


# --- the mode


class Mode(NamedTuple):
    """Mode, its residual and tolerance, number of steps, and change of K by its square root."""

    eta: Vector
    residual: Scalar
    tolerance: Scalar
    steps: Int[Array, ""]
    changed: Scalar


@eqx.filter_custom_jvp
def find_mode(terms: Terms, covariance: Matrix, start: Vector, max_steps: int) -> Mode:
    """Find the mode of log p(data | eta) - eta'K^-1 eta / 2: by `plain_mode` from the weights `start`, with at most 20
    steps; if that does not converge, by damped Newton steps in v from 0, with at most `max_steps`.

    `covariance` K (n, n), `start` (n,). Never raises: the search converged if `residual <= tolerance`. Under `vmap` the
    problems are solved one by one on CPUs, each stopping when it has converged; on other devices all at once by the
    damped steps from 0, without `start`. Only `eta` is differentiable, in the arrays of `terms` and in `covariance`.
    """
    arrays, rest = eqx.partition(terms, eqx.is_array)

    def safe(arrays, covariance, start):
        return _whitened_mode(eqx.combine(arrays, rest), covariance, jnp.zeros_like(start), max_steps)

    def quick(arrays, covariance, start):
        mode = plain_mode(eqx.combine(arrays, rest), covariance, start, min(max_steps, _PLAIN_STEPS))
        done = mode.residual <= mode.tolerance
        return jax.lax.cond(done, lambda *_: mode, safe, arrays, covariance, start)

    return one_at_a_time(quick, safe)(arrays, covariance, start)


def plain_mode(terms: Terms, covariance: Matrix, start: Vector, max_steps: int) -> Mode:
    """Search for the mode by full Newton steps on the weights from `start`, as long as the log posterior rises.

    `covariance` (n, n), `start` (n,). Returns the last iterate, converged or not; its `changed` is 0, since no root of
    K is used. No derivatives.
    """
    import optimistix as optx  # slow to import, and needed only where a fit is traced

    from hilbo.newton_steps import FullNewton

    solution = optx.root_find(_stationarity, FullNewton(), start, (terms, covariance), max_steps=max_steps, throw=False)
    state, tolerance = solution.state, FullNewton.tolerance(start.dtype)
    steps = jnp.asarray(solution.stats["num_steps"], jnp.int32)
    return Mode(state.eta, state.residual, tolerance, steps, jnp.zeros_like(tolerance))


def _whitened_mode(terms: Terms, covariance: Matrix, start: Vector, max_steps: int) -> Mode:
    """Search for the mode by damped Newton steps in v, from the v that corresponds to the weights `start` (n,).

    Returns the best iterate, converged or not.
    """
    from hilbo.newton_steps import Whitened, climbed  # imports optimistix, which is slow

    root, changed = square_root(covariance)
    v, height, steps = climbed(Whitened(terms, root), root.T @ start, max_steps)
    return Mode(root @ v, height.residual, height.tolerance, steps, changed)


@find_mode.def_jvp
def find_mode_jvp(primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]) -> tuple[Mode, Mode]:
    """Result of `find_mode` and its tangents: (I + K W) d eta = d(K grad l) at fixed eta, with (I + K W)^-1 = I - K C.

    `primals`, `tangents`: the arguments of `find_mode` and their tangents. Only `eta` has a tangent; the other fields
    have None.
    """
    terms, covariance, _, _ = primals
    mode = find_mode(*primals)

    def image(terms, matrix):
        _, slope, curvature = terms(mode.eta)
        return matrix @ slope, curvature

    (_, curvature), (moved, _) = eqx.filter_jvp(image, (terms, covariance), tangents[:2])
    inverse, _ = inverse_and_log_determinant(covariance, curvature)
    nothing: Any = None  # the rest has no derivative
    return mode, Mode(moved - covariance @ (inverse @ moved), nothing, nothing, nothing, nothing)


def _stationarity(eta: Vector, args: tuple[Terms, Matrix]) -> Vector:
    """eta - K grad l(eta), (n,), which is 0 at the mode; `args` are the terms and K."""
    terms, covariance = args
    return eta - covariance @ terms(eta)[1]
