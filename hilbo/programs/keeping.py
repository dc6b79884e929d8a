"""Calls of programs answered from what was kept: the keeper that a command sets."""

import functools
import pickle
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import export

from hilbo.programs.description import NotKeptError, describe
from hilbo.programs.entries import Entries, Entry
from hilbo.programs.surroundings import code_digest, surroundings

__all__ = ["Programs"]


class _Array(NamedTuple):
    """Where an array stands in a program's result."""

    number: int


class _Ready(NamedTuple):
    """A program that runs: what it computes of a call's arrays, and the result around them."""

    run: Callable
    structure: Any

    def __call__(self, arrays: Sequence[Any]) -> Any:
        results = self.run(*arrays)
        return jax.tree.map(
            lambda leaf: results[leaf.number] if isinstance(leaf, _Array) else leaf,
            self.structure,
            is_leaf=lambda leaf: isinstance(leaf, _Array),
        )


class Programs:
    """Keeps the programs of a package's functions among `entries`.

    A program that is not there is traced, written, read back and compared with what was traced, byte for byte; what
    runs, in this process as in every later one, is what was read back. XLA's own cache knows its compiled form.
    """

    def __init__(self, entries: Entries, package: Path):
        self._entries, self._package = entries, package
        self._code = code_digest(package)
        self._known: dict[Any, _Ready | None] = {}
        self._finding = threading.RLock()  # calls may come from several threads

    @functools.cached_property
    def _around(self) -> str:
        """Asked for when a program is: until then nobody may have to know of JAX's devices."""
        return f"code {self._code}\n{surroundings()}"

    def __call__(
        self, function: Callable, args: tuple, kwargs: dict[str, Any]
    ) -> Callable[[Sequence[Any]], Any] | None:
        """The program of a call as a function of the call's arrays; None if it cannot be kept."""
        leaves, tree = jax.tree.flatten((args, kwargs))
        try:
            key = (function, tree, tuple(_kind(leaf) for leaf in leaves))
            if key not in self._known:
                with self._finding:
                    if key not in self._known:
                        self._known[key] = self._find(function, args, kwargs)
        except TypeError:  # something that cannot be hashed; what is wrong with the call itself is met again there
            return None
        return self._known[key]

    def _find(self, function, args, kwargs) -> _Ready | None:
        """From its entry, or made; None if there is no way to keep it."""
        if jax.device_count() > 1:
            return None
        try:
            words = f"{self._around}\n{describe(function, args, kwargs)}"
        except NotKeptError:
            return None
        entry = self._entries.read(words)
        if entry is None:
            entry = self._make(words, function, args, kwargs)
        return None if entry is None else _ready(entry)

    def _make(self, words, function, args, kwargs) -> Entry | None:
        leaves, tree = jax.tree.flatten((args, kwargs))
        structure = []

        def flat(*arrays):
            rest = iter(arrays)
            filled = [next(rest) if _is_array(leaf) else leaf for leaf in leaves]
            called, named = jax.tree.unflatten(tree, filled)
            results, around = jax.tree.flatten(function(*called, **named))
            numbers = iter(range(len(results)))
            structure.append(
                jax.tree.unflatten(around, [_Array(next(numbers)) if _is_array(r) else r for r in results])
            )
            return [result for result in results if _is_array(result)]

        try:
            made = export.export(jax.jit(flat))(*(leaf for leaf in leaves if _is_array(leaf)))
            entry = Entry(words, pickle.dumps(structure[-1]), bytes(made.serialize()))
        except Exception:  # it cannot be exported; a mistake of its own is met again when it is compiled
            return None
        if export.deserialize(bytearray(entry.exported)).mlir_module() != made.mlir_module():
            return None
        if code_digest(self._package) == self._code:  # else somebody edits it while this runs
            self._entries.write(entry)
        return entry


def _ready(entry: Entry) -> _Ready:
    exported = export.deserialize(bytearray(entry.exported))
    run = jax.jit(exported.call) if exported.out_avals else _nothing
    return _Ready(run, pickle.loads(entry.structure))


def _nothing(*arrays: Any) -> tuple[()]:
    """What a program computes whose result has no arrays: it is known when it is traced."""
    return ()


def _is_array(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array | np.ndarray | np.generic)


def _kind(leaf: Any) -> Any:
    """An array's shape and type; anything else itself, with its type, since 1 is equal to True."""
    if _is_array(leaf):
        return leaf.shape, leaf.dtype, getattr(leaf, "weak_type", False), type(leaf)
    return type(leaf), leaf
