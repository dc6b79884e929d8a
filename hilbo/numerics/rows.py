"""Selection of rows of stacked arrays outside of `jit`."""

from typing import Any, TypeVar

import jax
import numpy as np
from jaxtyping import Int

__all__ = ["rows_of"]

_Tree = TypeVar("_Tree")


def rows_of(stacked: _Tree, rows: Int[np.ndarray, " k"]) -> _Tree:
    """Record with the given rows of all its arrays, as JAX arrays on the default device.

    Selected on the host: on the device each shape would compile a small program, which takes longer than the copy.
    """

    def taken(leaf: Any) -> Any:
        return np.asarray(leaf)[rows]

    return jax.device_put(jax.tree.map(taken, stacked))
