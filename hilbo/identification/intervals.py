"""Uncertainty of the fitted parameters: profile-likelihood intervals and a block bootstrap over repeats.

With the spectrum of each curve's residuals (`hilbo.identification.residual_noise`) the variance of an estimate is the
sandwich

    V = A⁻¹ (Σ_c J_cᵀ Γ_c J_c) A⁻¹,   A = JᵀJ,

and the profile of coordinate j is cut where the cost has risen by t²·V_jj / (A⁻¹)_jj, which is the classical cut where
residuals are white. Without this correction the intervals from autocorrelated samples would be far too narrow.
Variation between repeats that is constant within each, such as the rounding of a constant position by an encoder, moves
the estimate without leaving a residual. With 5 repeats or more V is therefore scaled until each V_jj is no less than
the variance from the influences u_ck of the repeats on the estimate, Σ_c var_k(u_ck)/R_c. The bootstrap resamples whole
repeats and includes this variation.

References: Bates & Watts (1988), Nonlinear Regression Analysis, chapter 6 (profiles); Rotnitzky & Jewell (1990),
Biometrika 77:485 (scaled likelihood ratios under correlation); Efron & Tibshirani (1993), An Introduction to the
Bootstrap, section 12.5 (studentised intervals).
"""

from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from hilbo.errors import InputError
from hilbo.identification.fitting import Fit, curve_residuals
from hilbo.identification.residual_noise import fitted_residuals, noises, weighted_normal
from hilbo.identification.rounding import variance_of_rounding
from hilbo.numerics.least_squares import Solution, solve_symmetric
from hilbo.numerics.tracing import program

__all__ = [
    "FEWEST_REPEATS",
    "Intervals",
    "Spread",
    "block_bootstrap",
    "inverse_of_free",
    "profile_intervals",
    "refits",
    "spread",
]

FEWEST_REPEATS = 5  # of a test, below which resampling them is not informative
_CLOSE = 1e-3  # of the half-width, to which an end of an interval is found
_FARTHEST = 4.0  # growth of a step away from the estimate
_LEAST_GROWTH = 0.05  # least growth per step taken: profiles may be flat beyond some distance
_SEARCH_STEPS = 25
_ENOUGH = 1e-8  # of the cost: cuts are 1e-4 of it and more


class Spread(eqx.Module):
    """Sampling variance of the estimates.

    `covariance`: sandwich covariance; `inverse`: A⁻¹, row by row; `cut`: rise of the cost at which each profile is cut;
    `freedom`: degrees of freedom.
    """

    covariance: Float[Array, "p p"]
    inverse: Float[Array, "p p"]  # row j: A⁻¹ e_j over the coordinates that are free when j is
    cut: Float[Array, " p"]
    freedom: Float[Array, ""]


class Intervals(eqx.Module):
    """Profile interval of each coordinate.

    `open_*`: the data determine no end on that side, because the search reached the coordinate's bound, or a point
    where another coordinate is at its bound (except physical limits, `Model.physical`), so the end depends on the
    bounds. `bracketed` is False where the search failed; `lowest` is the lowest cost met, at `lowest_q`: if it is below
    the cost of the fit, the fit was not the global minimum.
    """

    lower: Float[Array, " p"]
    upper: Float[Array, " p"]
    open_lower: Bool[Array, " p"]
    open_upper: Bool[Array, " p"]
    bracketed: Bool[Array, " p"]
    lowest: Float[Array, ""]
    lowest_q: Float[Array, " p"]


