"""What result.json has of each participant, for any number of participants.

Parameter sets and passivity margins of all participants are computed together; their entries are made one at a time
while the file is written, since a hundred thousand of them as Python objects would take more memory than the fits.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float

from hilbo.numerics.tracing import program
from hilbo.search.rendering import derived_of
from hilbo.study.config import Study

__all__ = ["People", "parameter_sets", "people_of"]

_TOGETHER = 4096  # sets whose mechanics are computed at once


class People(NamedTuple):
    """The participants of result.json as columns; `entries` makes their entries one at a time.

    `names` (M), `trials` (M,) numbers of responses, `certificate`: diagnostics (M,) by name, `labels`: of the
    responses; `optima`: fields of the individual optima, `sets`: their parameters in physical units by name (M,),
    `margins`: their passivity margins (M,), N·s/m. The last three are None if individual optima were not computed,
    `margins` also without mechanics.
    """

    names: Sequence[str]
    trials: np.ndarray
    certificate: dict[str, np.ndarray]
    labels: tuple[str, ...]
    optima: dict[str, np.ndarray] | None
    sets: dict[str, np.ndarray] | None
    margins: np.ndarray | None

    def entries(self) -> Iterator[dict[str, Any]]:
        """Entries of the participants for result.json, made one after the other: name, number of trials, optimum and
        certificate. The optimum is None if individual optima were not computed.
        """
        for j, name in enumerate(self.names):
            yield {
                "participant": name,
                "trials": int(self.trials[j]),
                "optimum": self._optimum(j),
                "certificate": {key: values[j].item() for key, values in self.certificate.items()},
            }

    def _optimum(self, j):
        """Optimum of participant j (row) for result.json; None if individual optima were not computed."""
        if self.optima is None or self.sets is None:
            return None
        chances = self.optima["class_probabilities"][j].tolist()
        return {
            "parameters": {name: values[j].item() for name, values in self.sets.items()},
            "unit": self.optima["x"][j].tolist(),
            "mean": float(self.optima["mean"][j]),
            "sd": float(self.optima["sd"][j]),
            "class_probabilities": dict(zip(self.labels, chances, strict=True)),
            "passivity_margin": None if self.margins is None else float(self.margins[j]),
        }

    def table(self) -> pd.DataFrame:
        """The rows of optima.csv for individual optima: `source` "individual:NAME" and the parameters; an empty table
        if they were not computed.
        """
        if self.sets is None:
            return pd.DataFrame()
        return pd.DataFrame({"source": [f"individual:{name}" for name in self.names]} | self.sets)


def people_of(study: Study, aggregate: Any) -> People:
    """The participants of an `Aggregate`, with parameter sets and margins of their individual optima where it has
    these.
    """
    individuals = aggregate.own
    sets, margins = (None, None) if individuals is None else parameter_sets(study, np.asarray(individuals.x))
    cohort = aggregate.cohort
    optima = (
        None
        if individuals is None
        else {name: np.asarray(getattr(individuals, name)) for name in individuals.__dataclass_fields__}
    )
    return People(cohort.names, cohort.counts(), aggregate.certificates, study.responses, optima, sets, margins)


def parameter_sets(study: Study, x: Float[np.ndarray, "M d"]) -> tuple[dict[str, np.ndarray], np.ndarray | None]:
    """Points (M, d) of the unit cube as parameter sets in physical units, and their passivity margins (M,), N·s/m.

    The sets are columns (M,) by name, derived K0 first, levels by their names. The margins are None without mechanics.
    """
    if len(x) > _TOGETHER:
        padded = np.concatenate([x, np.repeat(x[-1:], -len(x) % _TOGETHER, axis=0)])  # one compilation
        parts = [parameter_sets(study, block) for block in padded.reshape(-1, _TOGETHER, x.shape[1])]
        sets = {name: np.concatenate([block[0][name] for block in parts])[: len(x)] for name in parts[0][0]}
        block_margins = [margin for _, margin in parts if margin is not None]
        return sets, np.concatenate(block_margins)[: len(x)] if block_margins else None
    physical, derived, margins = _mechanics(study.space, x)
    values = np.asarray(physical)
    named = {p.name: np.asarray(p.column(values[:, i])) for i, p in enumerate(study.space.parameters)}
    return {name: np.asarray(v) for name, v in derived.items()} | named, None if margins is None else np.asarray(
        margins
    )


@program
def _mechanics(space, x):
    """Physical values (M, d) of points (M, d) of the unit cube, derived parameters by name, and margins (M,) or
    None.
    """
    physical = space.to_physical(x)
    return physical, *derived_of(space, physical)
