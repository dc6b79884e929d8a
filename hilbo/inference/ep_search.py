"""Search for the fixed point of expectation propagation: damped updates far from it, Newton's steps near it.

Notation and equations are those of `hilbo.inference.ep`. `find` returns the cavities, without derivatives.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from hilbo.gaussian import Matrix, Scalar, Vector, residual_tolerance, square_root
from hilbo.inference.ep_sites import Joint, Sites, Tilted, coupling, joint_of, sites_of, solve
from hilbo.laplace import plain_mode
from hilbo.numerics.linalg import one_at_a_time

__all__ = ["Cavities", "Found", "find", "residual_of"]

_QUICK_STEPS = 20
_BASIN = 3.0  # mismatch, in posterior sds, below which Newton's step is tried


class Cavities(NamedTuple):
    """Cavity means and variances, (n,) each; variances that are not positive mark the absence of a start."""

    mean: Vector
    variance: Vector

    @property
    def known(self) -> Bool[Array, ""]:
        """Whether these are a start: all variances are positive, and all numbers finite. A scalar."""
        return jnp.all((self.variance > 0) & jnp.isfinite(self.variance) & jnp.isfinite(self.mean))


class Found(NamedTuple):
    """Record of the search: residual, its tolerance, number of steps, and the change of K by its square root, 0 where
    no root was needed.
    """

    residual: Scalar
    """Infinite if a `hasty` search ended without measuring it; `residual_of` then computes it."""
    tolerance: Scalar
    iterations: Int[Array, ""]
    changed: Scalar


class _State(eqx.Module):
    """State of the search."""

    mean: Vector  # of the cavities, as is the variance
    variance: Vector
    residual: Scalar
    tolerance: Scalar
    mismatch: Scalar  # before a Newton step, infinite before an update
    ahead: Scalar  # mismatch predicted after the step
    basin: Scalar
    updates: Int[Array, ""]
    steps: Int[Array, ""]


def find(
    terms: Tilted,
    covariance: Matrix,
    start: Vector | Cavities | None,
    max_steps: int,
    hasty: bool | Bool[Array, ""] = False,
) -> tuple[Vector, Vector, Found]:
    """Search for the cavity means and variances (n,) at the fixed point; returns them and the record of the search.

    `covariance` K (n, n); `start`: weights (n,), cavities, or None for Laplace's mode. Never raises: the search
    converged if `residual <= tolerance`. A `hasty` search omits the last evaluation, which would only confirm that
    Newton's method has converged; its residual is then infinite. No derivatives.

    Under `vmap` the problems are solved one by one on CPUs, each stopping when it has converged; elsewhere all at once,
    with a root of K, from weights or cavities `start` or else the prior, never hasty.
    """
    arrays, rest = eqx.partition(terms, eqx.is_array)

    def with_root(terms, covariance, initial):
        root, changed = square_root(covariance)
        return _search(terms, covariance, root, initial(root), max_steps, changed, jnp.asarray(False))

    def safe(arrays, covariance, start, hasty):
        del hasty
        terms = eqx.combine(arrays, rest)
        return with_root(terms, covariance, lambda root: _initial(terms, covariance, root, start))

    def quick(arrays, covariance, start, hasty):
        terms = eqx.combine(arrays, rest)
        none = jnp.zeros_like(covariance[0, 0])
        initial, first_steps = _initial_without_root(terms, covariance, start)
        mean, variance, end = _search(terms, covariance, None, initial, min(max_steps, _QUICK_STEPS), none, hasty)
        fixed_point = mean, variance, end._replace(iterations=end.iterations + first_steps)
        converged = (end.residual <= end.tolerance) | (hasty & jnp.isinf(end.residual))
        _, _, precision = terms(mean, variance)
        # s = K - KCK has the error eps K, and the cavity's variance this relative error:
        relative_error = jnp.finfo(none.dtype).eps * jnp.max(
            jnp.diagonal(covariance) * precision * (1.0 + precision * variance)
        )

        def restart(root):
            prior = _initial(terms, covariance, root, None)
            return jax.tree.map(lambda a, b: jnp.where(converged, a, b), (mean, variance), prior)

        def continued():
            mean, variance, last = with_root(terms, covariance, restart)
            spent_before = jnp.where(converged, fixed_point[2].iterations, 0)
            return mean, variance, last._replace(iterations=last.iterations + spent_before)

        return jax.lax.cond(converged & (relative_error <= 0.1 * end.tolerance), lambda: fixed_point, continued)

    return one_at_a_time(quick, safe)(arrays, covariance, start, jnp.asarray(hasty))


class _PointTerms(eqx.Module):
    """Terms at given latent values: those of cavities with variance 0, as Laplace's method needs them."""

    terms: Tilted

    def __call__(self, eta: Vector) -> tuple[Vector, Vector, Vector]:
        """Log likelihoods, slopes and precisions (n,) of the terms at latent values `eta` (n,)."""
        return self.terms(eta, jnp.zeros_like(eta))


