"""Functions that compute with NumPy or with JAX, and the transfer of values to the device.

Outside of a trace every operation of JAX on a new shape is a separate program: it takes ten milliseconds to trace,
lower and load, and nothing to run. Small computations are therefore done by NumPy.
"""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

__all__ = ["floating", "namespace_of", "on_host", "scan", "stopped", "to_device"]

_T = TypeVar("_T")


def namespace_of(*values: Any) -> Any:
    """`numpy` if all values are NumPy arrays or plain numbers, else `jax.numpy`, which is imported only then.

    For functions that return the kind of array that they were given.
    """
    if all(isinstance(value, np.ndarray | np.generic | float | int) for value in values):
        return np
    import jax.numpy as jnp

    return jnp


def on_host(*values: Any) -> bool:
    """Whether all values are NumPy arrays or NumPy scalars; False for plain Python numbers."""
    return all(isinstance(value, np.ndarray | np.generic) for value in values)


def scan(step: Callable[[Any, Any], Any], start: Any, over: Any) -> Any:
    """Final carry of `step(carry, value) -> carry` over the first axis of `over`, beginning with `start`.

    A Python loop if `over` is a NumPy array, else `jax.lax.scan`.
    """
    if on_host(over):
        return functools.reduce(step, over, start)
    import jax

    return jax.lax.scan(lambda carry, value: (step(carry, value), None), start, over)[0]


def stopped(value: _T) -> _T:
    """The value, as a constant for differentiation."""
    if namespace_of(value) is np:
        return value
    import jax

    return jax.lax.stop_gradient(value)


def to_device(value: Any, dtype: Any = None) -> Any:
    """Convert a value to a JAX array, of its dtype or `dtype`.

    Values of NumPy or Python are copied, and nothing is compiled; a value that contains JAX arrays goes to
    `jnp.asarray`. Raises `TypeError` or `ValueError` for values that are not numeric arrays.
    """
    import jax

    if any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(value)):
        return jax.numpy.asarray(value, dtype)
    return jax.device_put(np.array(value, dtype))


def floating(x: Any) -> Any:
    """Convert values to an array of floating-point numbers: NumPy for NumPy arrays and plain numbers, else JAX.

    Floating-point arrays keep their precision; others get the default one.
    """
    xp = namespace_of(x)
    return xp.asarray(x, xp.result_type(1.0, x))
