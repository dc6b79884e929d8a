"""Separation: which coefficients of a logit have no finite estimate, found by linear programming.

The log-likelihood of `hilbo.statistics.ordered_logit` never falls along a direction δ exactly if no upper edge falls
and no lower edge rises: U·δ >= 0 and L·δ <= 0 in every answer. If such a direction moves an edge, the answers are
separated (a cell of 0 or 100 %, or a combination of predictors that is), and the maximum lies at infinity (Albert &
Anderson 1984). Edges that move along some such direction are open in the limit; the others alone decide the
coefficients that no such direction touches, and the supremum of the likelihood is theirs. An answer without an edge
left is certain. Written here because statsmodels has nothing for it: it warns of perfect prediction and goes on.

Reference: Konis (2007), Computational algorithms for detecting separation (linear programming), D.Phil., Oxford.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import brentq, linprog

from hilbo.statistics import ordered_logit
from hilbo.statistics.ordered_logit import Design

__all__ = ["Separation", "decisive", "independent", "profile", "separation", "supremum"]

_TOLERANCE = 1e-7  # of a direction with entries up to 1; the solver's feasibility tolerance


class Separation(eqx.Module):
    """Coefficients without a finite estimate.

    `falls`, `rises`: whether a coefficient goes to -inf, to inf, along some direction that never lowers the likelihood
    (both: its sign is undetermined). `upper`, `lower`: edges that are infinite or go to infinity.
    """

    falls: Bool[np.ndarray, " k"]
    rises: Bool[np.ndarray, " k"]
    upper: Bool[np.ndarray, " n"]
    lower: Bool[np.ndarray, " n"]

    @property
    def infinite(self) -> Bool[np.ndarray, " k"]:
        """Mask of the coefficients without a finite estimate."""
        return self.falls | self.rises

    @property
    def certain(self) -> Bool[np.ndarray, " n"]:
        """Mask of the responses whose fitted probability goes to 1."""
        return self.upper & self.lower


def separation(model: Design) -> Separation:
    """Find every coefficient without a finite estimate, and the edges that go to infinity."""
    rows, k = _constraints(model), model.upper.shape[1]
    upper, lower = np.isinf(model.upper_offset), np.isinf(model.lower_offset)
    rises, falls = np.zeros(k, bool), np.zeros(k, bool)
    if k and len(rows):
        distinct, inverse = np.unique(rows, axis=0, return_inverse=True)
        moves = _largest_support(distinct)
        above, below = np.split(moves[inverse.ravel()], [np.sum(~upper)])
        upper[~upper], lower[~lower] = above, below
        if moves.any():
            rises = np.array([_largest_change(distinct, j, 1) > _TOLERANCE for j in range(k)])
            falls = np.array([_largest_change(distinct, j, -1) > _TOLERANCE for j in range(k)])
    return Separation(falls, rises, upper, lower)


def independent(model: Design) -> Bool[np.ndarray, " k"]:
    """Mask of the columns that are linearly independent of the selected ones before them, over the finite edges."""
    rows = _constraints(model)
    keep = np.zeros(model.upper.shape[1], bool)
    rank = 0
    for column in range(len(keep)):
        keep[column] = True
        rank_with = np.linalg.matrix_rank(rows[:, keep]) if len(rows) else 0
        keep[column], rank = rank_with > rank, rank_with
    return keep


def supremum(model: Design, start: Float[np.ndarray, " k"], separated: Separation) -> float:
    """Supremum of the log-likelihood, attained or not; 0 if all responses are certain."""
    if separated.certain.all():
        return 0.0
    rest, _, rest_start = decisive(model, start, separated)
    if not len(rest_start):
        return ordered_logit.log_likelihood(rest, rest_start)
    return ordered_logit.fit(rest, rest_start).log_likelihood


def decisive(
    model: Design, start: Float[np.ndarray, " k"], separated: Separation
) -> tuple[Design, Bool[np.ndarray, " k"], Float[np.ndarray, " j"]]:
    """Design of the responses that are not certain, in the coefficients that they determine; a mask of these among all
    (k,); and a start for them (j,).

    Edges that go to infinity are open. A coefficient that is left out is 0: the remaining edges depend on it only
    through the others.
    """
    rest = Design(
        np.where(separated.upper[:, None], 0.0, model.upper),
        np.where(separated.lower[:, None], 0.0, model.lower),
        np.where(separated.upper, np.inf, model.upper_offset),
        np.where(separated.lower, -np.inf, model.lower_offset),
    ).rows(~separated.certain)
    keep = independent(rest)
    rows = _constraints(rest)
    rest_start = np.linalg.lstsq(rows[:, keep], rows @ start, rcond=None)[0]  # the same edges as at `start`
    return rest.columns(keep), keep, rest_start


def profile(
    model: Design, column: int, start: Float[np.ndarray, " k"], separated: Separation, level: float
) -> tuple[float, float, float]:
    """Profile-likelihood interval of a coefficient that has no finite estimate, and the p-value of 0.

    {b: sup L at b >= sup L·(1 - level)/2}: (low, inf) if the coefficient rises, (-inf, high) if it falls, everything
    if both. Answers count as independent. The likelihood is, but for the other coefficients, the probability of
    answers as extreme as these, so that for a rate of 0 or 1 the interval and p are those of Clopper & Pearson; the
    quantile of χ² would leave out up to 15 % there.
    """
    if separated.falls[column] and separated.rises[column]:
        return -np.inf, np.inf, 1.0
    sign = 1.0 if separated.rises[column] else -1.0
    top = supremum(model, start, separated)
    others = np.arange(len(start)) != column
    separated_others = separation(model.fixed(column, 0.0))  # the same for every value

    def drop(size: float) -> float:
        return 2 * (top - supremum(model.fixed(column, sign * size), start[others], separated_others))

    quantile = -2 * np.log((1 - level) / 2)
    high = low = 1.0  # in `size`, along which the drop falls to 0
    while drop(high) > quantile:
        high *= 2
    while drop(low) < quantile:
        low = low - 2 * abs(low)
    end = brentq(lambda size: drop(size) - quantile, low, high, xtol=1e-12, rtol=1e-12)
    p_value = min(1.0, 2 * float(np.exp(-drop(0.0) / 2)))
    return (sign * end, np.inf, p_value) if sign > 0 else (-np.inf, sign * end, p_value)


def _constraints(model: Design) -> Float[np.ndarray, "r k"]:
    """Rows a with a·δ >= 0 for every direction δ that does not lower the likelihood: finite upper edges, then finite
    lower ones."""
    has_upper, has_lower = np.isfinite(model.upper_offset), np.isfinite(model.lower_offset)
    return np.vstack([model.upper[has_upper], -model.lower[has_lower]])


def _largest_support(rows: Float[np.ndarray, "r k"]) -> Bool[np.ndarray, " r"]:
    """Mask of the rows that some feasible direction moves: maximise Σ min(a·δ, 1)."""
    count, k = rows.shape
    cost = np.concatenate([np.zeros(k), -np.ones(count)])
    bounds = [(None, None)] * k + [(0, 1)] * count
    direction_and_moves = linprog(cost, A_ub=np.hstack([-rows, np.eye(count)]), b_ub=np.zeros(count), bounds=bounds).x
    return direction_and_moves[k:] > 0.5


def _largest_change(rows: Float[np.ndarray, "r k"], column: int, sign: int) -> float:
    """Largest change of a coefficient, in direction `sign`, along a feasible direction in the unit cube."""
    cost = np.zeros(rows.shape[1])
    cost[column] = -sign
    return -linprog(cost, A_ub=-rows, b_ub=np.zeros(len(rows)), bounds=(-1, 1)).fun
