"""What is traced once: functions whose trace is kept, and programs that a command calls from outside of any trace."""

import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer

__all__ = ["Keeper", "keep_with", "program", "traced_once"]

_P = ParamSpec("_P")
_R = TypeVar("_R")

traced_once = functools.partial(jax.jit, inline=True)
"""Decorator: what was traced is copied into each program that uses the function, which compiles to the same code.

For functions of arrays that programs use many times: tracing the likelihood is most of what a first fit waits for.
"""


Keeper = Callable[[Callable, Callable, tuple, dict[str, Any]], Any]
"""Answers a call of a program: what was traced, the same compiled, and the call's arguments."""

_keepers: list[Keeper] = []


def keep_with(keeper: Keeper | None) -> None:
    """From now on every call of a program is the keeper's; None: programs live as long as the process."""
    _keepers[:] = [] if keeper is None else [keeper]


def program(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Decorator: compiled as by `eqx.filter_jit`, and kept from one process to the next where a command has set a
    keeper. Within another trace it is a part of that program. Its results have types of their own, no weak ones."""

    @functools.wraps(function)
    def typed(*args, **kwargs):
        return jax.tree.map(_typed, function(*args, **kwargs))

    compiled = eqx.filter_jit(typed)

    @functools.wraps(function)
    def call(*args, **kwargs):
        if not _keepers or any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((args, kwargs))):
            return compiled(*args, **kwargs)
        return _keepers[0](typed, compiled, args, kwargs)

    return cast(Callable[_P, _R], call)


def _typed(leaf: Any) -> Any:
    return jnp.asarray(leaf, leaf.dtype) if getattr(leaf, "weak_type", False) else leaf
