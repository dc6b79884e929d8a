"""Tools that tests share: derivatives against finite differences, and how often a function is compiled."""

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import jax
import jax.numpy as jnp
import numpy as np

__all__ = ["assert_traces_once", "check_grad"]


def check_grad(fn: Callable, *args, rtol: float = 1e-6, atol: float = 0.0) -> None:
    """Assert that the derivatives of `fn` by forward and by reverse mode agree with central differences.

    `fn` maps one or more float64 arrays to one array. The entries of an argument are moved by eps^(1/3) times the
    argument's scale, its largest |entry| (1 if all are 0), where truncation and rounding cost about the same, 1e-10.
    Errors of one argument's Jacobian are held against `atol + rtol * |its largest entry|`.
    """
    args = tuple(jnp.asarray(arg) for arg in args)
    wrong = {str(arg.dtype) for arg in (*args, jax.eval_shape(fn, *args))} - {"float64"}
    assert not wrong, f"finite differences need float64, not {', '.join(sorted(wrong))}"
    places = tuple(range(len(args)))
    derivatives = zip(jax.jacfwd(fn, places)(*args), jax.jacrev(fn, places)(*args), strict=True)
    for place, (forward, reverse) in enumerate(derivatives):
        expected = _central_differences(fn, args, place)
        bound = atol + rtol * np.max(np.abs(expected), initial=0.0)
        for mode, found in (("jacfwd", forward), ("jacrev", reverse)):
            np.testing.assert_allclose(found, expected, rtol=0, atol=bound, err_msg=f"{mode}, argument {place}")


def _central_differences(fn: Callable, args: tuple, place: int) -> np.ndarray:
    """Jacobian of `fn` in one of its arguments, of shape (shape of the value) + (shape of the argument)."""
    base = np.asarray(args[place])
    step = np.finfo(base.dtype).eps ** (1 / 3) * (np.max(np.abs(base), initial=0.0) or 1.0)
    slopes = np.empty((*jax.eval_shape(fn, *args).shape, *base.shape))
    for index in np.ndindex(base.shape):
        above, below = base.copy(), base.copy()
        above[index] += step
        below[index] -= step
        rise = [np.asarray(fn(*args[:place], jnp.asarray(x), *args[place + 1 :])) for x in (above, below)]
        slopes[(..., *index)] = (rise[0] - rise[1]) / (above[index] - below[index])
    return slopes


_traced: Counter[str] = Counter()
_compiled: Counter[str] = Counter()


def _count(event: str, _duration: float, **labels) -> None:
    name = str(labels.get("fun_name", "")).removeprefix("jit(").removesuffix(")")
    if event.endswith("/jaxpr_trace_duration"):
        _traced[name] += 1
    elif event.endswith("/backend_compile_duration"):
        _compiled[name] += 1


jax.monitoring.register_event_duration_secs_listener(_count)


@contextmanager
def assert_traces_once(*functions: Callable) -> Iterator[None]:
    """Assert that each of the jitted functions is traced, and compiled, exactly once inside the block.

    JAX's caches are emptied first, so that it does not matter what other tests compiled and a function that is never
    called cannot pass. Name the functions that are called from outside jit: JAX does not count those within others.
    """
    jax.clear_caches()
    traced, compiled = _traced.copy(), _compiled.copy()
    yield
    for name in (function.__name__ for function in functions):
        counts = (_traced[name] - traced[name], _compiled[name] - compiled[name])
        assert counts == (1, 1), f"{name}: traced {counts[0]} times and compiled {counts[1]} times, not once"
