"""Which law the friction of a free device follows: terms in the speed v that are added to damping and Coulomb friction.

    viscous + Coulomb              b·v + c
    viscous + Coulomb + quadratic  b·v + c + d·v²                    drag, a motor's losses
    viscous + Coulomb + Stribeck   b·v + c + s·exp(-(v/v_s)^δ)       a lubricated contact; δ is 1 or 2

Fitted by the first, a device of the second kind seems to have more damping than it has at the speeds of a hand, which
is the unsafe side: passivity rests on b. A law is *refuted* where a term that it lacks is not 0: by a Wald test over
periods, whose sweeps err alike. The terms that are tried on every law are two that bend freely with
the logarithm of the speed.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

__all__ = ["LAWS", "Blocks", "Law", "candidates", "refuted"]

_LEVEL = 0.002  # probability to refute a law that holds
_SPEEDS = np.geomspace(4.0, 60.0, 9)  # v_s that are tried, mm/s
LAWS = ("viscous + Coulomb", "viscous + Coulomb + quadratic", "viscous + Coulomb + Stribeck")


class Law(NamedTuple):
    """A law: its name, the term (n,) that it adds for each sweep, None for the first, and the term's v_s (mm/s)."""

    name: str
    term: Float[np.ndarray, " n"] | None
    speed: float | None = None


class Blocks(NamedTuple):
    """Least squares of `force` (n,) on `terms` (n, p), whose errors are alike within a `period` (n,), 0 … P-1."""

    terms: Float[np.ndarray, "n p"]
    force: Float[np.ndarray, " n"]
    period: np.ndarray

    def with_term(self, law: Law) -> "Blocks":
        """The same with the further term of a law."""
        return self if law.term is None else self._replace(terms=np.column_stack([self.terms, law.term]))

    @property
    def best(self) -> Float[np.ndarray, " p"]:
        """The estimate. (p,)."""
        return np.linalg.lstsq(self.terms, self.force, rcond=None)[0]

    @property
    def left(self) -> Float[np.ndarray, " n"]:
        """Residuals, N. (n,)."""
        return self.force - self.terms @ self.best

    def covariance(self) -> Float[np.ndarray, "p p"]:
        """Of the estimate: a sandwich over periods, for few of them (Bell & McCaffrey's CR2 to first order). (p, p)."""
        count, free = self.period.max() + 1, self.terms.shape[1]
        pulls = np.zeros((count, free))
        np.add.at(pulls, self.period, self.terms * self.left[:, None])
        bread = np.linalg.inv(self.terms.T @ self.terms)
        return count / (count - free) * bread @ pulls.T @ pulls @ bread


def candidates(speed: Float[np.ndarray, " n"], way: Float[np.ndarray, " n"]) -> Iterator[Law]:
    """The laws for sweeps with a `speed` (mm/s) in the direction `way` (1 or -1), simplest first."""
    yield Law(LAWS[0], None)
    yield Law(LAWS[1], way * (speed / 1e3) ** 2)
    for sharpness in (1, 2):
        for scale in _SPEEDS:
            yield Law(LAWS[2], way * np.exp(-((speed / scale) ** sharpness)), float(scale))


def refuted(blocks: Blocks, speed: Float[np.ndarray, " n"], way: Float[np.ndarray, " n"]) -> bool:
    """Whether two terms that bend freely with the logarithm of the speed (mm/s) improve on a law."""
    height = np.log(speed / np.median(speed))
    free = way[:, None] * np.stack([height**2, height**3], axis=1)
    more = blocks._replace(terms=np.hstack([blocks.terms, free]))
    return wald(more, free.shape[1]) < _LEVEL


def wald(blocks: Blocks, last: int) -> float:
    """Probability of so large a value of the `last` terms if they are 0."""
    from scipy.stats import f as fisher

    count, free = int(blocks.period.max()) + 1, blocks.terms.shape[1]
    value, covariance = blocks.best[-last:], blocks.covariance()[-last:, -last:]
    return float(fisher.sf(value @ np.linalg.solve(covariance, value) / last, last, count - free))
