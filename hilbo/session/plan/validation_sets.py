"""The sets of a validation, from the results of an optimisation and the answers that they were computed from.

The map is fitted again from the answers, so that best, mid and worst are read from the same map; its optimum must be
that of result.json, or the results are of other answers or another study, and are refused.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np

from hilbo.errors import InputError
from hilbo.search.candidates import search_points
from hilbo.search.rendering import Rendering
from hilbo.session.plan.plan import Source
from hilbo.study.analysis.best_mid_worst import Sets, best_mid_worst, second_choice_sentence
from hilbo.study.cohort import Cohort
from hilbo.study.config import Study
from hilbo.study.estimate.aggregate import aggregate_cohort
from hilbo.study.estimate.learnt import resolved
from hilbo.study.formats.cell_text import id_form
from hilbo.study.formats.json_file import check_values
from hilbo.study.results.result_json import FoundOptimum, Result

__all__ = ["aggregate_best_sets", "check_participants", "validation_sets"]

_SAME = 1e-6  # of the search ranges
_NAMES = ("best", "mid", "worst")
NamedSets = dict[str, dict[str, float]]


def check_participants(results: Iterable[Result], participants: Sequence[str], source: Source) -> None:
    """Raise InputError for a participant whose answers are in one of the materials' results although `source` is
    "aggregate", or in none of them although it is "individual"."""
    in_map = {person.participant for result in results for person in result.participants}
    forms = {id_form(name): name for name in in_map}
    for person in participants:
        if source == "aggregate" and (known := forms.get(id_form(person))) is not None:
            called = "" if person in in_map else f', as "{known}"'
            raise InputError(
                f'plan: participant "{person}" is in the map that is to be validated{called}; invite people who are'
                " not."
            )
        if source == "individual" and person not in in_map:
            raise InputError(
                f'plan: participant "{person}" has no individual map in the results; plan for those who have one.'
            )


def validation_sets(
    study: Study,
    result: Result,
    cohort: Cohort,
    source: Source,
    participants: Sequence[str],
    note: Callable[[str], None] = lambda sentence: None,
) -> NamedSets:
    """Compute the sets best, mid and worst of the population's map, or of each participant's own: name -> parameters.

    Names are "best" or, with source "individual", "PARTICIPANT best", for those of the `participants` who are in the
    results. The maps are fitted from the answers in `cohort` of the participants in the results. `note` is called with
    a sentence for each set that is a second choice. Raises InputError for another aggregation method or optimum than in
    the results.
    """
    cohort = cohort.of([person.participant for person in result.participants])
    _check_rule(study, result)
    study = resolved(study, cohort)
    aggregated = aggregate_cohort(study, cohort, result.seed, alternatives=False)
    _check_same(study, result, np.asarray(aggregated.optimum.x))
    points = search_points(study.space, result.seed)
    if source == "aggregate":
        three = best_mid_worst(study, aggregated.surface, points, prior=aggregated.map.map_prior)
        return _named(study, three, "", "the population", note)
    sets: NamedSets = {}
    for person in (name for name in participants if name in cohort.names):
        row = cohort.names.index(person)
        posterior = jax.tree.map(lambda leaf, row=row: leaf[row], aggregated.posteriors)
        three = best_mid_worst(study, _Predict(posterior), points)
        sets |= _named(study, three, f"{person} ", person, note)
    return sets


class _Predict(eqx.Module):
    """A participant's posterior as a function."""

    posterior: Any

    def __call__(self, x):
        """Mean and variance of the latent score at the points x."""
        return self.posterior.predict(x)


def aggregate_best_sets(study: Study, result: Result) -> NamedSets:
    """Sets "aggregate", the population's optimum, and "individual:PARTICIPANT" for each individual optimum: name ->
    parameters.

    Raises InputError if the results have no individual optima, or one is outside of the study's ranges.
    """

    def of(optimum: FoundOptimum, what: str) -> dict[str, float]:
        """Parameters of an optimum, checked against the study's ranges; `what` names it in messages."""
        return check_values(optimum.parameters, study.space.parameters, "plan", what)

    _check_rule(study, result)
    sets = {"aggregate": of(result.optimum, "the optimum")}
    for person in result.participants:
        if person.optimum is None:
            raise InputError("plan: the results have no individual optima; aggregate again without --no-individuals.")
        sets[f"individual:{person.participant}"] = of(person.optimum, f"the optimum of {person.participant}")
    return sets


def _named(study: Study, three: Sets, prefix: str, whose: str, note: Callable[[str], None]) -> NamedSets:
    """Three sets as a dict: `prefix` and role -> parameters in physical units. `note`: told of those of `whose` map
    that are a second choice."""
    for name in three.second_choice:
        note(f"plan: {second_choice_sentence(study, name, whose)}")
    rows = np.asarray(study.space.to_physical(three.x))
    return {prefix + name: Rendering.of(study.space, row).values for name, row in zip(_NAMES, rows, strict=True)}


def _check_rule(study: Study, result: Result) -> None:
    """Raise InputError if the results are by another aggregation method than the study's."""
    if result.rule not in (None, study.rule):
        raise InputError(
            f'plan: result.json is by the rule "{result.rule}", and the study\'s is "{study.rule}"; aggregate again'
            " without --rule, or write that rule into the study file."
        )


def _check_same(study, result, x):
    """Raise InputError if the optimum x (d,), in the unit cube, is not that of the results."""
    stated = check_values(result.optimum.parameters, study.space.parameters, "plan", "the optimum")
    distance = np.max(np.abs(Rendering.of(study.space, stated).unit - x))
    if distance > _SAME:
        raise InputError(
            f"plan: the optimum of these answers is {distance:.2g} of the ranges away from that of result.json; give"
            " the trials that it was made from."
        )
