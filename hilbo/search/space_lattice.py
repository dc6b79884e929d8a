"""Lattice on which a search space is screened: a tensor grid in columns along K1, and points of the passivity boundary.

A column of the feasible set ends at the passivity boundary, x_K1 = x_K1max(B1, alpha); its ends are lattice points.
Where that boundary is steep, columns meet it too rarely. There the points are those at which it meets grid lines along
B1 and along alpha: interpolated in a table of the boundary, then moved exactly onto it.
"""

import functools

import jax
import numpy as np

from hilbo.search.columns import COLUMNS, ROWS, column_ends, column_table
from hilbo.search.lattice import Lattice
from hilbo.search.space import SearchSpace
from hilbo.search.space_filling import crossings

__all__ = ["lattice_of"]


@functools.lru_cache(maxsize=16)
def lattice_of(space: SearchSpace, nodes: int) -> Lattice:
    """Lattice of an `even` space with `nodes` per coordinate, cached; with mechanics, of K1, B1 and alpha alone.

    Its columns run along K1; without mechanics along the first parameter, and all points are feasible.
    """
    even, dim = np.linspace(0.0, 1.0, nodes), space.dim
    if space.mechanics is None:
        none = np.zeros((0, nodes ** (dim - 1)))
        inside, extra = np.ones((nodes, none.shape[1]), bool), np.zeros((0, dim))
        return _on_device(even, inside, none, none > 0, extra, 0, dim)
    along = space.names.index("K1")
    others = np.stack(np.meshgrid(*[even] * (dim - 1), indexing="ij"), axis=-1).reshape(-1, dim - 1)
    low, high = _ends_of(space, np.insert(others, along, 0.0, axis=1))
    inside = (low <= even[:, None]) & (even[:, None] <= high) & (high > low)
    ends = np.stack([low, high] if space.mechanics.effective_damping else [high])
    present = np.broadcast_to(high > low, ends.shape)
    return _on_device(even, inside, ends, present, _steep_wall(space, even), along, dim)


def _on_device(nodes, inside, ends, present, extra, along, dim) -> Lattice:
    """Lattice of these arrays, transferred to the device without compiling a program for each shape."""
    nodes, inside, ends, present, extra = jax.device_put((nodes, inside, ends, present, extra))
    return Lattice(nodes, inside, ends, present, extra, along, dim)


def _steep_wall(space, levels):
    """Points (p, 3) of the unit cube where the upper end of K1 crosses every second one of `levels` (unit-cube K1),
    sought along alpha and along B1: a grid of columns misses the boundary where it is steep. Only for spaces of K1, B1
    and alpha."""
    high, rises = column_table(space.columns)[1], levels[-1:0:-2]
    points = np.ones((0, 3))
    for table, lines, positions, names in (
        (high.T, COLUMNS, ROWS, ("alpha", "B1")),
        (high, ROWS, COLUMNS, ("B1", "alpha")),
    ):
        rows = np.abs(lines[:, None] - levels[None, :]).argmin(axis=0)
        line, place = crossings(table[rows], positions, rises)
        wall = np.ones((len(line), 3))
        wall[:, [space.names.index(name) for name in names]] = np.stack([lines[rows][line], place], axis=1)
        points = np.concatenate([points, wall])
    low, high = _ends_of(space, points)
    points[:, space.names.index("K1")] = high
    return points[high > low]


def _ends_of(space, points):
    """Lower and upper ends (n,) of the columns of points (n, d), in x_K1.

    Evaluated in batches of the table's size, so that nothing is compiled again.
    """
    shape = (len(ROWS), len(COLUMNS), space.dim)
    parts = []
    for begin in range(0, len(points), shape[0] * shape[1]):
        part = points[begin : begin + shape[0] * shape[1]]
        filled = np.full((shape[0] * shape[1], space.dim), 0.5)
        filled[: len(part)] = part
        ends = column_ends(space.columns, filled.reshape(shape))
        parts.append([np.asarray(end).reshape(-1)[: len(part)] for end in ends])
    return tuple(np.concatenate(end) for end in zip(*parts, strict=True))