@program
def spread(fit: Fit, quantile: float = 1.959964) -> Spread:
    """Sandwich covariance and profile cuts; coordinates at a bound stay fixed, except the one being profiled.

    `quantile`: standard normal quantile of the confidence level; the default is 95 %. Compiled.
    """
    q = fit.q
    slopes = jax.jacfwd(lambda x: fitted_residuals(fit, x))(q)
    meat, effective = jnp.zeros_like(fit.solution.normal), jnp.zeros_like(q[0])
    unscaled = _inverse(fit.solution.normal, _free(fit))
    curves = tuple(curve.fitted for curve in fit.curves)
    for curve, w, J in zip(curves, fit.weights, slopes, strict=True):
        meat = meat + variance_of_rounding(fit.model, q, curve, w, J)
    for r, J, model in zip(fitted_residuals(fit, q), slopes, noises(fit), strict=True):
        shape = weighted_normal(J, model)  # Jᵀ Γ J / γ_0
        # The observed variance already contains the walk.
        without_walk = eqx.tree_at(lambda n: n.walk, model, jnp.zeros_like(model.walk))
        parameters_used = jnp.sum(unscaled * weighted_normal(J, without_walk))
        variance = r @ r / (r.size - parameters_used)
        meat, effective = meat + variance * shape, effective + model.effective
    rows = jax.vmap(lambda own: _inverse(fit.solution.normal, _free(fit) | own))(jnp.eye(q.size, dtype=bool))
    inverse = jnp.diagonal(rows, axis1=0, axis2=1).T
    covariance = inverse @ meat @ inverse.T
    freedom = jnp.maximum(effective - q.size, 1)
    inflation, freedoms = _between_repeats(fit, slopes, jnp.diag(covariance), freedom)
    covariance = inflation[:, None] * covariance * inflation[None, :]
    cut = _student(quantile, freedoms) ** 2 * jnp.diag(covariance) / jnp.diag(inverse)
    return Spread(covariance, inverse, cut, freedom)


def _between_repeats(
    fit: Fit, slopes: tuple[Float[Array, "_ p"], ...], variance: Float[Array, " p"], freedom: Float[Array, ""]
) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
    """Inflation of the standard errors by scatter between repeats (at least 1), and degrees of freedom. (p,) each.

    `slopes`: Jacobian (m, p) of each curve's residuals; `variance` (p,) without the scatter; `freedom` without it. No
    inflation if a test has fewer than 5 repeats.
    """
    if min(w.size for w in fit.weights) < FEWEST_REPEATS:
        return jnp.ones_like(variance), jnp.broadcast_to(freedom, variance.shape)
    ratio = sum(_variance_of_mean(u, 0) for u in _influences(fit, slopes)) / variance
    between_freedom = float(sum(w.size - 1 for w in fit.weights))
    return jnp.sqrt(jnp.maximum(ratio, 1)), jnp.where(ratio > 1, between_freedom, freedom)


def profile_intervals(fitted: Fit, quantile: float = 1.959964) -> Intervals:
    """Profile-likelihood interval of each coordinate at the level of a normal `quantile` (default 95 %)."""
    return _profile(fitted, spread(fitted, quantile))


class _Search(NamedTuple):
    """State of the search for one end of one interval; positions are distances from the estimate."""

    distance: Array
    inside: Array  # largest distance inside the interval, with √(rise/cut) there
    inside_root: Array
    outside: Array
    outside_root: Array
    q: Array
    lowest: Array
    lowest_q: Array
    steps: Array
    done: Array
    open: Array


@program
def _profile(fit: Fit, sampling: Spread) -> Intervals:
    """Search both ends of the interval of every coordinate, one after the other; compiled."""
    size = fit.q.size
    which, side = jnp.repeat(jnp.arange(size), 2), jnp.tile(jnp.array([-1.0, 1.0], fit.q.dtype), size)
    # One after the other: together, all would wait for the slowest.
    ends = jax.lax.map(lambda j_and_sign: _end(fit, sampling, *j_and_sign), (which, side))
    distance, open_, done = (leaf.reshape(size, 2) for leaf in (ends.distance, ends.open, ends.done))
    both_bracketed = jnp.all(done & jnp.isfinite(distance), axis=1)
    lower, upper = fit.q - distance[:, 0], fit.q + distance[:, 1]
    best = jnp.argmin(ends.lowest)
    return Intervals(lower, upper, open_[:, 0], open_[:, 1], both_bracketed, ends.lowest[best], ends.lowest_q[best])


