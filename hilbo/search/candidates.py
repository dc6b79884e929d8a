"""Candidate points of the unit cube, among which a function is maximised before the best of them are polished."""

import numpy as np
from jaxtyping import Array, Float

from hilbo.numerics.host import to_device
from hilbo.search.space import SearchSpace

__all__ = ["CANDIDATES", "search_points"]

CANDIDATES = 4096
"""Points inside the feasible set among which a function is maximised before polishing; a quarter more on its walls."""


def search_points(space: SearchSpace, seed: int, count: int = CANDIDATES) -> Float[Array, "m d"]:
    """Points of the unit cube among which to look for a maximum: `count` inside the feasible set, a quarter of that
    on its walls, edges and corners.
    -> (`count` + `count` // 4, d).
    """
    return to_device(np.concatenate([space.candidates(count, seed), space.walls(count // 4, seed)]))
