"""Cluster-robust covariance of a maximum-likelihood estimate, with one-way or two-way clustering.

With H the information, s_i the scores and s_g their sums over cluster g of G, the one-way covariance is

    V = c·H⁻¹ (Σ_g s_g s_gᵀ) H⁻¹,   c = G/(G - 1) · (n - 1)/(n - k)

(Liang & Zeger 1986; c is linear regression's convention for small samples, and makes V unbiased for none), and the
two-way one V_A + V_B - V_AB, AB being the intersections (Cameron, Gelbach & Miller 2011), each with its own c.
statsmodels computes them. That difference may be indefinite, which statsmodels leaves as it is; its negative
eigenvalues are set to 0 here, as the authors propose, and `Covariance.repaired` reports how large the worst was. t has
G - 1 degrees of freedom, G of the smaller way.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from hilbo.statistics.ordered_logit import Fit

__all__ = ["Covariance", "clustered"]

_ROUNDING = 1e-12


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


def _repair(
    covariance: Float[np.ndarray, "k k"], one_way_sum: Float[np.ndarray, "k k"]
) -> tuple[Float[np.ndarray, "k k"], float]:
    """Covariance with negative eigenvalues set to 0, and the worst relative to the largest of the one-way sum."""
    values, vectors = np.linalg.eigh(covariance)
    if values[0] >= 0:
        return covariance, 0.0
    share = -values[0] / np.linalg.eigvalsh(one_way_sum)[-1]
    return (vectors * np.maximum(values, 0.0)) @ vectors.T, float(share) if share > _ROUNDING else 0.0
