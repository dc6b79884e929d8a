"""Minimisation of a smooth function of a few variables by L-BFGS-B, with a record of the best point met."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from jaxtyping import Float

__all__ = ["Descent", "Point", "descended"]

_T = TypeVar("_T")


@dataclass(frozen=True)
class Point(Generic[_T]):
    """Value and gradient (p,) of the function at some variables, and what else was computed there (`aux`)."""

    value: float
    gradient: Float[np.ndarray, " p"]
    aux: _T


@dataclass(frozen=True)
class Descent(Generic[_T]):
    """Outcome of a descent: `aux` of the lowest point met, number of steps, and whether L-BFGS-B converged."""

    lowest: _T
    steps: int
    ended: bool


def descended(
    function: Callable[[Float[np.ndarray, " p"]], Point[_T]],
    begin: Float[np.ndarray, " p"],
    first: Point[_T],
    near: float,
    bounds: list[tuple[float, float]] | None = None,
    *,
    most: int = 100,
    remembered: int = 10,
) -> Descent[_T]:
    """Minimise by L-BFGS-B within `bounds`, from `begin` (p,), where the function is `first` and not evaluated again.

    Returns the lowest point's `aux`, not its coordinates.

    **Arguments:** `near`: decrease that a step must reach for another; `most`: steps; `remembered`: steps from which
    the curvature is estimated. A value or gradient that is not finite ends the descent, which then has not converged.
    """
    from scipy.optimize import minimize  # a fifth of a second, which commands that learn nothing need not wait

    lowest, steps = first, 0

    def evaluated(x: Float[np.ndarray, " p"]) -> tuple[float, Float[np.ndarray, " p"]]:
        nonlocal lowest
        here = first if np.array_equal(x, begin) else function(x)
        if not (np.isfinite(here.value) and np.all(np.isfinite(here.gradient))):
            raise _NotFiniteError
        if here.value < lowest.value:
            lowest = here
        return here.value, here.gradient

    def count(_: object) -> None:
        nonlocal steps
        steps += 1

    relative = near / max(1.0, abs(first.value))  # SciPy's is a part of the value
    options = {"maxiter": most, "ftol": relative, "gtol": 1e-3, "maxcor": remembered}
    try:
        end = minimize(evaluated, begin, jac=True, method="L-BFGS-B", bounds=bounds, callback=count, options=options)
        ended = bool(end.success)
    except _NotFiniteError:  # L-BFGS-B does not turn back where the value is infinite: it would report convergence
        ended = False
    return Descent(lowest.aux, steps, ended)


class _NotFiniteError(Exception):
    """Raised within a descent where the value, or the gradient, is not finite."""
