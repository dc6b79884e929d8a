"""Stimuli against the equalities of a study, such as the shares of a mixture that add up to 100 %."""

from collections.abc import Iterator, Mapping

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float

from hilbo.search.box import Constraint
from hilbo.search.equality import unbalanced
from hilbo.study.file.reading import StudyFile
from hilbo.study.formats.csv_file import refuse

__all__ = ["broken_equality", "check_equalities"]


def check_equalities(table: Mapping[str, object], index: pd.Index, study: StudyFile, source: str) -> None:
    """Raise InputError for the first row whose parameters do not satisfy an equality of the study, to the rounding of
    its cells and the tolerances of [stimulus]. `table`: parameter -> values of the rows `index`; `source`: for the
    message."""
    for constraint, total, wrong in _sums(table, study):
        sums = pd.Series(total, index)
        refuse(pd.Series(wrong, index), source, lambda row, c=constraint, s=sums: _sentence(c, s.at[row]))


def broken_equality(stimulus: Mapping[str, float], study: StudyFile) -> str | None:
    """Sentence on the first equality of the study that a stimulus (parameter -> number) does not satisfy, to the same
    differences as in `check_equalities`; None if it satisfies all."""
    sums = _sums({name: np.array([value]) for name, value in stimulus.items()}, study)
    return next((_sentence(constraint, total) for constraint, (total,), (wrong,) in sums if wrong), None)


def _sums(
    table: Mapping[str, object], study: StudyFile
) -> Iterator[tuple[Constraint, Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]]:
    """Each equality of the study with its sums (n,) in the rows of `table`, and which of them are wrong (n,)."""
    for constraint in (c for c in study.space.constraints if c.equality):
        values = {name: np.asarray(table[name], float) for name, _ in constraint.terms}
        yield constraint, *unbalanced(constraint, values, _tolerated(constraint, values, study))


def _sentence(constraint: Constraint, total: float) -> str:
    """Sentence on a sum that differs from the equality's."""
    return f"{constraint.sum_words} is {total:.6g}; it must be {constraint.least:g} in this study."


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
