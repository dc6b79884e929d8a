"""Streams of points in the unit cube, in chunks of growing size, from which a search space takes the feasible ones.

Low-discrepancy points (scrambled Sobol'), Latin hypercubes, and points on the walls, edges and corners: a function that
increases away from the data has its maximum there, which interior points never reach.
"""

from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Bool, Float, Int

__all__ = ["HELD", "crossings", "latin_chunks", "sobol_chunks", "spread_out", "take", "wall_chunks"]

Chunks = Iterator[Float[np.ndarray, "n d"]]

LEAST_SHARE = 1e-4
"""Usable fraction of the points below which `take` gives up."""
_LARGEST_CHUNK = 2**18
HELD = (0.7, 0.2, 0.1)  # shares of the wall points with one, two and three coordinates at an end


def take(
    count: int, chunks: Chunks, place: Callable[[np.ndarray], tuple[Float[np.ndarray, "n d"], Bool[np.ndarray, " n"]]]
) -> tuple[list[Float[np.ndarray, "_ d"]], int, int]:
    """Take the first `count` usable points from `chunks`, in parts; with the number found and the number tried.

    `chunks` must not end. `place` converts a chunk into points and a mask of the usable ones. Fewer than `count` are
    found only if less than `LEAST_SHARE` is usable; that raises nothing.
    """
    kept, usable_count, tried = [], 0, 0
    while usable_count < count and not (tried > 10 / LEAST_SHARE and usable_count < LEAST_SHARE * tried):
        points, usable = map(np.asarray, place(next(chunks)))
        kept.append(points[usable][: count - usable_count])
        usable_count, tried = usable_count + len(kept[-1]), tried + len(points)
    return kept, usable_count, tried


def sobol_chunks(dim: int, count: int, seed: int) -> Chunks:
    """Yield without end the points of one scrambled Sobol' sequence in chunks (n, dim).

    The first chunk has `count` points, rounded up to a power of 2 (1 for 0); each later one 16 times as many, up to
    2^18 or the size of the first, whichever is larger.
    """
    from scipy.stats import qmc  # slow to import, and only this module needs it

    engine = qmc.Sobol(dim, rng=np.random.default_rng(seed))
    for size in _sizes(2 ** max(count - 1, 0).bit_length()):
        yield engine.random(size)


def latin_chunks(dim: int, count: int, seed: int) -> Chunks:
    """Yield without end Latin hypercubes of growing size, each a chunk (n, dim); the first has `count` points."""
    rng = np.random.default_rng(seed)
    for size in _sizes(max(count, 1)):
        strata = rng.permuted(np.tile(np.arange(size), (dim, 1)), axis=1).T
        yield (strata + rng.random((size, dim))) / size


def wall_chunks(dim: int, count: int, seed: int) -> Chunks:
    """Yield without end chunks that fix coordinates of points: 0 or 1 for one or more random ones, NaN for the others.

    `HELD` contains the shares of points with one, two and three fixed coordinates. The first chunk has `count` rows.
    """
    rng = np.random.default_rng(seed)
    shares = np.array(HELD[:dim]) / sum(HELD[:dim])
    for size in _sizes(max(count, 1)):
        held = np.argsort(rng.random((size, dim)), axis=1) < rng.choice(len(shares), size, p=shares)[:, None] + 1
        yield np.where(held, rng.integers(0, 2, (size, dim)), np.nan)


def crossings(
    table: Float[np.ndarray, "l p"], positions: Float[np.ndarray, " p"], levels: Float[np.ndarray, " v"]
) -> tuple[Int[np.ndarray, " c"], Float[np.ndarray, " c"]]:
    """Where a function, tabulated along each of l lines at `positions`, crosses `levels`.

    Returns the index of the line and the linearly interpolated position of each crossing, (c,) each.
    """
    above = table[:, :, None] >= levels[None, None, :]
    line, before, level = np.nonzero(above[:, 1:] != above[:, :-1])
    left, right = table[line, before], table[line, before + 1]
    share = (levels[level] - left) / (right - left)
    return line, positions[before] + share * (positions[before + 1] - positions[before])


def spread_out(points: Float[np.ndarray, "m d"], count: int, seed: int) -> Float[np.ndarray, "count d"]:
    """Choose `count` well-spread points: those nearest to the centres of as many clusters, all different.

    If there are no more than `count` distinct points (discrete parameters), all of them, in random order and repeated.
    """
    distinct = np.unique(points, axis=0)
    if len(distinct) <= count:
        return np.resize(np.random.default_rng(seed).permutation(distinct), (count, points.shape[1]))
    from scipy.cluster.vq import kmeans2
    from scipy.spatial.distance import cdist

    centres, _ = kmeans2(points, count, seed=np.random.default_rng(seed), minit="++")
    left, rows = cdist(centres, points), []
    for row in left:
        rows.append(int(row.argmin()))
        left[:, rows[-1]] = np.inf
    return points[rows]


def _sizes(size: int) -> Iterator[int]:
    """Yield without end chunk sizes: `size`, then each 16 times the last, up to a limit."""
    while True:
        yield size
        size = max(size, min(16 * size, _LARGEST_CHUNK))
