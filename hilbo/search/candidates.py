"""Candidate points of the unit cube for maximising a function; the best of them are refined afterwards."""

import numpy as np
from jaxtyping import Array, Float

from hilbo.numerics.host import to_device
from hilbo.search.space import SearchSpace

__all__ = ["CANDIDATES", "search_points"]

CANDIDATES = 4096
"""Number of candidates inside the feasible set; a quarter more lie on its boundary."""


def search_points(space: SearchSpace, seed: int, count: int = CANDIDATES) -> Float[Array, "m d"]:
    """Candidate points of the unit cube: `count` inside the feasible set, then a quarter of that on its boundary.

    -> (`count` + `count` // 4, d). Raises `InputError` if too few points are feasible.
    """
    return to_device(np.concatenate([space.candidates(count, seed), space.walls(count // 4, seed)]))
