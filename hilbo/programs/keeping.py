"""Cache of compiled programs that a command installs (`numerics.tracing.keep_with`)."""

import functools
import pickle
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.experimental import serialize_executable
from jax.experimental.compilation_cache import compilation_cache

from hilbo.programs.description import NotKeptError, describe
from hilbo.programs.entries import Entries, Entry
from hilbo.programs.surroundings import code_digest, surroundings

__all__ = ["Programs"]


class _Array(NamedTuple):
    """Placeholder for an array in the structure of a program's result: its position among the arrays."""

    number: int


class _Ready(NamedTuple):
    """Loaded program; `run` maps arrays to arrays, `structure` is the result with placeholders for its arrays."""

    run: Callable
    structure: Any

    def __call__(self, arrays: Sequence[Any]) -> Any:
        """Run the program on the arrays of a call; return the function's result in its own structure."""
        results = self.run(*arrays)
        return jax.tree.map(
            lambda leaf: results[leaf.number] if isinstance(leaf, _Array) else leaf,
            self.structure,
            is_leaf=lambda leaf: isinstance(leaf, _Array),
        )


class Programs:
    """Cache of the compiled programs of a package, stored in `entries`.

    A missing program is traced, compiled, written, and read back; the copy that was read is used if it gives the same
    bits.
    """

    def __init__(self, entries: Entries, package: Path):
        self._entries, self._package = entries, package
        self._code = code_digest(package)
        self._known: dict[Any, _Ready | None] = {}
        self._finding: dict[Any, threading.RLock] = {}  # calls may come from several threads

    @functools.cached_property
    def _around(self) -> str:
        """Part of the key that describes code and environment; computed late, because it initialises JAX's devices."""
        return f"code {self._code}\n{surroundings()}"

    def __call__(
        self, function: Callable, args: tuple, kwargs: dict[str, Any]
    ) -> Callable[[Sequence[Any]], Any] | None:
        """Program of a call as a function of the call's arrays, loaded or compiled now; None if it cannot be cached.

        Programs stay in memory, by function, shapes and other arguments. Calls may come from several threads.
        """
        leaves, tree = jax.tree.flatten((args, kwargs))
        try:
            key = (function, tree, tuple(_kind(leaf) for leaf in leaves))
            if key not in self._known:
                with self._finding.setdefault(key, threading.RLock()):
                    if key not in self._known:
                        self._known[key] = self._find(function, args, kwargs)
        except TypeError:  # an unhashable argument; an error of the call itself is raised again there
            return None
        return self._known[key]

    def _find(self, function, args, kwargs) -> _Ready | None:
        """Load the program from the entries, or compile and write it; None if it cannot be cached.

        That is so with more than one device, or for arguments without a stable description.
        """
        if jax.device_count() > 1:
            return None
        try:
            words = f"{self._around}\n{describe(function, args, kwargs)}"
        except NotKeptError:
            return None
        entry = self._entries.read(words)
        return self._make(words, function, args, kwargs) if entry is None else _ready(entry)

    def _make(self, words, function, args, kwargs) -> _Ready | None:
        """Compile the program, run it, write it to the entries, and return the copy that was read back from its bytes.

        None if serialisation fails or the copy gives other bits. Nothing is written if the package's code has changed
        on disk since this cache was made. `words`: its key.
        """
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

        arrays = [leaf for leaf in leaves if _is_array(leaf)]
        try:
            with _compiled_here:
                compiled = jax.jit(flat).lower(*arrays).compile()
            code, given, returned = serialize_executable.serialize(compiled)
            entry = Entry(words, pickle.dumps((given, returned, structure[-1])), code)
            ready = _ready(entry)
            if _bits(ready.run(*arrays)) != _bits(compiled(*arrays)):
                return None
        except Exception:  # it cannot be written; an error of the function is raised again when it is compiled
            return None
        if code_digest(self._package) == self._code:  # else it is edited while this runs
            self._entries.write(entry)
        return ready


class _CompiledHere:
    """Context in which JAX's own compilation cache is off, for all threads.

    A program that was loaded from that cache and is serialised again lacks functions when it is loaded (jax 0.10).
    """

    def __init__(self):
        self._lock, self._inside, self._enabled = threading.Lock(), 0, True

    def __enter__(self):
        """Switch the cache off, for the first of several threads in the context."""
        with self._lock:
            if self._inside == 0:
                self._enabled = jax.config.jax_enable_compilation_cache  # type: ignore[attr-defined]
                self._set(False)
            self._inside += 1

    def __exit__(self, *_):
        """Restore the cache's setting when the last thread leaves the context; errors pass."""
        with self._lock:
            self._inside -= 1
            if self._inside == 0:
                self._set(self._enabled)

    def _set(self, enabled: bool) -> None:
        """Switch JAX's own compilation cache on or off for the process."""
        jax.config.update("jax_enable_compilation_cache", enabled)
        compilation_cache.reset_cache()  # JAX asks for the setting once


_compiled_here = _CompiledHere()


def _ready(entry: Entry) -> _Ready:
    """Deserialise the program of an entry; it is executable code, so the entry must be trusted."""
    _find_lapack()
    given, returned, structure = pickle.loads(entry.structure)
    return _Ready(serialize_executable.deserialize_and_load(entry.compiled, given, returned), structure)


def _bits(results: Sequence[Any]) -> list[bytes]:
    """Each result as bytes, for comparison; a random key by its data."""
    keys = jax.dtypes.prng_key
    plain = (jax.random.key_data(r) if jax.numpy.issubdtype(r.dtype, keys) else r for r in results)
    return [np.asarray(result).tobytes() for result in plain]


@functools.cache
def _find_lapack() -> None:
    """Register LAPACK's functions with XLA, which JAX does only when it lowers a program that calls them."""
    jax.jit(jax.lax.linalg.cholesky).lower(np.ones((1, 1)))


def _is_array(leaf: Any) -> bool:
    """Whether a leaf is an array of JAX or an array or scalar of NumPy."""
    return isinstance(leaf, jax.Array | np.ndarray | np.generic)


def _kind(leaf: Any) -> Any:
    """Part of the in-memory key for one leaf: shape, dtype, weak type and type of an array; type and value of others.

    The type is included because 1 equals True.
    """
    if _is_array(leaf):
        return leaf.shape, leaf.dtype, getattr(leaf, "weak_type", False), type(leaf)
    return type(leaf), leaf
