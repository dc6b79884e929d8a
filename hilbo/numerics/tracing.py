"""Functions that are traced once, and compiled programs that can be cached between processes."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, ParamSpec, TypeVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from hilbo.numerics.compiling import compiler_options
from hilbo.numerics.sharding import devices, replicated

__all__ = ["Keeper", "OfArrays", "arrays_in", "keep_with", "prepared", "program", "traced_once"]

_P = ParamSpec("_P")
_R = TypeVar("_R")

traced_once = functools.partial(jax.jit, inline=True)
"""Decorator: the function's trace is cached and inlined into each program that uses it.

For functions of arrays that programs use many times, such as the likelihood, whose tracing dominates a first fit.
"""


OfArrays = Callable[[Sequence[Any]], Any]
"""A program as a function of a call's arrays, in the order of `jax.tree.leaves`."""

Keeper = Callable[[Callable, tuple, dict[str, Any]], OfArrays | None]
"""Finds the program of a call, or makes it: of what was traced, and the call's arguments. None: it cannot be kept."""

_keepers: list[Keeper] = []


def keep_with(keeper: Keeper | None) -> None:
    """Set the cache for all programs of this process; None: programs live as long as the process."""
    _keepers[:] = [] if keeper is None else [keeper]


def program(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Decorator: compiled as by `eqx.filter_jit`, and kept from one process to the next where a command has set a
    keeper. Within another trace it is a part of that program. Its results have types of their own, no weak ones; where
    people are sharded over several devices, each device has a copy of them, and no program is kept."""
    typed = _typed(function)
    compiled, copied = eqx.filter_jit(typed), eqx.filter_jit(_copied(typed))

    @functools.wraps(function)
    def call(*args, **kwargs):
        keeps, several = bool(_keepers), devices() > 1
        arrays = arrays_in((args, kwargs)) if keeps or several else ()
        if any(isinstance(array, Tracer) for array in arrays) or not (keeps or several):
            return compiled(*args, **kwargs)
        if several:
            return copied(*args, **kwargs)
        kept = _keepers[0](typed, args, kwargs)
        return compiled(*args, **kwargs) if kept is None else kept(arrays)

    return cast(Callable[_P, _R], call)


def prepared(function: Callable, *args: Any) -> OfArrays:
    """Compiled program of a call, to be called repeatedly with arrays, without the cost of flattening records.

    Cached like other programs; without a keeper compiled once for all calls that differ in arrays only. The function
    must be one of a module, by name; calls must not be part of another trace.
    """
    typed = _typed(function)
    kept = _keepers[0](typed, args, {}) if _keepers else None
    if kept is not None:
        return kept
    leaves, structure = jax.tree.flatten(args)
    return _compiled(typed, structure, tuple(None if _is_array(leaf) else (type(leaf), leaf) for leaf in leaves))


def arrays_in(what: Any) -> tuple[Any, ...]:
    """Arrays among the leaves, NumPy's included: the inputs of a compiled program."""
    return tuple(leaf for leaf in jax.tree.leaves(what) if _is_array(leaf))


@functools.lru_cache(maxsize=32)
def _compiled(function: Callable, structure: Any, fixed: tuple[tuple[type, Any] | None, ...]) -> OfArrays:
    """Jitted function of the arrays among the leaves of the arguments; the other leaves are `fixed`."""

    def of_arrays(arrays):
        given = iter(arrays)
        return function(*jax.tree.unflatten(structure, [next(given) if leaf is None else leaf[1] for leaf in fixed]))

    return jax.jit(of_arrays, compiler_options=compiler_options())


@functools.cache
def _typed(function: Callable) -> Callable:
    """The function with results of strong types."""

    @functools.wraps(function)
    def typed(*args, **kwargs):
        return jax.tree.map(_strong, function(*args, **kwargs))

    return typed


def _copied(function: Callable) -> Callable:
    """The function with results of which each device has a copy."""

    @functools.wraps(function)
    def copied(*args, **kwargs):
        arrays, rest = eqx.partition(function(*args, **kwargs), eqx.is_array)
        return eqx.combine(replicated(arrays), rest)

    return copied


def _strong(leaf: Any) -> Any:
    """Leaf with a strong instead of a weak type."""
    return jnp.asarray(leaf, leaf.dtype) if getattr(leaf, "weak_type", False) else leaf


def _is_array(leaf: Any) -> bool:
    """Whether a leaf is an array of JAX or NumPy."""
    return isinstance(leaf, jax.Array | np.ndarray | np.generic)
