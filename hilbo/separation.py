"""Separation: which coefficients of a logit have no finite estimate, found by linear programming.

The log-likelihood of `hilbo.ordered_logit` never falls along a direction δ exactly if no upper edge falls and no lower
edge rises: U·δ >= 0 and L·δ <= 0 in every answer. If such a direction moves an edge, the answers are separated (a cell
of 0 or 100 %, or a combination of predictors that is), and the maximum lies at infinity (Albert & Anderson 1984).
The answers whose edges move along some such direction then have probability 1 in the limit; the others alone decide
the coefficients that no such direction touches, and the supremum of the likelihood is theirs.

Reference: Konis (2007), Computational algorithms for detecting separation (linear programming), D.Phil., Oxford.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import brentq, linprog
from scipy.stats import chi2

from hilbo import ordered_logit
from hilbo.ordered_logit import Design

__all__ = ["Separation", "decisive", "independent", "profile", "separation", "supremum"]

_TOLERANCE = 1e-7  # of a direction with entries up to 1; the solver's feasibility tolerance


class Separation(eqx.Module):
    """What is not finite.

    `falls`, `rises`: whether a coefficient goes to -inf, to inf, along some direction that never lowers the likelihood
    (both: the answers say nothing of its sign). `certain`: answers whose probability goes to 1.
    """

    falls: Bool[np.ndarray, " k"]
    rises: Bool[np.ndarray, " k"]
    certain: Bool[np.ndarray, " n"]

    @property
    def infinite(self) -> Bool[np.ndarray, " k"]:
        """Coefficients without a finite estimate."""
        return self.falls | self.rises


def separation(model: Design) -> Separation:
    """Find every coefficient without a finite estimate, and the answers that decide nothing else."""
    rows, owner = _constraints(model)
    k = model.upper.shape[1]
    if not len(rows):
        return Separation(np.zeros(k, bool), np.zeros(k, bool), np.zeros(len(model.upper), bool))
    distinct, inverse = np.unique(rows, axis=0, return_inverse=True)
    moves = _largest_support(distinct)
    certain = np.zeros(len(model.upper), bool)
    np.logical_or.at(certain, owner, moves[inverse.ravel()])
    if not moves.any():
        return Separation(np.zeros(k, bool), np.zeros(k, bool), certain)
    rises = np.array([_reach(distinct, j, 1) > _TOLERANCE for j in range(k)])
    falls = np.array([_reach(distinct, j, -1) > _TOLERANCE for j in range(k)])
    return Separation(falls, rises, certain)


def independent(model: Design) -> Bool[np.ndarray, " k"]:
    """Columns that are no combination of those before them, of the edges that are not open."""
    rows, _ = _constraints(model)
    keep = np.zeros(model.upper.shape[1], bool)
    rank = 0
    for column in range(len(keep)):
        keep[column] = True
        found = np.linalg.matrix_rank(rows[:, keep]) if len(rows) else 0
        keep[column], rank = found > rank, found
    return keep


def supremum(model: Design, start: Float[np.ndarray, " k"], certain: Bool[np.ndarray, " n"] | None = None) -> float:
    """The supremum of the log-likelihood, reached or not; `certain` as `separation` finds it, if that is known."""
    certain = separation(model).certain if certain is None else certain
    if certain.all():
        return 0.0
    rest, _, begin = decisive(model, start, certain)
    theta = ordered_logit.fit(rest, begin) if len(begin) else begin
    return ordered_logit.log_likelihood(rest, theta)


def decisive(
    model: Design, start: Float[np.ndarray, " k"], certain: Bool[np.ndarray, " n"]
) -> tuple[Design, Bool[np.ndarray, " k"], Float[np.ndarray, " j"]]:
    """The answers that are not certain, with as many coefficients as they decide, which these are, and a start.

    A coefficient that is left out is 0 there: the answers that are left depend on it through the others only.
    """
    rest = model.rows(~certain)
    keep = independent(rest)
    rows, _ = _constraints(rest)
    begin = np.linalg.lstsq(rows[:, keep], rows @ start, rcond=None)[0]  # the same edges as at `start`
    return rest.columns(keep), keep, begin


def profile(
    model: Design, column: int, start: Float[np.ndarray, " k"], found: Separation, level: float
) -> tuple[float, float, float]:
    """Profile-likelihood interval of a coefficient that has no finite estimate, and the p-value of 0.

    {b: 2·(sup log L - sup log L at b) <= χ²_1(level)}: (low, inf) if the coefficient rises, (-inf, high)
    if it falls, everything if both. Answers count as independent.
    """
    if found.falls[column] and found.rises[column]:
        return -np.inf, np.inf, 1.0
    sign = 1.0 if found.rises[column] else -1.0
    top = supremum(model, start, found.certain)
    others = np.arange(len(start)) != column
    certain = separation(model.fixed(column, 0.0)).certain  # the same for every value

    def drop(size):
        return 2 * (top - supremum(model.fixed(column, sign * size), start[others], certain))

    quantile = float(chi2.ppf(level, 1))
    high = low = 1.0  # in `size`, along which the drop falls to 0
    while drop(high) > quantile:
        high *= 2
    while drop(low) < quantile:
        low = low - 2 * abs(low)
    end = brentq(lambda size: drop(size) - quantile, low, high, xtol=1e-12, rtol=1e-12)
    p_value = float(chi2.sf(max(drop(0.0), 0.0), 1))
    return (sign * end, np.inf, p_value) if sign > 0 else (-np.inf, sign * end, p_value)


def _constraints(model):
    """Rows a with a·δ >= 0 for every direction along which nothing is lost, and the answer that each belongs to."""
    has_upper, has_lower = np.isfinite(model.upper_offset), np.isfinite(model.lower_offset)
    rows = np.vstack([model.upper[has_upper], -model.lower[has_lower]])
    return rows, np.concatenate([np.flatnonzero(has_upper), np.flatnonzero(has_lower)])


def _largest_support(rows):
    """Which rows some feasible direction moves: maximise Σ min(a·δ, 1); sums of directions are directions."""
    count, k = rows.shape
    cost = np.concatenate([np.zeros(k), -np.ones(count)])
    bounds = [(None, None)] * k + [(0, 1)] * count
    found = linprog(cost, A_ub=np.hstack([-rows, np.eye(count)]), b_ub=np.zeros(count), bounds=bounds)
    return found.x[k:] > 0.5


def _reach(rows, column, sign):
    """How far a direction in the unit cube that loses nothing can move a coefficient."""
    cost = np.zeros(rows.shape[1])
    cost[column] = -sign
    return -linprog(cost, A_ub=-rows, b_ub=np.zeros(len(rows)), bounds=(-1, 1)).fun
