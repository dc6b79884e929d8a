"""The search for the fixed point of expectation propagation: damped updates far from it, Newton's steps near it.

Notation and equations are those of `hilbo.inference.ep`. `find` returns the cavities, undifferentiated.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from hilbo.gaussian import square_root
from hilbo.inference.ep_sites import Joint, Sites, Tilted, coupling, joint_of, sites_of, solve
from hilbo.laplace import plain_mode
from hilbo.numerics.linalg import one_at_a_time

__all__ = [
    "Cavities",
    "Found",
    "Joint",
    "Sites",
    "Tilted",
    "coupling",
    "find",
    "joint_of",
    "residual_of",
    "sites_of",
    "solve",
]

_QUICK_STEPS = 20
_BASIN = 3.0  # a mismatch, in posterior sds, below which Newton's step is tried


class Cavities(NamedTuple):
    """Means and variances; a start that is none has a variance that is no positive number."""

    mean: Float[Array, " n"]
    variance: Float[Array, " n"]

    @property
    def known(self) -> Bool[Array, ""]:
        """Whether it is a start."""
        return jnp.all((self.variance > 0) & jnp.isfinite(self.variance) & jnp.isfinite(self.mean))


class Found(NamedTuple):
    """How the search ended; `changed` is what the square root dropped, 0 where none was needed."""

    residual: Float[Array, ""]
    """Infinite where a hasty search ended by a step that should leave none; then `residual_of` is to measure it."""
    tolerance: Float[Array, ""]
    iterations: Int[Array, ""]
    changed: Float[Array, ""]


class _State(eqx.Module):
    mean: Float[Array, " n"]  # of the cavities, as is the variance
    variance: Float[Array, " n"]
    residual: Float[Array, ""]
    tolerance: Float[Array, ""]
    mismatch: Float[Array, ""]  # before a Newton step, infinite before an update
    ahead: Float[Array, ""]  # what the step should leave of it
    basin: Float[Array, ""]
    updates: Int[Array, ""]
    steps: Int[Array, ""]


def find(
    terms: Tilted,
    covariance: Float[Array, "n n"],
    start: Float[Array, " n"] | Cavities | None,
    max_steps: int,
    hasty: bool | Bool[Array, ""] = False,
) -> tuple[Float[Array, " n"], Float[Array, " n"], Found]:
    """Cavity means and variances, and how they were found. `start`: weights, or cavities, or nothing.

    A `hasty` search spares the sweep that would only see that the last step of Newton's was the last.

    Under `vmap` one problem after the other on CPUs, each stopping when it is done; elsewhere all at once with a root.
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
        initial, spent = _initial_without_root(terms, covariance, start)
        mean, variance, end = _search(terms, covariance, None, initial, min(max_steps, _QUICK_STEPS), none, hasty)
        fixed_point = mean, variance, end._replace(iterations=end.iterations + spent)
        met = (end.residual <= end.tolerance) | (hasty & jnp.isinf(end.residual))
        _, _, precision = terms(mean, variance)
        # s = K - KCK errs by eps K, and the cavity's variance by this share:
        blur = jnp.finfo(none.dtype).eps * jnp.max(jnp.diagonal(covariance) * precision * (1.0 + precision * variance))

        def restart(root):
            prior = _initial(terms, covariance, root, None)
            return jax.tree.map(lambda a, b: jnp.where(met, a, b), (mean, variance), prior)

        def continued():
            mean, variance, last = with_root(terms, covariance, restart)
            spent_before = jnp.where(met, fixed_point[2].iterations, 0)
            return mean, variance, last._replace(iterations=last.iterations + spent_before)

        return jax.lax.cond(met & (blur <= 0.1 * end.tolerance), lambda: fixed_point, continued)

    return one_at_a_time(quick, safe)(arrays, covariance, start, jnp.asarray(hasty))


class _PointTerms(eqx.Module):
    """The terms at single values, which are cavities of no width: Laplace's terms."""

    terms: Tilted

    def __call__(self, eta: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, " n"], Float[Array, " n"]]:
        return self.terms(eta, jnp.zeros_like(eta))


def _search(
    terms: Tilted,
    covariance: Float[Array, "n n"],
    root: Float[Array, "n n"] | None,
    initial: tuple[Float[Array, " n"], Float[Array, " n"]],
    max_steps: int,
    changed: Float[Array, ""],
    hasty: Bool[Array, ""],
) -> tuple[Float[Array, " n"], Float[Array, " n"], Found]:
    """From `initial` means and variances to the fixed point; `changed` goes into the record of the search."""
    largest = jnp.asarray(jnp.inf, covariance.dtype)
    count = jnp.zeros((), jnp.int32)
    basin = jnp.full_like(largest, _BASIN)
    mean, variance = initial
    first = _State(mean, variance, largest, jnp.zeros_like(largest), largest, largest, basin, count, count)

    def unmeasured(search):
        return hasty & (search.ahead <= 0.1 * search.tolerance)

    def unfinished(search):
        # One step at least: Laplace's mode may be the fixed point, but only to the digits of its own variances.
        done = (search.residual <= search.tolerance) & ((search.steps > 1) | (search.residual == 0.0))
        return (search.steps < max_steps) & ~done & ~unmeasured(search) & ~jnp.isnan(search.mismatch)

    end = jax.lax.while_loop(unfinished, lambda search: _advance(terms, covariance, root, search), first)
    residual = jnp.where(unmeasured(end) & (end.residual > end.tolerance), jnp.inf, end.residual)
    return end.mean, end.variance, Found(residual, end.tolerance, end.steps, changed)


