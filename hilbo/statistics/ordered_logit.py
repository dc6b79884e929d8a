"""Likelihood of answers that are intervals of a logistic variable: binary and ordered logit and their relatives.

An answer says that a logistic variable lies between two edges that are linear in the parameters:

    p = σ(u) - σ(l),   u = u0 + U·θ,   l = l0 + L·θ,   σ(z) = 1/(1 + exp(-z)),

with u0 = inf or l0 = -inf for an open side. Since σ(u) - σ(l) = σ(u)·σ(-l)·(1 - exp(l - u)),

    log p = log σ(u) + log σ(-l) + log(1 - exp(l - u)),

which is exact in both tails and concave in θ. With r = 1/(exp(u - l) - 1) its derivatives are

    ∂/∂u = σ(-u) + r,   ∂/∂l = -σ(l) - r,   -∂²/∂u² = σ(u)·σ(-u) + r(1 + r),   ∂²/∂u∂l = r(1 + r).

Ordered logit (McCullagh 1980) has u = t_c - x·β, l = t_(c-1) - x·β; binary logit is one edge at 0; paired comparisons
with ties (Rao & Kupper 1967) have the edges -η and η. A positive coefficient moves answers to higher categories.

statsmodels maximises it and makes the covariances. The likelihood itself is written here because statsmodels' ordered
model differentiates numerically, and knows neither ties nor the open edges and fixed coefficients of separated answers.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.special import expit, log_expit

__all__ = ["Design", "Fit", "design", "fit", "information", "log_likelihood", "orthogonal", "scores"]

_NEAR = 1e-6  # mean score at which the trust region hands over to Newton's method, which then takes a step or two
_NO_MAXIMUM = "The logit did not reach its maximum: it has none, or its parameters are not unique."
_LAST_STEP = 1e-9  # of the largest parameter: Newton's last step, whose square is below rounding


class Design(NamedTuple):
    """Edges of n responses as linear functions of k parameters.

    An open side has an infinite offset and a row of zeros.
    """

    upper: Float[np.ndarray, "n k"]
    lower: Float[np.ndarray, "n k"]
    upper_offset: Float[np.ndarray, " n"]
    lower_offset: Float[np.ndarray, " n"]

    def edges(self, theta: Float[np.ndarray, " k"]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Upper and lower edge of every response at `theta`."""
        return self.upper_offset + self.upper @ theta, self.lower_offset + self.lower @ theta

    def rows(self, keep: np.ndarray) -> "Design":
        """Design of the selected responses (mask or indices), all parameters kept."""
        return Design(self.upper[keep], self.lower[keep], self.upper_offset[keep], self.lower_offset[keep])

    def columns(self, keep: np.ndarray) -> "Design":
        """Design of the selected parameters (mask or indices), the others being 0."""
        return Design(self.upper[:, keep], self.lower[:, keep], self.upper_offset, self.lower_offset)

    def fixed(self, column: int, value: float) -> "Design":
        """Design of the other parameters when the one with index `column` is fixed at `value`; one column fewer."""
        upper = self.upper_offset + self.upper[:, column] * value
        lower = self.lower_offset + self.lower[:, column] * value
        others = np.arange(self.upper.shape[1]) != column
        return Design(self.upper[:, others], self.lower[:, others], upper, lower)


class Fit(NamedTuple):
    """Maximum-likelihood estimate, log-likelihood, iid covariance, and score of each response."""

    estimate: Float[np.ndarray, " k"]
    log_likelihood: float
    covariance: Float[np.ndarray, "k k"]
    scores: Float[np.ndarray, "n k"]


def design(
    category: Int[np.ndarray, " n"], predictors: Float[np.ndarray, "n p"], edges: Float[np.ndarray, "c m"]
) -> Design:
    """Design with θ = (β, τ): response i lies between (`edges`·τ)_(c-1) - x_i·β and (`edges`·τ)_c - x_i·β.

    `category` counts from 0; its largest possible value is the number of edges. The identity as `edges` gives ordered
    logit, one row without columns binary logit.
    """
    count = len(edges)
    padded = np.vstack([edges, np.zeros((1, edges.shape[1]))])  # the last row serves both open sides
    top, bottom = category == count, category == 0
    upper = np.hstack([-predictors, padded[category]])
    lower = np.hstack([-predictors, padded[category - 1]])
    upper[top], lower[bottom] = 0.0, 0.0
    return Design(upper, lower, np.where(top, np.inf, 0.0), np.where(bottom, -np.inf, 0.0))


def log_likelihood(model: Design, theta: Float[np.ndarray, " k"]) -> float:
    """Log-likelihood: sum of log p over the responses; -inf where edges are out of order."""
    upper, lower = model.edges(theta)
    if np.any(upper <= lower):
        return -np.inf
    return float(np.sum(log_expit(upper) + log_expit(-lower) + np.log(-np.expm1(lower - upper))))


