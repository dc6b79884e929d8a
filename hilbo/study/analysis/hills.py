"""Modes (hills) of a population map, and the probability that the best stimulus is at each.

Even points of the map are added from the highest down. A point joins the hill of its higher neighbours; one without any
begins a new hill; where two hills meet, the lower one is merged into the other if its top is above the meeting point by
less than the map's standard deviation at that top, which is a dip that the responses do not show. Joint draws of the
map then give the frequency with which the maximum is on each hill. Its *centre* is the mean of these maxima, of
unordered levels the most frequent.

Reference: Edelsbrunner & Harer (2010), Computational Topology, chapter VII, for tops and the places where they merge.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from hilbo.kernels import Stationary, embedded

__all__ = ["Hill", "hills_of"]

_AROUND, _MOST = 2, 64  # neighbours of a point: so many times 3^d, in all directions, up to a number
_LEAST = 0.01  # of the draws: rarer modes are ignored


class Hill(NamedTuple):
    """A mode of the map: its highest point and the mean of the draws' maxima on it, in box coordinates (in which the
    feasible set is a cube)."""

    top: Float[np.ndarray, " d"]
    centre: Float[np.ndarray, " d"]
    probability: float
    """Posterior probability that the best stimulus is on it."""


def hills_of(
    points: Float[np.ndarray, "m d"],
    height: Float[np.ndarray, " m"],
    sd: Float[np.ndarray, " m"],
    weight: Float[np.ndarray, " m"],
    kernel: Stationary,
) -> tuple[Hill, ...]:
    """Hills in the order of falling probability, without those below 0.01.

    `points` (m, d): even points in box coordinates; `height`, `sd` (m,): closeness of the map's mean to the goal, and
    its standard deviation there; `weight` (m,): fraction of joint draws that are largest at each point; `kernel`: its
    length scales define the distance of points.
    """
    tops = _tops(embedded(kernel, points), height, sd)
    hills = []
    for top in np.unique(tops):
        on = tops == top
        probability = float(weight[on].sum())
        if probability >= _LEAST:
            centre = weight[on] @ points[on] / probability
            for i in (i for i, count in enumerate(kernel.levels) if count):  # a level that is likeliest, and no mean
                values, which = np.unique(points[on, i], return_inverse=True)
                centre[i] = values[np.bincount(which, weight[on]).argmax()]
            hills.append(Hill(points[top], centre, probability))
    return tuple(sorted(hills, key=lambda hill: -hill.probability))


def _tops(
    scaled: Float[np.ndarray, "m d"], height: Float[np.ndarray, " m"], sd: Float[np.ndarray, " m"]
) -> Int[np.ndarray, " m"]:
    """Index of the mode that each point belongs to, (m,): the points above it lead there. Two modes are merged if the
    dip between them, below the lower one, is less than the standard deviation there.

    `scaled` (m, d): points in length scales of the kernel; `height`, `sd` (m,): mean and standard deviation of the map.
    """
    count, d = scaled.shape
    _, near = KDTree(scaled).query(scaled, min(3**d * _AROUND, _MOST, count))
    joined = list(range(count))  # to the top of a hill, or of one that this hill became part of

    def top_of(point: int) -> int:
        while joined[point] != point:
            point = joined[point]
        return point

    for point in np.argsort(-height, kind="stable").tolist():
        higher = [other for other in near[point].tolist() if height[other] > height[point]]
        if not higher:
            continue
        joined[point] = top_of(max(higher, key=lambda other: height[other]))
        tops = {top_of(other) for other in higher}
        best = max(tops, key=lambda top: height[top])
        for top in tops - {best}:
            if height[top] - height[point] < sd[top]:
                joined[top] = best
    return np.array([top_of(point) for point in range(count)])
