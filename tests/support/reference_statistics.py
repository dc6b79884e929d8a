"""Logits and sandwiches once more, written otherwise: mpmath derivatives, plain sums, exact rays.

The likelihood is the difference of two logistic functions as it stands in a textbook, differentiated numerically with
50 digits; covariances are loops over clusters.
"""

from collections import Counter
from itertools import combinations

import mpmath
import numpy as np

__all__ = ["Reference", "counts_to_answers", "estimates", "extreme_rays"]

mp = mpmath.mp.clone()
mp.dps = 50


def counts_to_answers(counts, clusters, rng):
    """Category, group and cluster of every answer of a table of counts (group, category), in even clusters."""
    group, category = (index.ravel() for index in np.indices(np.shape(counts)))
    group, category = (np.repeat(index, np.ravel(counts)) for index in (group, category))
    cluster = np.empty(len(group), int)
    for value in np.unique(group):
        mine = np.flatnonzero(group == value)
        cluster[mine] = rng.permutation(np.arange(len(mine)) % clusters)
    return category, group, cluster


def estimates(regression):
    """Each term's estimate."""
    return regression.table.drop_duplicates("term").set_index("term")["estimate"]


def sigma(z):
    return 1 / (1 + mp.exp(-z))


class Reference:
    """Model "binary" (θ = β, P(1) = σ(xβ)), "ordered" (θ = β, t) or "ties" (θ = β, η), fitted."""

    def __init__(self, kind, category, x):
        self.kind, self.category, self.x = kind, np.asarray(category), np.asarray(x, float)
        self.p, self.top = self.x.shape[1], int(self.category.max())
        self.size = self.p + {"binary": 0, "ordered": self.top, "ties": 1}[kind]
        self.distinct = Counter((tuple(row), int(c)) for row, c in zip(self.x, self.category, strict=True))

    def probability(self, theta, row, c):
        shift = mp.fsum(mp.mpf(b) * mp.mpf(v) for b, v in zip(theta[: self.p], row, strict=True))
        if self.kind == "binary":
            return sigma(shift) if c else sigma(-shift)
        cuts = [-theta[-1], theta[-1]] if self.kind == "ties" else list(theta[self.p :])
        upper = sigma(cuts[c] - shift) if c < len(cuts) else mp.mpf(1)
        return upper - (sigma(cuts[c - 1] - shift) if c else 0)

    def derivatives(self, theta, row, c):
        """Gradient and Hessian of log p of one answer, by central differences of 50 digits."""
        step = mp.mpf(10) ** -10  # error step² = 1e-20, rounding 1e-50 / step²

        def value(*moves):
            moved = list(theta)
            for place, sign in moves:
                moved[place] += sign * step
            return mp.log(self.probability(moved, row, c))

        k = range(self.size)
        gradient = [(value((i, 1)) - value((i, -1))) / (2 * step) for i in k]
        hessian = [
            [
                sum(s * r * value((i, s), (j, r)) for s in (1, -1) for r in (1, -1)) / (4 * step**2)
                if i <= j
                else mp.mpf(0)
                for j in k
            ]
            for i in k
        ]
        return gradient, [[hessian[min(i, j)][max(i, j)] for j in k] for i in k]

    def fit(self, start):
        """Newton's method with 50 digits."""
        theta, k = [mp.mpf(float(t)) for t in start], range(self.size)
        for _ in range(60):
            total, square = mp.zeros(self.size, 1), mp.zeros(self.size)
            for (row, c), count in self.distinct.items():
                gradient, hessian = self.derivatives(theta, row, c)
                for i in k:
                    total[i] += count * gradient[i]
                    for j in k:
                        square[i, j] -= count * hessian[i][j]
            step = mp.lu_solve(square, total)
            theta = [theta[i] + step[i] for i in k]
            if mp.norm(step) < mp.mpf(10) ** -15:
                break
        return theta

    def pieces(self, theta):
        """Score (n, k) and information (n, k, k) of every answer."""
        known = {key: self.derivatives(theta, *key) for key in self.distinct}
        keys = [(tuple(row), int(c)) for row, c in zip(self.x, self.category, strict=True)]
        score = np.array([[float(v) for v in known[key][0]] for key in keys])
        information = np.array([[[-float(v) for v in row] for row in known[key][1]] for key in keys])
        return score, information

    def covariance(self, theta, *ways):
        """iid without ways; Cameron, Gelbach & Miller's with one or two, not repaired."""
        score, information = self.pieces(theta)
        bread = np.linalg.inv(information.sum(axis=0))
        if not ways:
            return bread
        pairs = [(1, list(way)) for way in ways]
        if len(ways) == 2:
            pairs.append((-1, list(zip(*ways, strict=True))))
        return sum(sign * bread @ meat(score, labels) @ bread for sign, labels in pairs)


def meat(score, labels):
    """c Σ_g s_g s_gᵀ, cluster by cluster."""
    n, k = score.shape
    names = sorted(set(labels))
    total = np.zeros((k, k))
    for name in names:
        s = np.sum([row for row, label in zip(score, labels, strict=True) if label == name], axis=0)
        total += np.outer(s, s)
    count = len(names)
    return count * (n - 1) / ((count - 1) * (n - k)) * total


def extreme_rays(rows):
    """Every ray of {δ: rows·δ >= 0} on which k - 1 independent rows bind; rows of small integers, full rank."""
    rows = [list(map(int, row)) for row in np.unique(rows, axis=0)]
    k, rays = len(rows[0]), []
    for chosen in combinations(rows, k - 1):
        null = mpmath.matrix(k, 1)
        for i in range(k):  # generalised cross product
            minor = mpmath.matrix([[r[j] for j in range(k) if j != i] for r in chosen]) if k > 1 else None
            null[i] = (-1) ** i * (mpmath.det(minor) if k > 1 else 1)
        ray = np.array([round(float(v)) for v in null])
        for sign in (1, -1):
            if ray.any() and all(np.dot(row, sign * ray) >= 0 for row in rows):
                rays.append(sign * ray)
    return rays
