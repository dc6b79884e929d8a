"""Exclusion of participants: the study's rule, applied to each participant's response quality before aggregation."""

from typing import NamedTuple

import pandas as pd

from hilbo.errors import InputError
from hilbo.population.judged.response_quality import excluded, measure_people
from hilbo.study.cohort import Cohort
from hilbo.study.config import Study

__all__ = ["Included", "exclusion_sentences", "included"]


class Included(NamedTuple):
    """Participants that are aggregated, and those excluded."""

    cohort: Cohort
    people: pd.DataFrame
    """Response quality of all participants (`response_quality.measure_people`), also of those excluded."""
    left_out: dict[str, str]
    """Excluded participant -> reason."""


def included(study: Study, everybody: Cohort) -> Included:
    """Apply the study's exclusion rule to a cohort; computes the response quality of every participant. Raises
    `InputError` if no participant is left."""
    people = measure_people(study.gp, everybody.trials, everybody.names)
    left_out = excluded(people, study.file.exclude)
    if len(left_out) == len(everybody.names):
        raise InputError(
            f'the rule "{study.file.exclude}" leaves out all {len(left_out)} participants; there is nothing to'
            " aggregate."
        )
    cohort = everybody.of([name for name in everybody.names if name not in left_out]) if left_out else everybody
    return Included(cohort, people, left_out)


def exclusion_sentences(study: Study, left_out: dict[str, str]) -> list[str]:
    """One sentence that lists the excluded participants with the reason (`left_out`: id -> reason), or an empty
    list."""
    if not left_out:
        return []
    who = "; ".join(f"{name} ({why.partition(', and')[0]})" for name, why in left_out.items())
    return [f'[study] exclude = "{study.file.exclude}" leaves out {len(left_out)}: {who}.']
