"""Friction laws of a free device: terms in the speed v in addition to damping and Coulomb friction.

    viscous + Coulomb              b·v + c
    viscous + Coulomb + quadratic  b·v + c + d·v²                    drag, a motor's losses
    viscous + Coulomb + Stribeck   b·v + c + s·exp(-(v/v_s)^δ)       a lubricated contact; δ is 1 or 2

If a device of the second kind is fitted by the first law, its damping is overestimated at the speeds of a hand, which
is unsafe: passivity depends on b. A law is *refuted* if additional terms are significant by a Wald test that is
clustered by period. The additional terms are two that are quadratic and cubic in the logarithm of the speed.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

__all__ = ["LAWS", "Blocks", "Law", "candidates", "refuted"]

_LEVEL = 0.002  # significance level of the test of a law
_SPEEDS = np.geomspace(4.0, 60.0, 9)  # candidate v_s, mm/s
LAWS = ("viscous + Coulomb", "viscous + Coulomb + quadratic", "viscous + Coulomb + Stribeck")


class Law(NamedTuple):
    """Friction law: name, term (n,) that it adds for each sweep (None for the first law), and v_s (mm/s) of that."""

    name: str
    term: Float[np.ndarray, " n"] | None
    speed: float | None = None


class Blocks(NamedTuple):
    """Least-squares problem of `force` (n,) on `terms` (n, p); errors correlate within a `period` (n,), 0 … P-1."""

    terms: Float[np.ndarray, "n p"]
    force: Float[np.ndarray, " n"]
    period: np.ndarray

    def with_term(self, law: Law) -> "Blocks":
        """Copy with the additional term of a law as the last column; the object itself for a law without one."""
        return self if law.term is None else self._replace(terms=np.column_stack([self.terms, law.term]))

    @property
    def best(self) -> Float[np.ndarray, " p"]:
        """Least-squares estimate. (p,)."""
        return np.linalg.lstsq(self.terms, self.force, rcond=None)[0]

    @property
    def left(self) -> Float[np.ndarray, " n"]:
        """Residuals, N. (n,)."""
        return self.force - self.terms @ self.best

    def covariance(self) -> Float[np.ndarray, "p p"]:
        """Cluster-robust covariance of the estimate by period, corrected for few clusters (CR2 to first order).

        (p, p).
        """
        count, free = self.period.max() + 1, self.terms.shape[1]
        scores = np.zeros((count, free))
        np.add.at(scores, self.period, self.terms * self.left[:, None])
        bread = np.linalg.inv(self.terms.T @ self.terms)
        return count / (count - free) * bread @ scores.T @ scores @ bread


def candidates(speed: Float[np.ndarray, " n"], way: Float[np.ndarray, " n"]) -> Iterator[Law]:
    """Yield the candidate laws for sweeps, simplest first; the third with δ = 1 and 2 and several v_s.

    `speed` (mm/s) > 0 and direction `way` (1 or -1) of each sweep.
    """
    yield Law(LAWS[0], None)
    yield Law(LAWS[1], way * (speed / 1e3) ** 2)
    for sharpness in (1, 2):
        for scale in _SPEEDS:
            yield Law(LAWS[2], way * np.exp(-((speed / scale) ** sharpness)), float(scale))


def refuted(blocks: Blocks, speed: Float[np.ndarray, " n"], way: Float[np.ndarray, " n"]) -> bool:
    """Whether the sweeps reject the law whose terms are in `blocks`, at a significance of 0.002.

    They do if terms quadratic and cubic in the logarithm of the `speed` (mm/s) are significant on top of it. `way`:
    direction of each sweep, 1 or -1.
    """
    log_speed = np.log(speed / np.median(speed))
    free = way[:, None] * np.stack([log_speed**2, log_speed**3], axis=1)
    extended = blocks._replace(terms=np.hstack([blocks.terms, free]))
    return wald(extended, free.shape[1]) < _LEVEL


def wald(blocks: Blocks, last: int) -> float:
    """p value of the Wald test, clustered by period, that the coefficients of the `last` so many terms are 0."""
    from scipy.stats import f as fisher

    count, free = int(blocks.period.max()) + 1, blocks.terms.shape[1]
    value, covariance = blocks.best[-last:], blocks.covariance()[-last:, -last:]
    return float(fisher.sf(value @ np.linalg.solve(covariance, value) / last, last, count - free))
