"""All results of one material, computed once for report, tables and figures.

Exclusion comes first: each participant's response quality is measured (`hilbo.population.judged.response_quality`), the
study's rule is applied, and only then are responses aggregated. Then: the aggregate, the optima after fewer trials,
best, mid and worst, tolerance intervals with fixed hyperparameters and with those of maximum evidence (`optimised`),
with their bootstrap over participants. Results that these responses do not allow are sentences in `limits`, not errors.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
import pandas as pd

from hilbo.errors import InputError
from hilbo.population.maps import RuleMap, learnt_map, point_rule
from hilbo.population.rules.registry import RECOMMENDED, RULES
from hilbo.search.apart import nrmse
from hilbo.search.candidates import search_points
from hilbo.study.analysis.best_mid_worst import Sets, best_mid_worst, second_choice_sentence
from hilbo.study.analysis.cohort_results import CohortResults, Say, analyse_cohort
from hilbo.study.analysis.heterogeneity import how_aggregated
from hilbo.study.analysis.progress import Progress
from hilbo.study.analysis.reversed_scale import reversed_sentences
from hilbo.study.analysis.rule_comparison import FEWEST, compare
from hilbo.study.analysis.tolerance import Ends, Tolerance, tolerance, tolerance_ends
from hilbo.study.cohort import Cohort
from hilbo.study.config import Study
from hilbo.study.estimate.aggregate import Aggregate, SayCount, aggregate_cohort, silent
from hilbo.study.estimate.learnt import learnt_sentences, resolved, that_learns
from hilbo.study.estimate.location import goal_sentences, location_sentences
from hilbo.study.estimate.optimum import map_optimum
from hilbo.study.exclusion import included
from hilbo.study.formats.json_file import Content
from hilbo.study.robustness.optimised import FixedAndOptimised, fixed_and_optimised

__all__ = ["Analysis", "Reading", "analyse", "limits_of", "moved_by_evidence"]

_NAMED = 20  # participants in a sentence


class Reading(NamedTuple):
    """A population map with the tolerance interval of each parameter and the bootstrap of its ends."""

    study: Study
    aggregate: Aggregate
    tolerances: dict[str, tuple[Tolerance | None, Ends | None]]


class Analysis(NamedTuple):
    """All results of one material."""

    population: CohortResults
    fixed: Reading
    """With the study's hyperparameters; of a method that learns them, with the medians of its priors."""
    optimised: Reading
    """With those of maximum evidence; of a method that learns them, the study's own."""
    hyperparameters: FixedAndOptimised
    sets: Sets | None
    people: pd.DataFrame
    """Response quality of all participants, also of those excluded."""
    left_out: dict[str, str]
    """Participant excluded by the study's rule -> reason."""
    limits: tuple[str, ...]
    comparison: Content | None
    """Comparison of all aggregation methods (`rule_comparison.compare`); None if not requested, or with fewer than
    three participants."""

    @property
    def study(self) -> Study:
        """The study, with its own hyperparameters."""
        return self.population.study

    @property
    def cohort(self) -> Cohort:
        """The participants that were aggregated, without the excluded ones."""
        return self.population.cohort

    @property
    def aggregate(self) -> Aggregate:
        """The aggregate under the study's own hyperparameters."""
        return self.population.aggregate

    @property
    def progress(self) -> Progress:
        """The optima after fewer trials; waits until they are computed."""
        return self.population.progress


def analyse(
    study: Study,
    everybody: Cohort,
    seed: int = 0,
    say: Say = lambda text: None,
    *,
    comparison: bool = False,
    count: SayCount = silent,
) -> Analysis:
    """All results of one material. `everybody`: all its participants, before exclusion; `say`: called with a phrase at
    the start of each step, `count` with the progress of those that take long; `comparison`: also cross-validate all
    aggregation methods, which is the slowest step. Raises `InputError` if all participants are excluded."""
    say("estimating response quality (consistency, lapses, drift)")
    cohort, people, left_out = included(study, everybody)
    population = _with_learnt(analyse_cohort(study, cohort, seed, say, count=count), seed, say)
    study, aggregate = population.study, population.aggregate
    say("optimising the hyperparameters (maximum evidence)")
    both = fixed_and_optimised(study, cohort)
    fixed, optimised = _aggregates(both, aggregate, seed)
    say("reading the maps")
    sets, sentences = _best_mid_worst(study, aggregate, seed)
    best = aggregate.optimum
    location = location_sentences(study, best.x, best.sd, aggregate.asked_variance)
    limits = (
        *goal_sentences(study, cohort.trials),
        *location,
        *learnt_sentences(study),
        *limits_of(study, cohort),
        *sentences,
    )
    limits += (*_aggregated_otherwise(aggregate.map), *both.limits)
    return Analysis(
        population,
        _reading(both.fixed, fixed, seed),
        _reading(both.optimised, optimised, seed),
        both,
        sets,
        people,
        left_out,
        limits,
        _compared(study, aggregate, seed, say) if comparison else None,
    )


def _first(texts: list[str]) -> str:
    """The first texts, and how many more there are."""
    more = len(texts) - _NAMED
    return ", ".join(texts[:_NAMED]) + (f" and {more:,} more" if more > 0 else "")


