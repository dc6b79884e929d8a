"""Search for the hyperparameters of one model for all participants, by L-BFGS-B in unconstrained coordinates."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float

from hilbo.hyperparameters.coordinates import Coordinates
from hilbo.ordinal_gp import OrdinalGP

__all__ = ["Cost", "End", "Maximum", "descended", "ran_away"]

_STEPS = 200
_NEAR = 1e-3  # nats that a step must gain for another
_RUNAWAY = 6.9  # a factor of 1000: largest change of a hyperparameter that counts as a maximum


class Maximum(NamedTuple):
    """Model with the hyperparameters that maximise an evidence with weak priors, and the outcome of the search.

    `log_evidence` is without the weak priors, `log_evidence_before` that of the model where the search started;
    `steps`: evaluations of the evidence; `runaway`: a hyperparameter changed by more than a factor 1000.
    """

    gp: OrdinalGP
    log_evidence: float
    log_evidence_before: float
    steps: int
    converged: bool
    runaway: bool


def ran_away(moved: Coordinates) -> bool:
    """Whether a hyperparameter changed by more than a factor 1000, from the changes of all coordinates; the lowest
    threshold, which is no logarithm, does not count.
    """
    return any(bool(np.any(np.abs(np.asarray(v)) > _RUNAWAY)) for name, v in moved.items() if name != "first")


class Cost(NamedTuple):
    """Minus log evidence and log prior at some coordinates, its gradient (p,), the log evidence, and whether all fits
    converged.
    """

    value: Float[Array, ""]
    gradient: Float[Array, " p"]
    log_evidence: Float[Array, ""]
    converged: Bool[Array, ""]


class End(NamedTuple):
    """End of one search: the lowest cost that it met, its coordinates and log evidence, evaluations, whether it
    converged with all fits, and the log evidence where it started (`first`).
    """

    cost: float
    place: Float[np.ndarray, " p"]
    log_evidence: float
    steps: int
    converged: bool
    first: float


def descended(
    cost: Callable[[Float[np.ndarray, " p"]], Cost],
    begin: Float[np.ndarray, " p"],
    bounds: list[tuple[float, float]] | None = None,
) -> End:
    """Minimise a cost by L-BFGS-B from `begin` (p,), within `bounds`.

    A cost or gradient that is not finite ends the search, which then has not converged; the cost is infinite if it was
    so at the start.
    """
    from scipy.optimize import minimize  # a fifth of a second, which commands that learn nothing need not wait

    best = End(np.inf, begin, -np.inf, 0, False, -np.inf)

    def evaluated(place: Float[np.ndarray, " p"]) -> tuple[float, Float[np.ndarray, " p"]]:
        nonlocal best
        here = cost(place)
        value, slope, steps = float(here.value), np.asarray(here.gradient, float), best.steps + 1
        best = best._replace(steps=steps, first=float(here.log_evidence) if steps == 1 else best.first)
        if not (np.isfinite(value) and np.all(np.isfinite(slope))):
            raise _NotFiniteError
        if value < best.cost:
            best = End(value, place.copy(), float(here.log_evidence), steps, bool(here.converged), best.first)
        return value, slope

    try:
        start = evaluated(begin)
        options = {"maxiter": _STEPS, "ftol": _NEAR / max(1.0, abs(start[0])), "gtol": 1e-3}  # a part of the cost

        def once(place: Float[np.ndarray, " p"]) -> tuple[float, Float[np.ndarray, " p"]]:
            return start if np.array_equal(place, begin) else evaluated(place)

        end = minimize(once, begin, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
        ended = bool(end.success)
    except _NotFiniteError:  # L-BFGS-B would take an infinite cost for its end
        ended = False
    return best._replace(converged=best.converged and ended)


class _NotFiniteError(Exception):
    """Raised within a descent where the cost, or its gradient, is not finite."""
