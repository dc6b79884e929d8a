"""Who is left out of an analysis: the study's rule, applied to people's own answers before they are aggregated."""

from typing import NamedTuple

import pandas as pd

from hilbo.errors import InputError
from hilbo.population.judged.response_quality import excluded, measure_people
from hilbo.study.cohort import Cohort
from hilbo.study.config import Study

__all__ = ["Included", "exclusion_sentences", "included"]


class Included(NamedTuple):
    """Whose answers are aggregated."""

    cohort: Cohort
    people: pd.DataFrame
    """Everybody's measures (`response_quality.measure_people`), those left out too."""
    left_out: dict[str, str]
    """Who was left out, and why."""


def included(study: Study, everybody: Cohort) -> Included:
    """The cohort without those whom the study's rule leaves out. Raises `InputError` if it leaves nobody."""
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
    """Who was left out by [study] exclude, in a sentence; nothing where nobody was."""
    if not left_out:
        return []
    who = "; ".join(f"{name} ({why.partition(', and')[0]})" for name, why in left_out.items())
    return [f'[study] exclude = "{study.file.exclude}" leaves out {len(left_out)}: {who}.']