def _end(fit: Fit, sampling: Spread, j: Int[Array, ""], sign: Float[Array, ""]) -> _Search:
    """Search the end of the profile interval of coordinate `j` on one side, `sign` -1 or 1; returns the final state.

    Its `distance` is that of the end from the estimate; `open` if it depends on a bound; not `done` if the search
    failed.
    """
    q, cut, row = fit.q, sampling.cut[j], sampling.inverse[j]
    room = jnp.where(sign > 0, fit.upper[j] - q[j], q[j] - fit.lower[j])
    is_j = jnp.arange(q.size) == j
    below, above = (jnp.asarray(nature) | is_j for nature in fit.model.physical())

    def refit_others(distance, start):
        value = q[j] + sign * distance
        box = jnp.where(is_j, value, fit.lower), jnp.where(is_j, value, fit.upper)
        return fit.minimum(start, box, max_steps=40, enough=_ENOUGH)

    def step(state: _Search) -> _Search:
        distance = jnp.minimum(state.distance, room)
        start = jnp.where(is_j, q + sign * distance, state.q)  # near the best point inside the interval
        solution = refit_others(distance, start)
        rise = solution.cost - fit.solution.cost
        at_lower, at_upper = fit.bounded(solution.q)
        at_other_bound = jnp.any((at_lower & ~below) | (at_upper & ~above))
        now = _narrowed(state, distance, jnp.sqrt(jnp.maximum(rise, 0) / cut), solution, q, distance >= room)
        return now._replace(open=now.open | (now.done & at_other_bound))

    zero, infinite = jnp.zeros_like(cut), jnp.full_like(cut, jnp.inf)
    guess = jnp.sqrt(cut * row[j])
    start = jnp.where(is_j, q, q + sign * guess * row / row[j])
    bad = ~jnp.isfinite(guess)
    first = _Search(guess, zero, zero, infinite, infinite, start, infinite, q, jnp.asarray(0), bad, jnp.zeros_like(bad))
    return jax.lax.while_loop(lambda s: ~s.done & (s.steps < _SEARCH_STEPS), step, first)


def _narrowed(
    state: _Search,
    distance: Float[Array, ""],
    root: Float[Array, ""],
    solution: Solution,
    q: Float[Array, " p"],
    at_bound: Bool[Array, ""],
) -> _Search:
    """Next search state after an evaluation at `distance` from the estimate `q`.

    `root` = √(rise of the cost / cut), 1 at the end sought; `solution`: the fit of the other coordinates; `at_bound`:
    `distance` is that of the coordinate's bound.
    """
    outside = root > 1
    inner, inner_root = _pick(outside, (state.inside, state.inside_root), (distance, root))
    outer, outer_root = _pick(outside, (distance, root), (state.outside, state.outside_root))
    chord = inner + (outer - inner) * (1 - inner_root) / (outer_root - inner_root)
    growth = jnp.maximum(1 / jnp.maximum(root, 1 / _FARTHEST), 1 + _LEAST_GROWTH * state.steps.astype(q.dtype))
    next_out = distance * growth
    unbounded = ~outside & at_bound
    converged = (jnp.abs(root - 1) < _CLOSE) | (outer - inner <= _CLOSE * inner)
    done = unbounded | converged
    next_distance = jnp.where(done, distance, jnp.where(jnp.isfinite(outer), chord, next_out))
    lower = solution.cost < state.lowest  # false for NaN
    lowest, lowest_q = _pick(lower, (solution.cost, solution.q), (state.lowest, state.lowest_q))
    steps = state.steps + 1
    next_start = jnp.where(outside, jnp.where(state.steps == 0, q, state.q), solution.q)
    return _Search(
        next_distance, inner, inner_root, outer, outer_root, next_start, lowest, lowest_q, steps, done, unbounded
    )


def _pick(condition: Bool[Array, ""], yes: tuple[Array, ...], no: tuple[Array, ...]) -> Iterator[Array]:
    """Iterate over the elements of `yes` if the condition is true, else of `no`."""
    return (jnp.where(condition, a, b) for a, b in zip(yes, no, strict=True))


@program
def refits(fitted: Fit, weights: tuple[Float[Array, "B R"], ...]) -> Float[Array, "B p"]:
    """Refit the coordinates for other weights of the repeats, starting from the fit.

    `weights`: (B, R) for each curve -> (B, p).
    """
    return jax.lax.map(lambda row: fitted.minimum(fitted.q, weights=row, max_steps=40).q, weights)


