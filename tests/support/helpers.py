"""Tools that tests share: derivatives against finite differences, how often a function is compiled, and fits of the
data sets with what is wrong about them."""

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import jax
import jax.numpy as jnp
import numpy as np
from datasets import Dataset

from hilbo import RBF, OrdinalGP, OrdinalProbit, Trials, fit
from hilbo.ordinal_gp import InferenceError

__all__ = ["answers", "assert_traces_once", "check_grad", "complaint", "model", "unchecked"]


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
    modes = jax.jit(lambda *args: (jax.jacfwd(fn, places)(*args), jax.jacrev(fn, places)(*args)))(*args)
    compiled = jax.jit(fn)
    for place, (forward, reverse) in enumerate(zip(*modes, strict=True)):
        expected = _central_differences(compiled, args, place)
        bound = atol + rtol * np.max(np.abs(expected), initial=0.0)
        for mode, derivative in (("jacfwd", forward), ("jacrev", reverse)):
            np.testing.assert_allclose(derivative, expected, rtol=0, atol=bound, err_msg=f"{mode}, argument {place}")


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


def model(data: Dataset, dtype: type = np.float64) -> OrdinalGP:
    """The model with the hyperparameters of a data set."""
    likelihood = OrdinalProbit(np.asarray(data.thresholds, dtype), dtype(data.noise))
    return OrdinalGP(RBF(np.asarray(data.theta, dtype), dtype(data.variance)), likelihood)


def answers(data: Dataset, capacity: int = 25, dtype: type = np.float64) -> Trials:
    """Its answers, padded."""
    return Trials.from_arrays(data.x.astype(dtype), data.q, capacity)


def complaint(case: Dataset, dtype: type, inference: str = "laplace") -> str:
    """What is wrong with a fit of the case; nothing if it converged to sense, or failed and said so in float32."""
    gp, trials = model(case, dtype), answers(case, 25 if len(case.q) <= 25 else 200, dtype)
    posterior = fit(gp, trials, inference=inference, throw=False)
    certificate = posterior.certificate
    if not certificate.converged:
        try:
            fit(gp, trials, inference=inference)
        except InferenceError as error:
            wrong = "" if f"{float(certificate.residual):.3g}" in str(error) else f"a message without figures: {error}"
        else:
            wrong = "not converged, and not raised"
        return wrong or ("not converged in float64" if dtype is np.float64 else "")
    mean, variance = map(np.asarray, posterior.predict(jnp.asarray(case.x_new.astype(dtype))))
    slack = 10 * float(certificate.variance_resolution)
    checks = {
        "a value that is not finite": all(np.all(np.isfinite(v)) for v in (mean, variance, posterior.log_evidence)),
        "a variance outside 0 and the prior": np.all((variance >= -slack) & (variance <= case.variance * (1 + 1e-6))),
        "a positive log evidence": posterior.log_evidence <= slack,
        "a residual above its tolerance": certificate.residual <= certificate.tolerance,
        "a residual that bounds nothing": certificate.residual <= np.finfo(dtype).eps ** 0.25,
        "jitter": certificate.jitter <= (1e-13 if dtype is np.float64 else 2e-4),
    }
    return ", ".join(name for name, good in checks.items() if not good)


def unchecked(thresholds, noise) -> OrdinalProbit:
    """A likelihood of any values, made within a program, where values are not looked at."""
    return jax.jit(OrdinalProbit)(jnp.asarray(thresholds), jnp.asarray(noise))
