"""Parameter sets of the paper, classical models as special cases of the FO-SLS, and the load histories of the tests.

    spring          F = K·x                                  K0 = K, K1 = 0
    spring-pot      F = B·d^α x                              K0 = 0, K1 = inf
    Kelvin-Voigt    F = K·x + B·dx/dt                        K0 = K, K1 = inf, α = 1
    Maxwell         spring and dashpot in series             K0 = 0, α = 1
    SLS             Maxwell parallel to a spring             α = 1

All of them run through the same code as the FO-SLS, so that models of growing complexity can be compared. Units: N/mm,
N·s^α/mm, s, mm, N.
"""

from typing import NamedTuple

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float, Real

from hilbo.mechanics.fosls import FOSLS

__all__ = [
    "PRESETS",
    "Preset",
    "creep_load",
    "kelvin_voigt",
    "maxwell",
    "relaxation_load",
    "sls",
    "spring",
    "springpot",
]


class Preset(NamedTuple):
    """Published parameter set with its N, T and source."""

    K0: float
    K1: float
    B1: float
    alpha: float
    N: int
    T: float
    source: str

    def model(self) -> FOSLS:
        """The set as an `FOSLS` with short memory."""
        return FOSLS(*self[:4], N=self.N, T=self.T)


_PAPER = "Active Learning of Fractional-Order Viscoelastic Model Parameters for Realistic Haptic Rendering"
PRESETS = {
    "memory foam, system identification": Preset(
        -2.89, 5.70, 5.89, 0.203, 101, 1e-3, f"{_PAPER}, section on the characterisation of reference materials"
    ),
    "memory foam, aggregate": Preset(
        -3.18, 5.58, 7.88, 0.176, 101, 1e-3, f"{_PAPER}, table of system identification against aggregate parameters"
    ),
    "memory foam, average of individuals": Preset(
        -5.01, 8.44, 10.28, 0.282, 101, 1e-3, f"{_PAPER}, mean of the individually optimised parameters"
    ),
}
"""Memory foam; with short memory only, because K0 < 0."""


def spring(K: Real[ArrayLike, ""], **memory) -> FOSLS:
    """Spring F = K·x. K in N/mm, a scalar; `memory`: N, T, memory and states of the `FOSLS`."""
    return FOSLS(K, 0.0, 0.0, 1.0, **memory)


def springpot(B: Real[ArrayLike, ""], alpha: Real[ArrayLike, ""], **memory) -> FOSLS:
    """Spring-pot F = B·d^α x/dt^α. B in N·s^α/mm and `alpha` are scalars; `memory` as in `spring`."""
    return FOSLS(0.0, np.inf, B, alpha, **memory)


def kelvin_voigt(K: Real[ArrayLike, ""], B: Real[ArrayLike, ""], **memory) -> FOSLS:
    """Kelvin-Voigt model: spring and dashpot in parallel. K in N/mm, B in N·s/mm, scalars; `memory` as in `spring`."""
    return FOSLS(K, np.inf, B, 1.0, **memory)


def maxwell(K: Real[ArrayLike, ""], B: Real[ArrayLike, ""], **memory) -> FOSLS:
    """Maxwell model: spring and dashpot in series. K in N/mm, B in N·s/mm, scalars; `memory` as in `spring`."""
    return FOSLS(0.0, K, B, 1.0, **memory)


def sls(K0: Real[ArrayLike, ""], K1: Real[ArrayLike, ""], B: Real[ArrayLike, ""], **memory) -> FOSLS:
    """Standard linear solid: Maxwell model parallel to a spring K0.

    K0 and K1 in N/mm, B in N·s/mm, scalars; `memory` as in `spring`.
    """
    return FOSLS(K0, K1, B, 1.0, **memory)


def relaxation_load(T: float = 1e-3, *, depth: float = 5.0, hold: float = 3.0) -> Float[np.ndarray, " n"]:
    """Positions (mm) of the paper's stress relaxation: constant `depth` from the first sample on, for `hold` seconds.

    -> (hold / T,), rounded; T in s, `depth` in mm.
    """
    return np.full(round(hold / T), depth)


def creep_load(
    T: float = 1e-3, *, force: float = 3.0, hold: float = 3.0, rest: float = 0.5, recovery: float = 3.0
) -> Float[np.ndarray, " n"]:
    """Forces (N) of the paper's creep with recovery: `force` for `hold` seconds, then `rest` for `recovery` seconds.

    `rest` is a force (N), not a time. -> (hold / T + recovery / T,), each rounded; T in s.
    """
    return np.repeat([force, rest], [round(hold / T), round(recovery / T)])
