"""Baselines for a population map: predictions of responses that do not use a Gaussian process.

- `constant`: the same class probabilities everywhere, (count + 1/2) / (n + C/2) of the others' responses;
- `quadratic`: an ordinal probit, quadratic in the parameters, one for all participants; its slopes have a prior N(0,
  3^2) in units of the noise and of the parameters' standard deviations, so that it exists for separated responses.

Like the map, both know a participant's earlier responses: each participant has a random intercept, whose standard
deviation is the most probable of a few for the observed participants, and whose posterior follows the responses in
turn. The latent values and thresholds are multiplied by sqrt(1 + sd^2), so that the probabilities before the first
response do not change.
"""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import log_ndtr, logsumexp, ndtri

__all__ = ["constant", "quadratic"]

_SLOPE_SD, _GAP_SD = 3.0, 1.5
_INTERCEPT_SDS = (0.0, 0.25, 0.5, 1.0, 2.0)  # in units of the noise
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(21)


def constant(
    q: Int[np.ndarray, " n"],
    categories: int,
    observed: Bool[np.ndarray, " n"],
    person: Int[np.ndarray, " n"] | None = None,
) -> Float[np.ndarray, "n C"]:
    """Class probabilities (n, C) from the categories `q` (n,) of the rows that are `observed` (n,), each category
    counted half a time more.

    `person` (n,): whose row it is, a person's rows in the order of presentation; None: without intercepts, equal in all
    rows.
    """
    counts = np.bincount(q[observed], minlength=categories) + 0.5
    chances = counts / counts.sum()
    if person is None:
        return np.tile(chances, (len(q), 1))
    edges = np.concatenate([[-np.inf], ndtri(np.cumsum(chances)[:-1]), [np.inf]])
    return _in_turn(np.zeros(len(q)), edges, q, observed, person)


def quadratic(
    x: Float[np.ndarray, "n d"],
    q: Int[np.ndarray, " n"],
    categories: int,
    observed: Bool[np.ndarray, " n"],
    person: Int[np.ndarray, " n"] | None = None,
) -> Float[np.ndarray, "n C"]:
    """Class probabilities (n, C) at points `x` (n, d), fitted to the responses `q` of the rows that are `observed`
    (n,). `person` as for `constant`.

    The end of the optimiser is taken, converged or not.
    """
    from scipy.optimize import minimize

    spread = x[observed].std(axis=0)
    z = (x - x[observed].mean(axis=0)) / np.where(spread > 0, spread, 1.0)  # a constant parameter is 0
    first, second = np.triu_indices(x.shape[1])
    features = np.concatenate([z, z[:, first] * z[:, second]], axis=1)
    count = features.shape[1]
    edges = ndtri(np.cumsum(constant(q, categories, observed)[0])[:-1])
    start = np.concatenate([np.zeros(count), edges[:1], np.log(np.diff(edges))])
    scale = np.concatenate([np.full(count, _SLOPE_SD), [np.inf], np.full(categories - 2, _GAP_SD)])

    def cost(w: Float[np.ndarray, " p"]) -> tuple[float, Float[np.ndarray, " p"]]:
        logs, by_low, by_high = _log_masses(features[observed] @ w[:count], _edges(w[count:]), q[observed])
        by_edge = np.zeros(categories + 1)
        np.add.at(by_edge, q[observed], by_low)
        np.add.at(by_edge, q[observed] + 1, by_high)
        by_edge = by_edge[1:-1]
        later = np.cumsum(by_edge[::-1])[::-1]  # a gap moves all thresholds above it
        of_edges = np.concatenate([later[:1], np.exp(w[count + 1 :]) * later[1:]])
        slope = np.concatenate([-(by_low + by_high) @ features[observed], of_edges])
        away = (w - start) / scale
        return 0.5 * away @ away - logs.sum(), away / scale - slope

    w = minimize(cost, start, jac=True, method="L-BFGS-B").x
    level, edges = features @ w[:count], _edges(w[count:])
    return np.exp(_log_chances(level, edges)) if person is None else _in_turn(level, edges, q, observed, person)


def _log_chances(level: Float[np.ndarray, " n"], edges: Float[np.ndarray, " bounds"]) -> Float[np.ndarray, "n C"]:
    """Log class probabilities (n, C) at latent values `level` (n,)."""
    every = range(len(edges) - 1)
    return np.stack([_log_masses(level, edges, np.full(len(level), c))[0] for c in every], axis=1)


def _in_turn(
    level: Float[np.ndarray, " n"],
    edges: Float[np.ndarray, " bounds"],
    q: Int[np.ndarray, " n"],
    observed: Bool[np.ndarray, " n"],
    person: Int[np.ndarray, " n"],
) -> Float[np.ndarray, "n C"]:
    """Class probabilities (n, C) with a random intercept of each participant, each row from that participant's rows
    before it. `level`, `edges`: without intercepts."""
    rows = [np.flatnonzero(person == each) for each in np.unique(person)]
    known = [each for each in rows if observed[each].all()]

    def logs(sd: float) -> Float[np.ndarray, "k n C"]:
        """Log class probabilities at each node of the intercept."""
        scale = np.sqrt(1.0 + sd**2)
        return np.stack([_log_chances(scale * level + sd * node, scale * edges) for node in _NODES])

    def evidence(at_nodes: Float[np.ndarray, "k n C"]) -> float:
        given = at_nodes[:, np.arange(len(q)), q]
        return float(sum(logsumexp(given[:, each].sum(axis=1), b=_WEIGHTS) for each in known))

    at_nodes = max((logs(sd) for sd in _INTERCEPT_SDS), key=evidence)
    given = at_nodes[:, np.arange(len(q)), q]
    chances = np.empty(at_nodes.shape[1:])
    for each in rows:
        before = np.cumsum(given[:, each], axis=1) - given[:, each] + np.log(_WEIGHTS)[:, None]
        weights = np.exp(before - logsumexp(before, axis=0))
        chances[each] = np.einsum("kn,knc->nc", weights, np.exp(at_nodes[:, each]))
    return chances


def _edges(w: Float[np.ndarray, " edges"]) -> Float[np.ndarray, " bounds"]:
    """Edges (C + 1,): minus infinity, the thresholds, infinity; `w` (C - 1,): first threshold and log gaps."""
    return np.concatenate([[-np.inf], np.cumsum(np.concatenate([w[:1], np.exp(w[1:])])), [np.inf]])


def _log_masses(
    level: Float[np.ndarray, " n"], edges: Float[np.ndarray, " bounds"], q: Int[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Log P(q) at latent values `level` (n,) with noise 1, and its derivatives in the lower and the upper edge, (n,)
    each.

    Computed from the smaller tails.
    """
    low, high = edges[q] - level, edges[q + 1] - level
    above = low > 0  # then the same mass mirrored lies in the lower tail
    a, b = np.where(above, -high, low), np.where(above, -low, high)
    logs = log_ndtr(b) + np.log1p(-np.exp(log_ndtr(a) - log_ndtr(b)))
    half = 0.5 * np.log(2 * np.pi)
    return logs, -np.exp(-0.5 * low**2 - half - logs), np.exp(-0.5 * high**2 - half - logs)
