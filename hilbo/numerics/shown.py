"""Conversion and validation of numeric arguments, and the short text of arrays in representations and messages."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import DTypeLike

from hilbo.errors import InputError
from hilbo.numerics.host import to_device

__all__ = ["check_positive", "concrete", "float_dtype", "floats", "has_values", "numbers", "shown"]


def concrete(*values: Any) -> bool:
    """Whether the values contain no tracer: True outside of `jit`, `grad` and `vmap`."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(values))


def has_values(*values: Any) -> bool:
    """Whether all values are arrays of JAX or NumPy, and none is a tracer or another object (a tree of `vmap` axes)."""
    return all(isinstance(value, jax.Array | np.ndarray) and not isinstance(value, Tracer) for value in values)


def float_dtype(value: Any) -> np.dtype:
    """The dtype of an array of floating-point numbers; the default one for Python numbers, integers and sequences."""
    dtype = getattr(value, "dtype", None)
    if isinstance(dtype, np.dtype) and jnp.issubdtype(dtype, jnp.floating):
        return dtype
    return np.dtype(jnp.result_type(float))


def floats(array: Any, dtype: DTypeLike | None = None) -> Any:
    """A floating-point array unchanged; integers and booleans converted to `dtype`, or to the default float type.

    Otherwise code that takes its dtype from the array would round its own numbers to integers."""
    if jnp.issubdtype(array.dtype, jnp.floating):
        return array
    return array.astype(jnp.result_type(float) if dtype is None else dtype)


def numbers(whose: str, name: str, value: Any, dtype: DTypeLike | None = None) -> jax.Array:
    """Convert a value to a JAX array, of its dtype or `dtype`. Raises `InputError` if that is impossible.

    It is for values that are not numeric and for rows of different lengths. `whose` and `name` begin the message.
    """
    try:
        return to_device(value, dtype)
    except (TypeError, ValueError):
        words = repr(value)
        raise InputError(f"{whose}: {name} is {words[:60]}; give numbers, in rows of one length.") from None


def check_positive(whose: str, **values: Any) -> None:
    """Raise `InputError` if one of the named values is, or contains, a number that is not positive or not finite.

    Tracers are not checked. `whose` begins the message.
    """
    for name, value in values.items():
        if concrete(value) and not np.all((np.asarray(value) > 0) & np.isfinite(value)):
            raise InputError(f"{whose}: {name} is {shown(value)}; it must be a finite number above 0.")


def shown(value: Any) -> str:
    """Text of a value: up to six numbers with four digits; larger arrays as dtype and shape; others as by `str`."""
    if isinstance(value, Tracer) or not isinstance(value, jax.Array | np.ndarray | np.generic):
        return str(value)
    array = np.asarray(value)
    if array.ndim == 0 and array.dtype == bool:
        return str(bool(array))
    if array.ndim > 1 or array.size > 6:
        return f"{array.dtype}[{', '.join(map(str, array.shape))}]"
    return f"{array.item():.4g}" if array.ndim == 0 else f"[{', '.join(f'{v:.4g}' for v in array.tolist())}]"