def _search(
    terms: Tilted,
    covariance: Matrix,
    root: Matrix | None,
    initial: tuple[Vector, Vector],
    max_steps: int,
    changed: Scalar,
    hasty: Bool[Array, ""],
) -> tuple[Vector, Vector, Found]:
    """Iterate from the `initial` means and variances (n,) to the fixed point, or for at most `max_steps` steps.

    Returns means, variances and the record of the search, in which `changed` is passed through; a `hasty` search that
    omitted its last evaluation has the residual inf. `root`: of K, or None to do without.
    """
    largest = jnp.asarray(jnp.inf, covariance.dtype)
    count = jnp.zeros((), jnp.int32)
    basin = jnp.full_like(largest, _BASIN)
    mean, variance = initial
    first = _State(mean, variance, largest, jnp.zeros_like(largest), largest, largest, basin, count, count)

    def skips_check(search):
        return hasty & (search.ahead <= 0.1 * search.tolerance)

    def unfinished(search):
        # One step at least: Laplace's mode may be the fixed point, but only to the digits of its variances.
        done = (search.residual <= search.tolerance) & ((search.steps > 1) | (search.residual == 0.0))
        return (search.steps < max_steps) & ~done & ~skips_check(search) & ~jnp.isnan(search.mismatch)

    end = jax.lax.while_loop(unfinished, lambda search: _advance(terms, covariance, root, search), first)
    residual = jnp.where(skips_check(end) & (end.residual > end.tolerance), jnp.inf, end.residual)
    return end.mean, end.variance, Found(residual, end.tolerance, end.steps, changed)


def _initial_without_root(
    terms: Tilted, covariance: Matrix, start: Vector | Cavities | None
) -> tuple[tuple[Vector, Vector], Int[Array, ""]]:
    """Initial cavity means and variances (n,) for the search without a root, and the number of steps taken for them.

    From `start`; if that is None or has no start, at Laplace's mode, which is searched in at most 20 steps.
    """

    def from_mode():
        mode = plain_mode(_PointTerms(terms), covariance, jnp.zeros_like(covariance[0]), _QUICK_STEPS)
        initial = _initial(terms, covariance, None, _PointTerms(terms)(mode.eta)[1])
        return initial, mode.steps.astype(jnp.int32) - 1

    nothing = jnp.zeros((), jnp.int32)
    if start is None:
        return from_mode()
    if isinstance(start, Cavities):
        return jax.lax.cond(start.known, lambda: (tuple(start), nothing), from_mode)
    return _initial(terms, covariance, None, start), nothing


def _initial(
    terms: Tilted, covariance: Matrix, root: Matrix | None, start: Vector | Cavities | None
) -> tuple[Vector, Vector]:
    """Initial cavity means and variances (n,), by `start`.

    None: mean 0 and the prior variances. Cavities: these, or the former if they are no start. Weights (n,): cavities
    around the mean K `start`, with the sites' precisions there.
    """
    prior = jnp.diagonal(covariance)
    if start is None:
        return jnp.zeros_like(prior), prior
    if isinstance(start, Cavities):
        usable = start.known
        return jnp.where(usable, start.mean, 0.0), jnp.where(usable, start.variance, prior)
    mean = covariance @ start
    _, _, precision = terms(mean, jnp.zeros_like(mean))
    posterior = joint_of(covariance, root, precision)
    variance = posterior.variance / posterior.left
    return mean - variance * start, variance


