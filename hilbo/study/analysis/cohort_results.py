"""Results of one cohort: the aggregate, its convergence over the trials, the region of the optimum and the model check.

`hilbo aggregate` writes these. `hilbo.study.analysis.analysis` adds the further results of a report, and takes longer
to import.
"""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

from hilbo.errors import InputError
from hilbo.population.rules.registry import RULES
from hilbo.study.analysis.highest_answer import HighestAnswer, highest_answer
from hilbo.study.analysis.model_check import model_check
from hilbo.study.analysis.progress import Progress, follow
from hilbo.study.analysis.region import Region, hyperparameter_draws, optimum_region
from hilbo.study.analysis.reversed_scale import reversed_sentences
from hilbo.study.cohort import Cohort
from hilbo.study.config import Study
from hilbo.study.estimate.aggregate import Aggregate, SayCount, aggregate_cohort, asked_variance
from hilbo.study.estimate.learnt import resolved
from hilbo.study.estimate.location import location_sentences, optimum_sentence
from hilbo.study.formats.json_file import Content

__all__ = ["CohortResults", "Say", "analyse_cohort"]

Say = Callable[[str], None]


class CohortResults(NamedTuple):
    """Results of one cohort that `hilbo aggregate` writes; convergence over the trials is computed in a thread."""

    study: Study
    aggregate: Aggregate
    following: Future[Progress] | None
    """The running computation of `progress`; None if not requested."""
    seed: int
    region: Region | None
    """Credible region of the optimum; None for a map without a joint posterior, or if not requested."""
    check: Content | None
    """Results of the model check (`model_check`); None if not requested, or with fewer than three participants."""
    highest: HighestAnswer | None = None
    """A new participant's probability of the goal at the optimum; None by methods that do not
    predict it."""
    doubts: tuple[str, ...] = ()
    """Sentences on participants whose scale looks reversed."""

    @property
    def cohort(self) -> Cohort:
        """The participants and their responses."""
        return self.aggregate.cohort

    @property
    def progress(self) -> Progress:
        """Optima after fewer trials; waits until they are computed. Raises `InputError` if they were not requested."""
        if self.following is None:
            raise InputError("CohortResults: the optima after fewer trials were not computed; analyse with whole=True.")
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
    """Aggregate a cohort and analyse the map; returns while a thread computes the optima after fewer trials.

    **Arguments:** `say`: called with a phrase at the start of each step; `tell`: called with sentences on the optimum
    as soon as it is known; `whole`: False for the map by the study's own rule and inference alone, as for many
    participants; `individuals`, `count`: as `individuals` and `say` of `aggregate_cohort`.
    """
    if RULES[study.rule].learns:
        say("fitting the hyperparameters to all responses")
    study = resolved(study, cohort)
    say(f"fitting {len(cohort.names)} participants ({study.file.name})")

    def first(optimum, map_):
        asked = asked_variance(map_, cohort)
        tell([optimum_sentence(study, optimum.x), *location_sentences(study, optimum.x, optimum.sd, asked)])

    aggregate = aggregate_cohort(
        study, cohort, seed, alternatives=whole, first=first, individuals=individuals, say=count
    )
    if not whole:
        highest = highest_answer(study, aggregate.map, aggregate.optimum.x)
        return CohortResults(study, aggregate, None, seed, None, None, highest)
    say("computing the convergence over trials")
    beside = ThreadPoolExecutor(1, "progress")
    following = beside.submit(follow, study, aggregate, seed)
    beside.shutdown(wait=False)
    drawn = hyperparameter_draws(study, cohort.trials, seed, count)
    region = optimum_region(study, aggregate.map, drawn, seed, say=count)
    highest = highest_answer(study, aggregate.map, aggregate.optimum.x, drawn)
    check = model_check(study, aggregate, count)
    doubts = reversed_sentences(study, cohort)
    return CohortResults(study, aggregate, following, seed, region, check, highest, doubts)