def block_bootstrap(
    fitted: Fit, key: PRNGKeyArray, resamples: int = 2000, quantile: float = 1.959964, *, exact: bool = False
) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
    """Studentised bootstrap interval of each coordinate; whole repeats of every test are resampled.

    To first order, an estimate moves by the mean of its repeats' influences A⁻¹ J_cᵀ r_ck; `exact` refits every
    resample instead. `quantile`: standard normal quantile of the confidence level. Returns the lower and upper ends,
    (p,) each. Raises `InputError` for a test with fewer than 5 repeats.
    """
    fewest = min(w.size for w in fitted.weights)
    if fewest < FEWEST_REPEATS:
        raise InputError(f"A test has {fewest} repeats; the bootstrap over repeats needs at least {FEWEST_REPEATS}.")
    return _bootstrap(fitted, key, resamples, quantile, exact)


@program
def _bootstrap(
    fit: Fit, key: PRNGKeyArray, resamples: int, quantile: float, exact: bool
) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
    """Compute `block_bootstrap` in one compiled function; the number of repeats is not checked."""
    keys = jax.random.split(key, len(fit.weights))
    draws = tuple(jax.random.randint(k, (resamples, w.size), 0, w.size) for k, w in zip(keys, fit.weights, strict=True))
    influences = _influences(fit, jax.jacfwd(lambda x: fitted_residuals(fit, x))(fit.q))
    moved = sum(jnp.mean(u[d], axis=1) - jnp.mean(u, axis=0)[None, :] for u, d in zip(influences, draws, strict=True))
    errors = jnp.sqrt(sum(_variance_of_mean(u[d], 1) for u, d in zip(influences, draws, strict=True)))
    standard_error = jnp.sqrt(sum(_variance_of_mean(u, 0) for u in influences))
    if exact:
        weights = tuple(
            jax.vmap(lambda row, n=w.size: jnp.bincount(row, length=n) / n)(d)
            for w, d in zip(fit.weights, draws, strict=True)
        )
        moved = refits(fit, weights) - fit.q[None, :]
    tail = jax.scipy.special.ndtr(-quantile)
    low, high = jnp.quantile(moved / errors, jnp.stack([tail, 1 - tail]), axis=0)
    return fit.q - high * standard_error, fit.q - low * standard_error


def _variance_of_mean(values: Float[Array, "*m p"], axis: int) -> Float[Array, "..."]:
    """Variance of the mean of the repeats, which are along `axis`: their sample variance / their number."""
    return jnp.var(values, axis=axis, ddof=1) / values.shape[axis]


def _influences(fit: Fit, slopes: tuple[Float[Array, "_ p"], ...]) -> tuple[Float[Array, "_ p"], ...]:
    """Influence of each repeat on the estimate, to first order; one (R, p) array per curve.

    `slopes`: Jacobian (m, p) of each curve's residuals.
    """
    inverse = _inverse(fit.solution.normal, _free(fit))
    pulls = []
    for curve, J in zip(fit.curves, slopes, strict=True):
        count = curve.output.shape[0]
        alone = jax.vmap(lambda w, c=curve: curve_residuals(fit.model, c, w, fit.q))(jnp.eye(count, dtype=J.dtype))
        pulls.append(-alone @ J @ inverse)
    return tuple(pulls)


def inverse_of_free(fit: Fit) -> Float[Array, "p p"]:
    """A⁻¹ over the coordinates that are not at a bound, 0 elsewhere. (p, p)."""
    return _inverse(fit.solution.normal, _free(fit))


def _free(fit: Fit) -> Bool[Array, " p"]:
    """Mask (p,) of the coordinates that are not at a bound."""
    return ~fit.held()


def _inverse(normal: Float[Array, "p p"], free: Bool[Array, " p"]) -> Float[Array, "p p"]:
    """Inverse (p, p) of the normal matrix over the free coordinates, 0 elsewhere."""
    both = free[:, None] & free[None, :]
    scale = jnp.sqrt(jnp.where(free, jnp.diag(normal), 1))
    outer = scale[:, None] * scale[None, :]
    matrix = jnp.where(both, normal / outer, jnp.eye(free.size, dtype=normal.dtype))
    columns = jax.vmap(solve_symmetric, (None, 0))(matrix, jnp.eye(free.size, dtype=normal.dtype))
    return jnp.where(both, columns / outer, 0)


def _student(quantile: float, freedom: Float[Array, "*p"]) -> Float[Array, "*p"]:
    """Student's t quantile at the level of the normal `quantile`, by Cornish-Fisher expansion.

    For 5 or more degrees of freedom (`freedom`).
    """
    z, f = quantile, freedom
    return z + (z**3 + z) / (4 * f) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * f**2)
