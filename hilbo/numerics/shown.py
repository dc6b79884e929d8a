"""Short words for records of arrays: what a notebook or a debugger shows of them."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import DTypeLike

from hilbo.errors import InputError
from hilbo.numerics.host import placed

__all__ = ["check_positive", "concrete", "float_dtype", "floats", "known", "numbers", "shown"]


def concrete(*values: Any) -> bool:
    """Whether these are numbers, and not what JAX traces or maps over."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(values))


def known(*values: Any) -> bool:
    """Whether these are arrays with numbers in them: else a record is a tree of something else, or traced."""
    return all(isinstance(value, jax.Array | np.ndarray) and not isinstance(value, Tracer) for value in values)


def float_dtype(value: Any) -> np.dtype:
    """The dtype of an array of floating-point numbers; the default one for Python numbers, integers and sequences."""
    dtype = getattr(value, "dtype", None)
    if isinstance(dtype, np.dtype) and jnp.issubdtype(dtype, jnp.floating):
        return dtype
    return np.dtype(jnp.result_type(float))


def floats(array: Any, dtype: DTypeLike | None = None) -> Any:
    """An array of floating-point numbers as it is; whole numbers, yes and no in this dtype, else in the default one:
    what takes its dtype from an array would cut its own numbers off to whole ones."""
    if jnp.issubdtype(array.dtype, jnp.floating):
        return array
    return array.astype(jnp.result_type(float) if dtype is None else dtype)


def numbers(whose: str, name: str, value: Any, dtype: DTypeLike | None = None) -> jax.Array:
    """A value as an array. Raises `InputError` for what holds no numbers, or rows of different lengths."""
    try:
        return placed(value, dtype)
    except (TypeError, ValueError):
        words = repr(value)
        raise InputError(f"{whose}: {name} is {words[:60]}; give numbers, in rows of one length.") from None


def check_positive(whose: str, **values: Any) -> None:
    """Raises `InputError` for numbers that are not above 0, or not finite; what is traced is not looked at."""
    for name, value in values.items():
        if concrete(value) and not np.all((np.asarray(value) > 0) & np.isfinite(value)):
            raise InputError(f"{whose}: {name} is {shown(value)}; it must be a finite number above 0.")


def shown(value: Any) -> str:
    """A number with four digits, a short list of them, else shape and dtype; what is traced as JAX writes it."""
    if isinstance(value, Tracer) or not isinstance(value, jax.Array | np.ndarray | np.generic):
        return str(value)
    array = np.asarray(value)
    if array.ndim == 0 and array.dtype == bool:
        return str(bool(array))
    if array.ndim > 1 or array.size > 6:
        return f"{array.dtype}[{', '.join(map(str, array.shape))}]"
    return f"{array.item():.4g}" if array.ndim == 0 else f"[{', '.join(f'{v:.4g}' for v in array.tolist())}]"