def limits_of(study: Study, cohort: Cohort) -> tuple[str, ...]:
    """Sentences on the limits of the data: a single participant, few or unequal numbers of responses, participants who
    gave one response only, fewer trials than planned."""
    counts, sentences = cohort.counts(), []
    if len(cohort.names) == 1:
        sentences.append(
            f"{cohort.names[0]} is the only participant: the population map is that participant's, and nothing is known"
            " of individual differences."
        )
    few = [name for name, count in zip(cohort.names, counts, strict=True) if count < 5]
    if few:
        sentences.append(f"Fewer than 5 responses are from {_first(few)}; their maps are nearly the prior.")
    if counts.min() != counts.max():
        sentences.append(
            f"Participants have between {counts.min()} and {counts.max()} responses; after n trials, those with fewer"
            " enter with all that they have."
        )
    mask, q = np.asarray(cohort.trials.mask), np.asarray(cohort.trials.q)
    one = [
        f'{name} ("{study.responses[int(q[j][mask[j]][0])]}")'
        for j, name in enumerate(cohort.names)
        if len(np.unique(q[j][mask[j]])) == 1
    ]
    if one:
        sentences.append(f"The responses do not vary for {_first(one)}: such maps have no direction of improvement.")
    planned = study.file.selection.trials
    if counts.max() < planned:
        sentences.append(f"The study plans {planned} trials; the largest number of responses is {counts.max()}.")
    return tuple(sentences)


def _compared(study: Study, aggregate: Aggregate, seed: int, say: Say) -> Content | None:
    """Comparison of all aggregation methods; None for fewer than three participants with responses."""
    if np.sum(aggregate.cohort.counts() > 0) < FEWEST:
        return None
    say("comparing the aggregation methods")
    return compare(study, aggregate, seed, learns=RULES[study.rule].learns)


def _with_learnt(population: CohortResults, seed: int, say: Say) -> CohortResults:
    """The same results with map and optimum by the recommended method added to the alternatives, and with `doubts`
    about reversed scales by that method; unchanged if the study's method learns."""
    study, aggregate = population.study, population.aggregate
    if RULES[study.rule].learns:
        return population
    say(f"repeating the analysis with {RECOMMENDED}")
    learns = resolved(that_learns(study), aggregate.cohort)
    assert learns.learnt is not None
    map_ = learnt_map(learns.learnt, aggregate.cohort.trials)
    optimum = map_optimum(learns, map_, search_points(study.space, seed))
    beside = eqx.tree_at(
        lambda a: (a.alternatives, a.maps),
        aggregate,
        (aggregate.alternatives | {RECOMMENDED: optimum}, aggregate.maps | {RECOMMENDED: map_}),
    )
    return population._replace(aggregate=beside, doubts=reversed_sentences(learns, aggregate.cohort))


def _aggregates(both: FixedAndOptimised, own: Aggregate, seed: int) -> tuple[Aggregate, Aggregate]:
    """Aggregates with fixed and with optimised hyperparameters. `own`: the study's, which is one of them."""
    studies = both.fixed, both.optimised
    learns = RULES[both.fixed.rule].learns
    other = aggregate_cohort(studies[not learns], own.cohort, seed, alternatives=False, individuals=False)
    return (other, own) if learns else (own, other)


def _reading(study: Study, aggregate: Any, seed: int) -> Reading:
    """Tolerance intervals through the map's optimum, with their bootstrap, for every parameter without levels."""
    x, scale = aggregate.optimum.x, aggregate.map.scale
    rule, share = point_rule(study.rule, aggregate.map.share)
    return Reading(
        study,
        aggregate,
        {
            name: (
                tolerance(study, aggregate.newcomer, x, name, scale),
                tolerance_ends(study, aggregate.posteriors, x, name, seed, rule=rule, share=share, scale=scale),
            )
            for name in (p.name for p in study.space.parameters if not p.levels)
        },
    )


def _best_mid_worst(study: Study, aggregate: Aggregate, seed: int) -> tuple[Sets | None, tuple[str, ...]]:
    """Best, mid and worst stimulus of the population map, and a sentence for each that is a second choice; or None and
    the reason why there are none."""
    candidates = search_points(study.space, seed)
    try:
        sets = best_mid_worst(study, aggregate.surface, candidates, prior=aggregate.map.map_prior)
    except InputError as error:
        return None, (f"No best, mid and worst sets: {str(error).removeprefix('best_mid_worst: ')}",)
    return sets, tuple(second_choice_sentence(study, name) for name in sets.second_choice)


def _aggregated_otherwise(map_: RuleMap) -> Iterator[str]:
    """Yield sentences on results that are not aggregated like the map: by another method, or without the random
    effect."""
    how = how_aggregated(map_)
    if how:
        yield (
            f"The map is aggregated by the rule {map_.rule} from all answers at once; maps of fewer trials, and"
            f" those of bootstrap resamples for the ends of tolerance intervals, are aggregated {how}, so that their"
            " last optimum need not be the map's."
        )
    if map_.effects is not None:
        yield ("Individual optima, maps of fewer trials and the ends of tolerance intervals ignore the random effect.")


def moved_by_evidence(analysis: Analysis) -> float:
    """NRMSE between the optima with fixed hyperparameters and with those of maximum evidence."""
    fixed, optimised = (reading.aggregate.optimum.x for reading in (analysis.fixed, analysis.optimised))
    return float(nrmse(optimised, fixed, analysis.study.gp.kernel.levels))
