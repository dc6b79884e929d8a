"""Cluster-robust covariance of a maximum-likelihood estimate, with one-way or two-way clustering.

With H the information, s_i the scores and s_g their sums over cluster g of G, the one-way covariance is

    V = c·H⁻¹ (Σ_g s_g s_gᵀ) H⁻¹,   c = G/(G - 1) · (n - 1)/(n - k)

(Liang & Zeger 1986; c is linear regression's convention for small samples, and makes V unbiased for none), and the
two-way one V_A + V_B - V_AB, AB being the intersections (Cameron, Gelbach & Miller 2011), each with its own c.
statsmodels computes them. That difference may be indefinite, which statsmodels leaves as it is; its negative
eigenvalues are set to 0 here, as the authors propose, and `Covariance.repaired` reports how large the worst was. t has
G - 1 degrees of freedom, G of the smaller way.

The cluster jackknife is the linearised one, CV3L, of MacKinnon, Nielsen & Webb (2024, arXiv:2406.00650): with H_g the
information of cluster g,

    V = (G - 1)/G · Σ_g d_g d_gᵀ,   d_g = (H - H_g)⁻¹ s_g,

where -d_g is the Newton step from the estimate towards that without cluster g. It is larger than the above where few or
unequal clusters decide an estimate.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from hilbo.statistics.ordered_logit import Design, Fit, information, orthogonal, scores

__all__ = ["Covariance", "clustered", "jackknifed"]

_ROUNDING = 1e-12
_SINGULAR = 1e-8  # of an eigenvalue of the information without a cluster, in units of the whole one


class Covariance(eqx.Module):
    """Covariance of the estimates.

    `repaired`: its worst negative eigenvalue / the largest of the sum of one-way covariances.
    """

    matrix: Float[np.ndarray, "k k"]
    degrees_of_freedom: float
    repaired: float


def clustered(fitted: Fit, *clusters: Int[np.ndarray, " n"]) -> Covariance:
    """Cluster-robust covariance with one-way or two-way clustering.

    Each array of `clusters` has the cluster index of every response, and needs two clusters at least.
    """
    from statsmodels.stats.sandwich_covariance import cov_cluster, cov_cluster_2groups

    # With H⁻¹ in the scores a variance is a sum of squares: where clusters agree it is 0, and not a rounding below it.
    influence = fitted.scores @ fitted.covariance
    sandwich = (influence, np.eye(len(fitted.estimate)))
    degrees_of_freedom = float(min(len(np.unique(way)) for way in clusters) - 1)
    if len(clusters) == 1:
        return Covariance(cov_cluster(sandwich, clusters[0]), degrees_of_freedom, 0.0)
    both_ways, first, second = cov_cluster_2groups(sandwich, *clusters)
    matrix, repaired = _repair(both_ways, first + second)
    return Covariance(matrix, degrees_of_freedom, repaired)


def jackknifed(model: Design, fitted: Fit, clusters: Int[np.ndarray, " n"]) -> Covariance | None:
    """Covariance by the linearised jackknife over `clusters` (n,), of which there are two at least.

    None if without some cluster the others' responses do not determine the estimate. `model`: the design of `fitted`.
    Computed where the columns are orthogonal, so that the predictors' units and origin do not matter.
    """
    from scipy.linalg import eigvalsh, solve_triangular

    design, to_orthogonal = orthogonal(model)
    estimate, each = to_orthogonal @ fitted.estimate, np.unique(clusters)
    whole, by_answer, steps = information(design, estimate), scores(design, estimate), []
    for cluster in each:
        own = clusters == cluster
        rest = whole - information(design.rows(own), estimate)
        if eigvalsh(rest, whole)[0] < _SINGULAR:
            return None
        steps.append(np.linalg.solve(rest, by_answer[own].sum(axis=0)))
    moved = solve_triangular(to_orthogonal, np.transpose(steps))
    return Covariance((len(each) - 1) / len(each) * (moved @ moved.T), float(len(each) - 1), 0.0)


def _repair(
    covariance: Float[np.ndarray, "k k"], one_way_sum: Float[np.ndarray, "k k"]
) -> tuple[Float[np.ndarray, "k k"], float]:
    """Covariance with negative eigenvalues set to 0, and the worst relative to the largest of the one-way sum."""
    values, vectors = np.linalg.eigh(covariance)
    if values[0] >= 0:
        return covariance, 0.0
    share = -values[0] / np.linalg.eigvalsh(one_way_sum)[-1]
    return (vectors * np.maximum(values, 0.0)) @ vectors.T, float(share) if share > _ROUNDING else 0.0
