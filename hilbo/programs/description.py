"""Cache key of a call of a program: everything that its trace may depend on, apart from the code.

Calls with equal keys share a program. An argument without a stable description (a function defined inside another, an
object of an unknown type) raises `NotKeptError`; such a call is traced anew by every process.
"""

import dataclasses
import enum
import functools
import inspect
import sys
from collections.abc import Callable, Mapping
from types import BuiltinFunctionType, FunctionType
from typing import Any

import equinox as eqx
import jax
import msgspec
import numpy as np

__all__ = ["NotKeptError", "describe", "name_of"]


class NotKeptError(Exception):
    """The call cannot be cached; the message states why."""


def describe(function: Callable, args: tuple, kwargs: dict[str, Any]) -> str:
    """Cache key of a call: arrays by shape, dtype and weak type, everything else by value.

    Raises `NotKeptError` for a function or an argument without a stable description.
    """
    return f"{name_of(function)} {_words(args)} {_words(kwargs)}"


def name_of(what: Any) -> str:
    """Module and qualified name of a function or class. Raises `NotKeptError` if that name does not lead to it."""
    module, path = getattr(what, "__module__", None), getattr(what, "__qualname__", "")
    named: Any = sys.modules.get(str(module))
    for part in path.split("."):
        named = getattr(named, part, None)
    if named is None or inspect.unwrap(named) is not inspect.unwrap(what):
        raise NotKeptError(f"{module}.{path} is not found by its name")
    return f"{module}.{path}"


def _words(what: Any) -> str:
    """Description of one argument. Raises `NotKeptError` if it has no stable one."""
    if isinstance(what, jax.Array):
        return f"array:{what.dtype}{list(what.shape)}{'weak' * _weak(what)}"
    if isinstance(what, np.ndarray | np.generic):
        return f"numpy:{what.dtype.str}{list(what.shape)}"
    if type(what) in (type(None), bool, int, str, bytes):
        return f"{type(what).__name__}:{what!r}"
    if type(what) is float:
        return f"float:{what.hex()}"
    if isinstance(what, np.dtype):
        return f"dtype:{what.str}"
    return _words_of_parts(what)


def _weak(array: jax.Array) -> bool:
    """Whether an array has a weak type; random keys have no such attribute."""
    return getattr(array, "weak_type", False)


def _words_of_parts(what: Any) -> str:
    """Description of a class, function, container or record. Raises `NotKeptError` for other types."""
    if isinstance(what, enum.Enum):
        return f"{name_of(type(what))}.{what.name}"
    if isinstance(what, type | FunctionType | BuiltinFunctionType):
        return name_of(what)
    if isinstance(what, functools.partial):
        _refuse_arrays((what.args, what.keywords))
        return f"partial({_words(what.func)} {_words(what.args)} {_words(what.keywords)})"
    if isinstance(what, Mapping):
        return "{" + " ".join(f"{_words(key)}={_words(value)}" for key, value in what.items()) + "}"
    if isinstance(what, tuple | list):
        kind = type(what).__name__ if type(what) in (tuple, list) else name_of(type(what))
        return f"{kind}(" + " ".join(map(_words, what)) + ")"
    if isinstance(what, msgspec.Struct):
        _refuse_arrays([getattr(what, name) for name in what.__struct_fields__])
        parts = (f"{name}={_words(getattr(what, name))}" for name in what.__struct_fields__)
        return f"{name_of(type(what))}({' '.join(parts)})"
    if dataclasses.is_dataclass(what):
        return _words_of_fields(what)
    raise NotKeptError(f"{type(what).__name__} has no words")


def _words_of_fields(what: Any) -> str:
    """Description of a dataclass by its fields, with arrays only in the dynamic ones of an Equinox module.

    Raises `NotKeptError` for an array in any other field.
    """
    dynamic = isinstance(what, eqx.Module)
    parts = []
    for field in dataclasses.fields(what):
        value = getattr(what, field.name)
        if not dynamic or field.metadata.get("static", False):
            _refuse_arrays(value)
        parts.append(f"{field.name}={_words(value)}")
    return f"{name_of(type(what))}({' '.join(parts)})"


def _refuse_arrays(static: Any) -> None:
    """Raise `NotKeptError` if a static value contains an array."""
    if any(isinstance(leaf, jax.Array | np.ndarray) for leaf in jax.tree.leaves(static)):
        raise NotKeptError("an array is part of the program")
