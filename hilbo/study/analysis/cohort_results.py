"""What the answers of one cohort say, computed once: the aggregate, how it came about over the trials, the region of
the optimum and the model check.

`hilbo aggregate` writes these. `hilbo.study.analysis.analysis` adds what a report says besides, and takes longer to
import.
"""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

from hilbo.errors import InputError
from hilbo.population.rules.registry import RULES
from hilbo.study.analysis.model_check import model_check
from hilbo.study.analysis.progress import Progress, follow
from hilbo.study.analysis.region import Region, optimum_region
from hilbo.study.cohort import Cohort
from hilbo.study.config import Study
from hilbo.study.estimate.aggregate import Aggregate, SayCount, aggregate_cohort, asked_variance
from hilbo.study.estimate.learnt import resolved
from hilbo.study.estimate.location import location_sentences, optimum_sentence
from hilbo.study.formats.json_file import Content

__all__ = ["CohortResults", "Say", "analyse_cohort"]

Say = Callable[[str], None]


class CohortResults(NamedTuple):
    """What the answers of one cohort say, and how it came about over the trials: what `hilbo aggregate` writes."""

    study: Study
    aggregate: Aggregate
    following: Future[Progress] | None
    """What becomes `progress`: computed beside what is read from the aggregate; None if it was not asked."""
    seed: int
    region: Region | None
    """Where the optimum is, with its probability; None for a map without a joint posterior, and if it was not asked."""
    check: Content | None
    """Whether the model fits (`model_check`); None if it was not asked."""

    @property
    def cohort(self) -> Cohort:
        """Whose answers these are."""
        return self.aggregate.cohort

    @property
    def progress(self) -> Progress:
        """The optima after fewer trials; waits for them. Raises `InputError` if they were not asked."""
        if self.following is None:
            raise InputError("CohortResults: the optima after fewer trials were not asked; analyse with whole=True.")
        return self.following.result()


def analyse_cohort(
    study: Study,
    cohort: Cohort,
    seed: int = 0,
    say: Say = lambda text: None,
    tell: Callable[[list[str]], None] = lambda sentences: None,
    *,
    whole: bool = True,
    individuals: bool = True,
    count: SayCount = lambda words, done, people: None,
) -> CohortResults:
    """The aggregate of a cohort, and its optima after fewer trials, which a thread goes on to compute; everything is
    fitted once.

    **Arguments:** `tell`: given the optimum in sentences as soon as it is known; `whole`: False for the aggregate
    alone, as for many participants; `individuals`, `count`: as `individuals` and `say` of `aggregate_cohort`.
    """
    if RULES[study.rule].learns:
        say("learning the hyperparameters from all answers")
    study = resolved(study, cohort)
    say(f"fitting {len(cohort.names)} participants ({study.file.name})")

    def first(optimum, map_):
        asked = asked_variance(map_, cohort)
        tell([optimum_sentence(study, optimum.x), *location_sentences(study, optimum.x, optimum.sd, asked)])

    aggregate = aggregate_cohort(study, cohort, seed, first=first, individuals=individuals, say=count)
    if not whole:
        return CohortResults(study, aggregate, None, seed, None, None)
    say("the optima after fewer trials")
    beside = ThreadPoolExecutor(1, "progress")
    following = beside.submit(follow, study, aggregate, seed)
    beside.shutdown(wait=False)
    region = optimum_region(study, aggregate.map, cohort.trials, seed)
    return CohortResults(study, aggregate, following, seed, region, model_check(study, aggregate))