def _initial_without_root(
    terms: Tilted, covariance: Float[Array, "n n"], start: Float[Array, " n"] | Cavities | None
) -> tuple[tuple[Float[Array, " n"], Float[Array, " n"]], Int[Array, ""]]:
    """Where the search without a root begins, at Laplace's mode if nothing is known, and the steps that took."""

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
    terms: Tilted,
    covariance: Float[Array, "n n"],
    root: Float[Array, "n n"] | None,
    start: Float[Array, " n"] | Cavities | None,
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """The prior's cavities; or those around the mean K start, with the sites' precisions at that mean."""
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


def _advance(
    terms: Tilted, covariance: Float[Array, "n n"], root: Float[Array, "n n"] | None, search: _State
) -> _State:
    """Evaluate the mismatch of the cavities and move them, by Newton's step or a damped update."""
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
    """Means of the tilted distributions, a + t of these, and the means that the joint posterior has instead."""

    tilted: Float[Array, " n"]
    natural: Float[Array, " n"]
    matched: Float[Array, " n"]


def _mismatch(
    covariance: Float[Array, "n n"],
    root: Float[Array, "n n"] | None,
    search: _State,
    sites: Sites,
    posterior: Joint,
    means: _Means,
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Residual and tolerance of the worse of mean and variance, and the mismatch in posterior sds that steers."""
    tilted, natural, matched = means
    epsilon = jnp.finfo(tilted.dtype).eps
    apart = jnp.where(sites.precision > 0, jnp.abs(matched - tilted), 0.0)
    ratio = posterior.variance / (posterior.left * search.variance)
    stretched = jnp.where(sites.precision > 0, jnp.abs(jnp.log(ratio)), 0.0)
    prior = jnp.diagonal(covariance)
    residuals = jnp.stack([jnp.max(apart / jnp.sqrt(prior)), jnp.max(stretched)])
    tolerances = jnp.full((2,), epsilon ** (2 / 3), tilted.dtype)
    if root is not None:  # the last resort ends at its rounding
        summed = jnp.abs(root).T @ (jnp.abs(natural) + sites.precision * jnp.abs(matched))
        rounding = jnp.stack([jnp.linalg.norm(summed), jnp.max(1.0 + sites.precision * search.variance)])
        tolerances = jnp.clip(4.0 * epsilon * rounding, epsilon ** (2 / 3), epsilon**0.25)
    worse = jnp.argmax(residuals / tolerances)
    mismatch = jnp.maximum(jnp.max(apart / jnp.sqrt(posterior.variance)), residuals[1])
    return residuals[worse], tolerances[worse], mismatch


def residual_of(
    covariance: Float[Array, "n n"],
    cavities: Cavities,
    weights: Float[Array, " n"],
    precision: Float[Array, " n"],
    posterior: tuple[Float[Array, " n"], Callable[[Float[Array, " n"]], Float[Array, " n"]]],
) -> Float[Array, ""]:
    """What the search would see at these cavities; `posterior`: its variances, and what multiplies by C.

    With P = I - K C the means differ by P (K a - m - v a), and the cavities' variances should be s / (1 - t s).
    """
    variance, explain = posterior
    tilted = cavities.mean + cavities.variance * weights
    gap = covariance @ weights - tilted
    apart = jnp.abs(gap - covariance @ explain(gap)) / jnp.sqrt(jnp.diagonal(covariance))
    stretched = jnp.abs(jnp.log(variance / ((1.0 - precision * variance) * cavities.variance)))
    return jnp.max(jnp.where(precision > 0, jnp.maximum(apart, stretched), 0.0))


def _newton_step(
    sites: Sites,
    posterior: Joint,
    variance: Float[Array, " n"],
    apart: Float[Array, " n"],
    wider: Float[Array, " n"],
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Changes of m and v that close the gaps `apart` of the means and `wider` of the cavity variances, to first order.

    dm = W dv + (1 + v t) apart,      J dv = wider - Q (dt/dm (1 + v t) apart).
    """
    follow, spread, matrix = coupling(sites, posterior, variance)
    free = (1.0 + variance * sites.precision) * apart
    dv = solve(matrix, wider - spread @ (sites.precision_m * free))
    return free + follow @ dv, dv
