"""Covariance of a maximum-likelihood estimate whose answers are correlated within clusters, one way or two.

With H the information, s_i the scores and s_g their sums over cluster g of G, the covariance by one way is

    V = c·H⁻¹ (Σ_g s_g s_gᵀ) H⁻¹,   c = G/(G - 1) · (n - 1)/(n - k)     (Liang & Zeger 1986),

and by two ways V_A + V_B - V_AB, AB being the cells in which they cross (Cameron, Gelbach & Miller 2011), each with
its own c. That difference may be indefinite; its negative eigenvalues are then set to 0, as the authors propose, and
`Covariance.repaired` says how large the worst was. t has G - 1 degrees of freedom, G of the smaller way.
The wild bootstrap (`hilbo.statistics.wild_bootstrap`) uses the same sums, cell by cell.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

__all__ = ["Covariance", "Ways", "iid", "sandwich", "ways"]

_ROUNDING = 1e-12


class Ways(NamedTuple):
    """One or two ways in which n answers fall into clusters.

    `cells` numbers the cells in which the ways cross, (n,); `of_cell` (w, cells) the cluster of each cell by each way.
    """

    cells: Int[np.ndarray, " n"]
    of_cell: Int[np.ndarray, "w c"]

    @property
    def counts(self) -> tuple[int, ...]:
        """Clusters by each way."""
        return tuple(int(way.max()) + 1 for way in self.of_cell)

    @property
    def degrees_of_freedom(self) -> int:
        """Clusters by the smaller way, less one."""
        return min(self.counts) - 1

    def sums(self, values: Float[np.ndarray, "n *s"]) -> Float[np.ndarray, "c *s"]:
        """Sums of the answers' values over each cell."""
        return _sums(values, self.cells, self.of_cell.shape[1])

    def terms(self) -> list[tuple[float, Int[np.ndarray, " c"], int]]:
        """Sign, cluster of each cell and number of clusters of each term of the covariance."""
        terms = [(1.0, way, count) for way, count in zip(self.of_cell, self.counts, strict=True)]
        if len(self.of_cell) == 2:
            count = self.of_cell.shape[1]
            terms.append((-1.0, np.arange(count), count))
        return terms


class Covariance(eqx.Module):
    """A covariance of the estimates; `repaired`: its worst negative eigenvalue over the largest of the one-way sum."""

    matrix: Float[np.ndarray, "k k"]
    degrees_of_freedom: float
    repaired: float


def ways(*labels: Sequence | np.ndarray) -> Ways:
    """Clusters from one or two labels for each answer."""
    codes = np.array([np.unique(np.asarray(way), return_inverse=True)[1].ravel() for way in labels])
    of_cell, cells = np.unique(codes, axis=1, return_inverse=True)
    return Ways(cells.ravel(), of_cell)


def factor(clusters: int, answers: int, parameters: int) -> float:
    """Small-sample factor c of the covariance by one way."""
    return clusters / (clusters - 1) * (answers - 1) / (answers - parameters)


def iid(information: Float[np.ndarray, "n k k"]) -> Covariance:
    """H⁻¹: the covariance if all answers are independent and the model is true."""
    return Covariance(np.linalg.inv(information.sum(axis=0)), np.inf, 0.0)


def sandwich(scores: Float[np.ndarray, "n k"], information: Float[np.ndarray, "n k k"], clusters: Ways) -> Covariance:
    """Cluster-robust covariance by one way or two; each way needs two clusters at least."""
    n, k = scores.shape
    bread = np.linalg.inv(information.sum(axis=0))
    by_cell = clusters.sums(scores)
    added, taken = np.zeros((k, k)), np.zeros((k, k))
    for sign, cluster, count in clusters.terms():
        total = _sums(by_cell, cluster, count) @ bread
        (added if sign > 0 else taken)[:] += factor(count, n, k) * total.T @ total
    matrix, repaired = _repair(added, taken)
    return Covariance(matrix, float(clusters.degrees_of_freedom), repaired)


def _sums(values, index, count):
    total = np.zeros((count, *values.shape[1:]))
    np.add.at(total, index, values)
    return total


def _repair(added, taken):
    """The difference without its negative eigenvalues, and the worst of these over the largest of `added`."""
    values, vectors = np.linalg.eigh(added - taken)
    if values[0] >= 0:
        return added - taken, 0.0
    share = -values[0] / np.linalg.eigvalsh(added)[-1]
    return (vectors * np.maximum(values, 0.0)) @ vectors.T, float(share) if share > _ROUNDING else 0.0