def _advance(terms: Tilted, covariance: Matrix, root: Matrix | None, search: _State) -> _State:
    """One step of the search: evaluate the mismatch of the cavities in the state, then take a Newton step or a damped
    update.

    Residual and tolerance of the new state are those of the cavities before the step. A Newton step that failed to
    halve the mismatch is not undone, but narrows the region in which the next is tried.
    """
    m, v = search.mean, search.variance
    sites = sites_of(terms, m, v)
    posterior = joint_of(covariance, root, sites.precision)
    tilted = m + v * sites.slope
    natural = sites.slope + sites.precision * tilted
    means = _Means(tilted, natural, posterior.covariance @ natural)
    cavity = posterior.variance / posterior.left
    residual, tolerance, mismatch = _mismatch(covariance, root, search, sites, posterior, means)

    failed = mismatch > 0.5 * search.mismatch
    basin = jnp.where(failed, jnp.minimum(0.3 * search.basin, 0.9 * mismatch), search.basin)
    newton = mismatch < basin
    share = 0.5 / (1 + search.updates // 8).astype(v.dtype)
    target = means.matched - cavity * (natural - sites.precision * means.matched)
    dm, dv = jax.lax.cond(
        newton & ~((residual <= tolerance) & (search.steps > 0)),  # the end needs no further step
        lambda: _newton_step(sites, posterior, v, means.matched - tilted, cavity - v),
        lambda: (jnp.zeros_like(m), jnp.zeros_like(v)),
    )
    growth = jnp.clip(dv / v, -1.0, 1.0)
    return _State(
        mean=jnp.where(newton, m + dm, m + share * (target - m)),
        variance=jnp.where(newton, v * jnp.exp(growth), v * (cavity / v) ** share),
        residual=residual,
        tolerance=tolerance,
        mismatch=jnp.where(newton | jnp.isnan(mismatch), mismatch, jnp.inf),
        # Newton's steps square it, times what the last ones showed.
        ahead=jnp.where(newton, mismatch**2 * jnp.maximum(1.0, mismatch / search.mismatch**2), jnp.inf),
        basin=basin,
        updates=search.updates + jnp.where(newton, 0, 1),
        steps=search.steps + 1,
    )


class _Means(NamedTuple):
    """Means (n,) of the tilted distributions, their natural parameters a + t·mean, and the means of the joint
    posterior.
    """

    tilted: Vector
    natural: Vector
    matched: Vector


def _mismatch(
    covariance: Matrix, root: Matrix | None, search: _State, sites: Sites, posterior: Joint, means: _Means
) -> tuple[Scalar, Scalar, Scalar]:
    """Residual and tolerance of the worse of mean and variance; and the mismatch that controls the search, the larger
    of the largest difference of means in posterior standard deviations and the largest log ratio of variances; scalars.
    """
    tilted, natural, matched = means
    mean_gap = jnp.where(sites.precision > 0, jnp.abs(matched - tilted), 0.0)
    ratio = posterior.variance / (posterior.left * search.variance)
    log_ratio = jnp.where(sites.precision > 0, jnp.abs(jnp.log(ratio)), 0.0)
    prior = jnp.diagonal(covariance)
    residuals = jnp.stack([jnp.max(mean_gap / jnp.sqrt(prior)), jnp.max(log_ratio)])
    rounding = jnp.zeros_like(residuals)
    if root is not None:  # the final fallback stops at its rounding error
        summed = jnp.abs(root).T @ (jnp.abs(natural) + sites.precision * jnp.abs(matched))
        rounding = jnp.stack([jnp.linalg.norm(summed), jnp.max(1.0 + sites.precision * search.variance)])
    tolerances = residual_tolerance(rounding)
    worse = jnp.argmax(residuals / tolerances)
    mismatch = jnp.maximum(jnp.max(mean_gap / jnp.sqrt(posterior.variance)), residuals[1])
    return residuals[worse], tolerances[worse], mismatch


def residual_of(
    covariance: Matrix,
    cavities: Cavities,
    weights: Vector,
    precision: Vector,
    posterior: tuple[Vector, Callable[[Vector], Vector]],
) -> Scalar:
    """Residual of these cavities, as the search would compute it, a scalar.

    `weights`, `precision` (n,): slopes and precisions of the sites; `posterior`: its variances (n,), and a function
    that multiplies by C. With P = I - K C the means differ by P (K a - m - v a), and the cavities' variances should be
    s / (1 - t s). The larger of both mismatches counts.
    """
    variance, multiply_by_C = posterior
    tilted = cavities.mean + cavities.variance * weights
    gap = covariance @ weights - tilted
    mean_gap = jnp.abs(gap - covariance @ multiply_by_C(gap)) / jnp.sqrt(jnp.diagonal(covariance))
    log_ratio = jnp.abs(jnp.log(variance / ((1.0 - precision * variance) * cavities.variance)))
    return jnp.max(jnp.where(precision > 0, jnp.maximum(mean_gap, log_ratio), 0.0))


def _newton_step(
    sites: Sites, posterior: Joint, variance: Vector, mean_gap: Vector, variance_gap: Vector
) -> tuple[Vector, Vector]:
    """Newton step (dm, dv), (n,) each, that closes the gaps of means and cavity variances to first order.

    dm = W dv + (1 + v t) mean_gap,      J dv = variance_gap - Q (dt/dm (1 + v t) mean_gap).
    """
    follow, spread, matrix = coupling(sites, posterior, variance)
    free = (1.0 + variance * sites.precision) * mean_gap
    dv = solve(matrix, variance_gap - spread @ (sites.precision_m * free))
    return free + follow @ dv, dv
