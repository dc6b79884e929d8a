"""Search for the hyperparameters of one model for all participants, by L-BFGS-B in unconstrained coordinates."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float

from hilbo.hyperparameters.coordinates import Coordinates
from hilbo.numerics.descent import Point, descended
from hilbo.ordinal_gp import OrdinalGP

__all__ = ["Cost", "End", "Maximum", "ran_away", "searched"]

_STEPS = 200
_NEAR = 1e-3  # nats that a step must gain for another
_RUNAWAY = 6.9  # a factor of 1000: largest change of a hyperparameter that counts as a maximum


class Maximum(NamedTuple):
    """Model with the hyperparameters that maximise an evidence with weak priors, and the outcome of the search.

    `log_evidence` is without the weak priors, `log_evidence_before` that of the model where the search started;
    `steps`: of L-BFGS-B; `runaway`: a hyperparameter changed by more than a factor 1000.
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
    """End of one search: the lowest cost that it met, its coordinates and log evidence, whether it converged with all
    fits, number of steps, and the log evidence where it started (`first`).
    """

    cost: float
    place: Float[np.ndarray, " p"]
    log_evidence: float
    converged: bool
    steps: int = 0
    first: float = -np.inf


def searched(
    cost: Callable[[Float[np.ndarray, " p"]], Cost],
    begin: Float[np.ndarray, " p"],
    bounds: list[tuple[float, float]] | None = None,
) -> End:
    """Minimise a cost from `begin` (p,), within `bounds`. It has not converged if a cost was not finite."""

    def point(place: Float[np.ndarray, " p"]) -> Point[End]:
        here = cost(place)
        value = float(here.value)
        end = End(value, place.copy(), float(here.log_evidence), bool(here.converged))
        return Point(value, np.asarray(here.gradient, float), end)

    start = point(begin)
    end = descended(point, begin, start, _NEAR, bounds, most=_STEPS)
    lowest = end.lowest
    return lowest._replace(converged=lowest.converged and end.ended, steps=end.steps, first=start.aux.log_evidence)
