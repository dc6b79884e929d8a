"""Rows of stacked arrays, outside of any trace."""

from typing import Any, TypeVar

import jax
import numpy as np
from jaxtyping import Int

__all__ = ["rows_of"]

_Tree = TypeVar("_Tree")


def rows_of(stacked: _Tree, rows: Int[np.ndarray, " k"]) -> _Tree:
    """The same records of some rows of their arrays. Taken on the host: on the device it is a small program for each
    shape, and tracing it takes longer than the copy."""

    def taken(leaf: Any) -> Any:
        return np.asarray(leaf)[rows]

    return jax.device_put(jax.tree.map(taken, stacked))
