"""Small things are computed on the host: outside of a trace every operation of JAX, on every shape, is a program of its
own, which takes ten milliseconds to trace, lower and load and nothing to run.
"""

from typing import Any

import numpy as np

__all__ = ["namespace_of", "placed"]


def namespace_of(*values: Any) -> Any:
    """NumPy where all values are NumPy's or plain numbers, else `jax.numpy`, which is imported only then: for functions
    that are written once and give what they are given."""
    if all(isinstance(value, np.ndarray | np.generic | float | int) for value in values):
        return np
    import jax.numpy as jnp

    return jnp


def placed(value: Any, dtype: Any = None) -> Any:
    """As `jnp.asarray`, without a program where the value is on the host; a copy, so that the host's may change."""
    import jax

    if any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(value)):
        return jax.numpy.asarray(value, dtype)
    return jax.device_put(np.array(value, dtype))
