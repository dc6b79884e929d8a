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
"""Finds the program of a call, or makes it, from the traced function and the call's arguments. None: it cannot be
cached."""

_keepers: list[Keeper] = []


def keep_with(keeper: Keeper | None) -> None:
    """Set the cache of compiled programs for this process; with None, programs live as long as the process."""
    _keepers[:] = [] if keeper is None else [keeper]


def program(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Decorator: compile a function as `eqx.filter_jit` does, and take its program from the cache that `keep_with` set.

    A call within another trace becomes part of that program. If people are sharded over several devices the cache is
    not used, and each device gets a copy of the results. Results never have weak types.
    """
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
    """Compile `function(*args)`; return the program as a function of the arrays among `args` (as by `arrays_in`).

    It can be called repeatedly without the cost of flattening records; all other arguments are fixed. The program comes
    from the cache of `keep_with`; without one it is compiled once for all calls that differ in arrays only. The
    function must be defined in a module, not within another; calls must not be part of another trace.
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
    """Jitted function of the arrays among the leaves of the arguments, cached in memory.

    `structure`: tree of the arguments; `fixed`: type and value of each leaf that is no array, None for an array.
    """

    def of_arrays(arrays):
        given = iter(arrays)
        return function(*jax.tree.unflatten(structure, [next(given) if leaf is None else leaf[1] for leaf in fixed]))

    return jax.jit(of_arrays, compiler_options=compiler_options())


@functools.cache
def _typed(function: Callable) -> Callable:
    """The same function, but its results have no weak types. Cached, so that equal functions give one object."""

    @functools.wraps(function)
    def typed(*args, **kwargs):
        return jax.tree.map(_strong, function(*args, **kwargs))

    return typed


def _copied(function: Callable) -> Callable:
    """The same function, but each device of the mesh gets a copy of the arrays in its results."""

    @functools.wraps(function)
    def copied(*args, **kwargs):
        arrays, rest = eqx.partition(function(*args, **kwargs), eqx.is_array)
        return eqx.combine(replicated(arrays), rest)

    return copied


def _strong(leaf: Any) -> Any:
    """The leaf, converted to a strong type if it is an array of a weak type."""
    return jnp.asarray(leaf, leaf.dtype) if getattr(leaf, "weak_type", False) else leaf


def _is_array(leaf: Any) -> bool:
    """Whether a leaf is an array of JAX or an array or scalar of NumPy."""
    return isinstance(leaf, jax.Array | np.ndarray | np.generic)
