"""Rows of a table against the equalities of a study, such as the shares of a mixture that add up to 100 %."""

from collections.abc import Mapping

import numpy as np
import pandas as pd
from jaxtyping import Float

from hilbo.search.box import Constraint
from hilbo.search.equality import unbalanced
from hilbo.study.file.reading import StudyFile
from hilbo.study.formats.csv_file import refuse

__all__ = ["check_equalities"]


def check_equalities(table: Mapping[str, object], index: pd.Index, study: StudyFile, source: str) -> None:
    """Raise InputError for the first row whose parameters do not satisfy an equality of the study, to the rounding of
    its cells and the tolerances of [stimulus]. `table`: parameter -> values of the rows `index`; `source`: for the
    message."""
    for constraint in (c for c in study.space.constraints if c.equality):
        values = {name: np.asarray(table[name], float) for name, _ in constraint.terms}
        total, wrong = unbalanced(constraint, values, _tolerated(constraint, values, study))
        sums, words = pd.Series(total, index), f"it must be {constraint.least:g} in this study"
        refuse(
            pd.Series(wrong, index),
            source,
            lambda row, c=constraint, s=sums, w=words: f"{c.sum_words} is {s.at[row]:.6g}; {w}.",
        )


def _tolerated(
    constraint: Constraint, values: Mapping[str, Float[np.ndarray, " n"]], study: StudyFile
) -> Float[np.ndarray, " n"]:
    """Differences (n,) of a constraint's sum that confirmed values within the tolerances of [stimulus] may have."""
    size = len(next(iter(values.values())))
    if study.stimulus is None:
        return np.zeros(size)
    parameters = {p.name: p for p in study.space.parameters}
    each = (
        abs(weight)
        * study.stimulus.tolerance_of(parameters[name])
        * (np.abs(values[name]) if parameters[name].scale == "log" else np.ones(size))
        for name, weight in constraint.terms
    )
    return sum(each, np.zeros(size))
