"""Tools that tests share: derivatives against finite differences, and how often a function was traced."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import jax
import jax.numpy as jnp
import numpy as np

__all__ = ["assert_traces_once", "check_grad"]


def check_grad(fn: Callable, *args, rtol: float = 1e-6, atol: float = 0.0) -> None:
    """Assert that the derivatives of `fn` by forward and by reverse mode agree with central differences.

    `fn` maps one or more float64 arrays to one array; each entry of each argument is moved by eps^(1/3) times its
    scale max(1, |entry|), where the errors of truncation and of rounding are about equal (1e-10 relative).
    Errors are measured per entry of the Jacobian against `atol + rtol * max(1, |its largest entry|)`.
    """
    args = tuple(jnp.asarray(arg) for arg in args)
    wrong = [arg.dtype for arg in (*args, jax.eval_shape(fn, *args)) if arg.dtype != jnp.float64]
    assert not wrong, f"finite differences need float64, not {wrong}"
    places = tuple(range(len(args)))
    forward, reverse = jax.jacfwd(fn, places)(*args), jax.jacrev(fn, places)(*args)
    for place, (by_jvp, by_vjp) in enumerate(zip(forward, reverse, strict=True)):
        expected = _central_differences(fn, args, place)
        bound = atol + rtol * max(1.0, np.max(np.abs(expected), initial=0.0))
        for mode, found in (("jacfwd", by_jvp), ("jacrev", by_vjp)):
            message = f"{mode} of argument {place}"
            np.testing.assert_allclose(found, expected, rtol=0, atol=bound, err_msg=message)


def _central_differences(fn: Callable, args: tuple, place: int) -> np.ndarray:
    """Jacobian of `fn` in one of its arguments, of shape (shape of the value) + (shape of the argument)."""
    base = np.asarray(args[place], np.float64)
    columns = []
    for index in np.ndindex(base.shape):
        step = np.finfo(np.float64).eps ** (1 / 3) * max(1.0, abs(base[index]))
        above, below = base.copy(), base.copy()
        above[index] += step
        below[index] -= step
        values = [np.asarray(fn(*args[:place], jnp.asarray(x), *args[place + 1 :])) for x in (above, below)]
        columns.append((values[0] - values[1]) / (above[index] - below[index]))
    value_shape = jax.eval_shape(fn, *args).shape
    return np.stack(columns, axis=-1).reshape(value_shape + base.shape) if columns else np.zeros((*value_shape, 0))


@contextmanager
def assert_traces_once(*functions: Callable) -> Iterator[None]:
    """Assert that each function made by `jax.jit` is traced at most once inside the block.

    Counts the new entries of the function's own cache, so that what earlier tests compiled does not matter;
    a function that was already compiled for the same shapes gains none.
    """
    before = [function._cache_size() for function in functions]
    yield
    for function, size in zip(functions, before, strict=True):
        name = getattr(function, "__name__", repr(function))
        assert function._cache_size() - size <= 1, f"{name} was traced {function._cache_size() - size} times"
