"""Wild cluster bootstrap of one coefficient of a logit, for few clusters: its p-values and the interval they give.

A score cannot be resampled as residuals can, but it can be multiplied (Kline & Santos 2012). To test θ_j = b, the
others are estimated under it, with scores s_i and information H_i there. Clusters g keep or change the sign of their
scores, w_g = ±1, and the model linearised at that estimate is fitted to the sum:

    δ* = H⁻¹ Σ_g w_g s_g,   s*_g = w_g s_g - H_g δ*,   t* = δ*_j / se(s*),

se being the cluster-robust error of the linearised model, with the same small-sample factors as the estimate's own
(after MacKinnon, Nielsen & Webb 2024, arXiv:2406.00650). p is the share of |t*| that is not
below |θ̂_j - b|/se(θ̂_j), and the interval holds every b that is not rejected.

With 7 to 12 clusters all signs are used, so that there is no randomness; above, signs are drawn. Below, signs are too
few for a 5 % test and the six weights of Webb (2023) take their place, all of them for up to 5 clusters. With two ways
the clusters of the smaller way carry the weights and se is the two-way error (MacKinnon, Nielsen & Webb 2021); draws
whose two-way variance is not positive count as beyond |t|.
"""

import itertools

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq

from hilbo.statistics import ordered_logit
from hilbo.statistics.cluster_robust import Ways, factor
from hilbo.statistics.ordered_logit import Design

__all__ = ["Wild", "interval", "p_value", "wild", "wild_weights"]

_DRAWS = 999
_FEW = 7  # clusters: least for signs
_MOST = 8000  # weights that are all used
_SINGULAR = 1e-12
_FARTHEST = 30.0  # in standard errors: an interval that reaches it is reported as open


class Wild(eqx.Module):
    """What the bootstrap of one coefficient needs: the estimate, its clustered errors, and the clusters' weights."""

    model: Design
    estimate: Float[np.ndarray, " k"]
    errors: Float[np.ndarray, " k"]
    clusters: Ways
    weights: Float[np.ndarray, "b g"]
    complete: bool
    """Whether the weights are all there are, not a sample."""


def wild(
    model: Design, estimate: Float[np.ndarray, " k"], errors: Float[np.ndarray, " k"], clusters: Ways, seed: int = 0
) -> Wild:
    """Prepare the bootstrap of a logit fitted to `model`."""
    weights, complete = wild_weights(min(clusters.counts), seed)
    return Wild(model, estimate, errors, clusters, weights, complete)


def wild_weights(clusters: int, seed: int = 0) -> tuple[Float[np.ndarray, "b g"], bool]:
    """Weights of the clusters, one row per draw, and whether these are all. Rows that differ by their sign are one."""
    values = [-1.0, 1.0] if clusters >= _FEW else [s * np.sqrt(v) for s in (-1, 1) for v in (0.5, 1.0, 1.5)]
    if len(values) ** clusters > _MOST:
        return np.random.default_rng(seed).choice(values, (_DRAWS, clusters)), False
    positive = [value for value in values if value > 0]
    return np.array(list(itertools.product(positive, *[values] * (clusters - 1)))), True


def p_value(test: Wild, column: int, value: float) -> float:
    """p of the hypothesis that the coefficient has this value."""
    size = abs(test.estimate[column] - value) / test.errors[column]
    beyond = int(np.sum(_statistics(test, column, value) >= size * (1 - 1e-12)))
    return beyond / len(test.weights) if test.complete else (beyond + 1) / (len(test.weights) + 1)


def interval(test: Wild, column: int, level: float) -> tuple[float, float]:
    """The values of a coefficient that are not rejected at 1 - `level`; an end that is not found is infinite."""
    estimate, error = test.estimate[column], test.errors[column]
    allowed = (1 - level) * (len(test.weights) + (not test.complete)) * (1 + 1e-12)
    rank = int(allowed) - (not test.complete)  # draws that may lie beyond a rejected value
    if rank < 1:
        return -np.inf, np.inf

    def excess(value):
        """Above 0 where the value is rejected."""
        return abs(estimate - value) / error / np.sort(_statistics(test, column, value))[-rank - 1] - 1

    return _end(excess, estimate, -error), _end(excess, estimate, error)


def _end(excess, estimate, step):
    inside, reach = estimate, 2.0
    while excess(outside := estimate + reach * step) <= 0:
        inside, reach = outside, 1.5 * reach
        if reach > _FARTHEST:
            return float(np.copysign(np.inf, step))
    return float(brentq(excess, inside, outside, xtol=1e-6 * abs(step)))


def _statistics(test, column, value):
    """|t*| of every draw under the hypothesis; inf, which rejects nothing, where hardly any information is left."""
    others = np.arange(len(test.estimate)) != column
    theta = test.estimate.copy()
    theta[column] = value
    if others.any():
        theta[others] = ordered_logit.fit(test.model.fixed(column, value), test.estimate[others])
    scores = test.clusters.sums(ordered_logit.scores(test.model, theta))
    information = test.clusters.sums(ordered_logit.information(test.model, theta))
    if np.linalg.matrix_rank(information.sum(axis=0), rtol=_SINGULAR) < len(theta):
        return np.full(len(test.weights), np.inf)
    bread = np.linalg.inv(information.sum(axis=0))
    weighted = test.weights[:, test.clusters.of_cell[np.argmin(test.clusters.counts)]]  # (b, cells)
    delta = weighted @ scores @ bread
    projected = weighted * (scores @ bread[column])[None, :] - delta @ (information @ bread[column]).T
    variance = np.zeros(len(delta))
    for sign, cluster, count in test.clusters.terms():
        size = factor(count, len(test.clusters.cells), len(theta))
        one_each = count == len(cluster)
        total = projected if one_each else projected @ (cluster[:, None] == np.arange(count)[None, :])
        variance += sign * size * np.sum(total**2, axis=1)
    moved = np.abs(delta[:, column])
    positive = variance > 0
    return np.where(positive, moved / np.sqrt(np.where(positive, variance, 1.0)), np.inf)
