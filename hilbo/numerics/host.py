"""Small things are computed on the host: outside of a trace every operation of JAX, on every shape, is a program of its
own, which takes ten milliseconds to trace, lower and load and nothing to run.
"""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

__all__ = ["floating", "namespace_of", "on_host", "placed", "scan"]


def namespace_of(*values: Any) -> Any:
    """NumPy where all values are NumPy's or plain numbers, else `jax.numpy`, which is imported only then: for functions
    that are written once and give what they are given."""
    if all(isinstance(value, np.ndarray | np.generic | float | int) for value in values):
        return np
    import jax.numpy as jnp

    return jnp


def on_host(*values: Any) -> bool:
    """Whether all are NumPy's numbers: what is computed of them is computed by NumPy."""
    return all(isinstance(value, np.ndarray | np.generic) for value in values)


def scan(step: Callable[[Any, Any], Any], start: Any, over: Any) -> Any:
    """The last of `step`'s results, from `start` over the numbers of an array: a loop of NumPy's or of JAX's."""
    if on_host(over):
        return functools.reduce(step, over, start)
    import jax

    return jax.lax.scan(lambda carry, value: (step(carry, value), None), start, over)[0]


def placed(value: Any, dtype: Any = None) -> Any:
    """As `jnp.asarray`, without a program where the value is on the host; a copy, so that the host's may change."""
    import jax

    if any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(value)):
        return jax.numpy.asarray(value, dtype)
    return jax.device_put(np.array(value, dtype))


def floating(x: Any) -> Any:
    """Floating-point numbers; NumPy's where they are NumPy's, with which small things are computed faster."""
    xp = namespace_of(x)
    return xp.asarray(x, xp.result_type(1.0, x))
