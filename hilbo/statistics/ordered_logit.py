"""Likelihood of answers that are intervals of a logistic variable: binary and ordered logit and their relatives.

An answer says that a logistic variable lies between two edges that are linear in the parameters:

    p = σ(u) - σ(l),   u = u0 + U·θ,   l = l0 + L·θ,   σ(z) = 1/(1 + exp(-z)),

with u0 = inf or l0 = -inf for an open side. Since σ(u) - σ(l) = σ(u)·σ(-l)·(1 - exp(l - u)),

    log p = log σ(u) + log σ(-l) + log(1 - exp(l - u)),

which is exact in both tails and concave in θ. With r = 1/(exp(u - l) - 1) its derivatives are

    ∂/∂u = σ(-u) + r,   ∂/∂l = -σ(l) - r,   -∂²/∂u² = σ(u)·σ(-u) + r(1 + r),   ∂²/∂u∂l = r(1 + r).

Ordered logit (McCullagh 1980) has u = t_c - x·β, l = t_(c-1) - x·β; binary logit is one edge at 0; paired comparisons
with ties (Rao & Kupper 1967) have the edges -η and η. A positive coefficient moves answers to higher categories.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.special import expit, log_expit

__all__ = ["Design", "design", "fit", "information", "log_likelihood", "scores"]

_STEPS, _HALVINGS = 200, 60
_LONGEST = 10.0  # change of an edge in one step
_NEAR = 1e-6  # squared Newton step in standard errors: below it, rounding of the likelihood may hide the rise
_CLOSE = 1e-14  # the same: the step that follows it is below rounding


class Design(NamedTuple):
    """The edges of n answers as functions of k parameters; an open side has an infinite offset and a row of zeros."""

    upper: Float[np.ndarray, "n k"]
    lower: Float[np.ndarray, "n k"]
    upper_offset: Float[np.ndarray, " n"]
    lower_offset: Float[np.ndarray, " n"]

    def edges(self, theta: Float[np.ndarray, " k"]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Upper and lower edge of every answer."""
        return self.upper_offset + self.upper @ theta, self.lower_offset + self.lower @ theta

    def rows(self, keep: np.ndarray) -> "Design":
        """Only these answers (mask or indices)."""
        return Design(self.upper[keep], self.lower[keep], self.upper_offset[keep], self.lower_offset[keep])

    def columns(self, keep: np.ndarray) -> "Design":
        """Only these parameters, the others being 0."""
        return Design(self.upper[:, keep], self.lower[:, keep], self.upper_offset, self.lower_offset)

    def fixed(self, column: int, value: float) -> "Design":
        """The design of the other parameters where one of them has this value."""
        upper = self.upper_offset + self.upper[:, column] * value
        lower = self.lower_offset + self.lower[:, column] * value
        others = np.arange(self.upper.shape[1]) != column
        return Design(self.upper[:, others], self.lower[:, others], upper, lower)


def design(
    category: Int[np.ndarray, " n"],
    predictors: Float[np.ndarray, "n p"],
    edges: Float[np.ndarray, "c m"],
) -> Design:
    """θ = (β, τ): answer i lies between the edges (`edges`·τ)_(c-1) - x_i·β and (`edges`·τ)_c - x_i·β.

    `category` counts from 0; its largest possible value is the number of edges. The identity as `edges` gives
    ordered logit, one row without columns binary logit.
    """
    count = len(edges)
    padded = np.vstack([edges, np.zeros((1, edges.shape[1]))])  # the last row serves both open sides
    top, bottom = category == count, category == 0
    upper = np.hstack([-predictors, padded[category]])
    lower = np.hstack([-predictors, padded[category - 1]])
    upper[top], lower[bottom] = 0.0, 0.0
    return Design(upper, lower, np.where(top, np.inf, 0.0), np.where(bottom, -np.inf, 0.0))


def log_likelihood(model: Design, theta: Float[np.ndarray, " k"]) -> float:
    """Sum of log p over the answers; -inf where edges are out of order."""
    upper, lower = model.edges(theta)
    if np.any(upper <= lower):
        return -np.inf
    return float(np.sum(log_expit(upper) + log_expit(-lower) + np.log(-np.expm1(lower - upper))))


def scores(model: Design, theta: Float[np.ndarray, " k"]) -> Float[np.ndarray, "n k"]:
    """Derivative of each answer's log p in the parameters."""
    upper, lower = model.edges(theta)
    inverse = _inverse_gap(upper, lower)
    by_upper, by_lower = expit(-upper) + inverse, -expit(lower) - inverse
    return by_upper[:, None] * model.upper + by_lower[:, None] * model.lower


def information(model: Design, theta: Float[np.ndarray, " k"]) -> Float[np.ndarray, "n k k"]:
    """Minus the second derivative of each answer's log p in the parameters."""
    upper, lower = model.edges(theta)
    inverse = _inverse_gap(upper, lower)
    shared = inverse * (1 + inverse)
    apart = model.upper - model.lower

    def square(weight, rows):
        return weight[:, None, None] * rows[:, :, None] * rows[:, None, :]

    # Where a side is open `shared` is 0, so that the gap's row need not be right there.
    return (
        square(expit(upper) * expit(-upper), model.upper)
        + square(expit(lower) * expit(-lower), model.lower)
        + square(shared, apart)
    )


def _inverse_gap(upper, lower):
    """1/(exp(u - l) - 1), 0 for an open side, without overflow."""
    small = np.exp(lower - upper)
    return small / -np.expm1(lower - upper)


def fit(model: Design, start: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
    """The parameters of the largest likelihood, by Newton's method with step halving.

    `start` must have its edges in order, and a maximum must exist (`hilbo.statistics.separation`) and be unique. Raises
    `RuntimeError` if it is not reached, which under these conditions has not been seen.
    """
    theta = start
    for _ in range(_STEPS):
        gradient = scores(model, theta).sum(axis=0)
        # Far from the maximum the information may be singular to rounding: hence no plain solve.
        step = np.linalg.lstsq(information(model, theta).sum(axis=0), gradient, rcond=None)[0]
        promised = gradient @ step
        if promised <= _CLOSE:
            return theta + step
        if promised <= _NEAR:
            theta = theta + step
            continue
        share = min(1.0, _LONGEST / max(np.abs(rows @ step).max() for rows in (model.upper, model.lower)))
        theta, moved = _climb(model, theta, share * step, share * promised)
        if not moved:
            break
    raise RuntimeError(
        "The logit did not reach its maximum: its likelihood has none, or its parameters are not unique."
    )


def _climb(model, theta, step, promised):
    value = log_likelihood(model, theta)
    for halving in range(_HALVINGS):
        share = 0.5**halving
        if log_likelihood(model, theta + share * step) >= value + 1e-4 * share * promised:
            return theta + share * step, True
    return theta, False