def scores(model: Design, theta: Float[np.ndarray, " k"]) -> Float[np.ndarray, "n k"]:
    """Score of each response: derivative of its log p by the parameters. (n, k)."""
    upper, lower = model.edges(theta)
    inverse = _inverse_gap(upper, lower)
    by_upper, by_lower = expit(-upper) + inverse, -expit(lower) - inverse
    return by_upper[:, None] * model.upper + by_lower[:, None] * model.lower


def information(model: Design, theta: Float[np.ndarray, " k"]) -> Float[np.ndarray, "k k"]:
    """Observed information: minus the second derivative of the log-likelihood. (k, k)."""
    upper, lower = model.edges(theta)
    inverse = _inverse_gap(upper, lower)
    apart = model.upper - model.lower  # where a side is open its weight is 0, so that the row need not be right there
    return (
        _weighted_square(expit(upper) * expit(-upper), model.upper)
        + _weighted_square(expit(lower) * expit(-lower), model.lower)
        + _weighted_square(inverse * (1 + inverse), apart)
    )


def _weighted_square(weights: Float[np.ndarray, " n"], rows: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "k k"]:
    """Σ_i w_i a_i a_iᵀ over the rows a_i."""
    return (weights * rows.T) @ rows


def _inverse_gap(upper: Float[np.ndarray, " n"], lower: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """1/(exp(u - l) - 1), 0 for an open side, without overflow."""
    small = np.exp(lower - upper)
    return small / -np.expm1(lower - upper)


def fit(model: Design, start: Float[np.ndarray, " k"]) -> Fit:
    """Maximise the likelihood, by statsmodels.

    `start` must have its edges in order, and a maximum must exist (`hilbo.statistics.separation`) and be unique. The
    trust region comes first because Newton's full steps alone failed in 1 of 8 fits of random small tables. Both work
    in the coordinates of `orthogonal`. Raises RuntimeError if no maximum is found.
    """
    from scipy.linalg import solve_triangular
    from statsmodels.base.model import LikelihoodModel  # a third of a second: who fits nothing does not pay it

    inner, to_orthogonal = orthogonal(model)

    class IntervalLogit(LikelihoodModel):
        """The likelihood under the names by which statsmodels asks for it."""

        def loglike(self, theta):
            return log_likelihood(inner, theta)

        def score(self, theta):
            return scores(inner, theta).sum(axis=0)

        def hessian(self, theta):
            return -information(inner, theta)

    likelihood = IntervalLogit(np.zeros(len(model.upper)))  # statsmodels counts these; the answers are in `model`
    options = {"disp": 0, "warn_convergence": False, "skip_hessian": True}
    begun = to_orthogonal @ start
    try:
        near = likelihood.fit(begun, method="minimize", min_method="trust-exact", gtol=_NEAR, **options).params
        last_step = _LAST_STEP * (1 + np.abs(near).max())
        results = likelihood.fit(near, method="newton", tol=last_step, ridge_factor=0, **options)
    except np.linalg.LinAlgError:
        raise RuntimeError(_NO_MAXIMUM) from None
    if not results.mle_retvals["converged"]:
        raise RuntimeError(_NO_MAXIMUM)
    estimate = solve_triangular(to_orthogonal, results.params)
    half = solve_triangular(to_orthogonal, results.normalized_cov_params)
    return Fit(
        estimate,
        results.llf,
        solve_triangular(to_orthogonal, half.T),
        scores(inner, results.params) @ to_orthogonal,
    )


def orthogonal(model: Design) -> tuple[Design, Float[np.ndarray, "k k"]]:
    """Model in coordinates in which its columns are orthogonal and of equal size, and the matrix of the transformation.

    The upper triangular matrix maps coefficients to these coordinates, which makes the fit independent of the
    predictors' units and origin (e.g. dates). Raises RuntimeError for linearly dependent columns.
    """
    from scipy.linalg import solve_triangular

    columns = np.vstack([model.upper, model.lower])
    if len(columns) < columns.shape[1]:
        raise RuntimeError(_NO_MAXIMUM)
    units = np.abs(columns).max(axis=0)
    to_orthogonal = np.linalg.qr(columns / units, mode="r") * units / np.sqrt(len(columns))
    if not np.all(np.diag(to_orthogonal)):
        raise RuntimeError(_NO_MAXIMUM)
    upper, lower = (solve_triangular(to_orthogonal, side.T, trans="T").T for side in (model.upper, model.lower))
    return model._replace(upper=upper, lower=lower), to_orthogonal
