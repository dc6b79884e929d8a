"""Evidence of a study's results on the paper's hypotheses H1 to H4, item by item.

Every item is a sentence with its numbers, and whether it supports the hypothesis, contradicts it, or is inconclusive.
The bounds are stated in the sentence; a tie with the bound is inconclusive, so that a verdict does not depend on the
direction of a scale. A difference between participants is inconclusive if its 95 % interval contains 0,
or if it is equal for all of them. Items are not
counted, and none is a test by itself. Only a study that asks for it has this
section (`[report] hypotheses = true`): the hypotheses are the paper's.

    H1  individual parameters are found from responses    H3  individual convergence is not required for that
    H2  the population map's optimum is broadly shared    H4  the same applies to other materials

The page has the hypotheses in full.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from scipy.stats import t

from hilbo.report.results import misses
from hilbo.report.validation import Validated, safest
from hilbo.study.analysis.analysis import Analysis
from hilbo.study.analysis.heterogeneity import how_aggregated
from hilbo.study.folder import Reference

__all__ = ["Evidence", "Hypothesis", "Results", "hypotheses"]

Side = Literal["supports", "contradicts", "inconclusive"]
_NEAR = 0.05
_STAGED = ("II", "III")
"""Tables of the sets best, mid and worst."""
_SAME = 1e-9  # rounding: numbers that are as near as this are equal


class Results(NamedTuple):
    """Results of one material, with its validation and its reference, or None."""

    name: str
    analysis: Analysis
    validated: Validated | None
    reference: Reference | None


class Evidence(NamedTuple):
    """One item of evidence: a verdict, and a sentence that states the numbers and the bound."""

    side: Side
    text: str


class Hypothesis(NamedTuple):
    """A hypothesis and its evidence."""

    number: str
    evidence: tuple[Evidence, ...]


def hypotheses(results: Sequence[Results]) -> list[Hypothesis]:
    """Evidence on the hypotheses H1 to H4: H1 to H3 from the first material, H4 from the others."""
    first = results[0]
    return [
        Hypothesis("H1", tuple(_individuals(first))),
        Hypothesis("H2", tuple(_population(first))),
        Hypothesis("H3", tuple(_convergence(first))),
        Hypothesis("H4", tuple(_materials(results))),
    ]


def _side(one: float, other: float) -> Side:
    """ "supports" if one > other, "contradicts" if less, "inconclusive" if they are equal to 1e-9 or one is NaN."""
    if np.isclose(one, other, rtol=_SAME, atol=_SAME) or np.isnan(one) or np.isnan(other):
        return "inconclusive"
    return "supports" if one > other else "contradicts"


def _largest(row: np.ndarray, place: int) -> Side:
    """ "supports" if the number at index `place` of a row is larger than all others, "inconclusive" if it is equal to
    the largest of them to 1e-9, else "contradicts".
    """
    return _side(float(row[place]), float(np.delete(row, place).max()))


class _Difference(NamedTuple):
    """Mean of differences (%), one of each participant, with its 95 % interval by Student's t."""

    mean: float
    low: float
    high: float

    @property
    def side(self) -> Side:
        """ "supports" if all of the interval is above 0, "contradicts" if all of it is below, else "inconclusive"."""
        return "supports" if self.low > 0 else "contradicts" if self.high < 0 else "inconclusive"

    def __str__(self) -> str:
        if not np.isfinite(self.low):
            return f"{self.mean:.1f} % (no interval: fewer than two participants, or all equal)"
        return f"{self.mean:.1f} % (95 % interval {self.low:.1f} to {self.high:.1f})"


def _difference(values: np.ndarray) -> _Difference:
    """Mean of differences (M,) of as many participants; the interval of fewer than two is unbounded, and so is that of
    equal differences, which have no spread to estimate it from.
    """
    mean = float(values.mean()) if len(values) else np.nan
    if len(values) < 2 or np.ptp(values) <= _SAME * np.abs(values).max():
        return _Difference(mean, -np.inf, np.inf)
    half = float(t.ppf(0.975, len(values) - 1) * values.std(ddof=1)) / len(values) ** 0.5
    return _Difference(mean, mean - half, mean + half)


def _individuals(results):
    """Generate the evidence for H1: approach to the other participants' optimum, responses that are the goal over the
    session, and the likeliest response at the individual optima.
    """
    analysis, study = results.analysis, results.analysis.study
    counts = analysis.progress.counts
    top, people = study.goal_label, len(analysis.cohort.names)
    if analysis.progress.splits and len(counts) > 2:
        yield _nearer_to_others(analysis.progress)
    answers = np.asarray(analysis.cohort.trials.q) == study.goal.category
    mask = np.asarray(analysis.cohort.trials.mask)
    totals = (answers & mask).sum(axis=1)
    spread = f" ± {totals.std(ddof=1):.2f}" if people > 1 else ""
    longest = int(analysis.cohort.counts().max())
    third = max(longest // 3, 1)
    thirds = slice(0, third), slice(longest - third, longest)
    both = mask[:, thirds[0]].any(axis=1) & mask[:, thirds[1]].any(axis=1)
    early, late = (100 * (answers & mask)[both, part].sum(axis=1) / mask[both, part].sum(axis=1) for part in thirds)
    more = _difference(late - early)
    yield Evidence(
        more.side if longest >= 6 else "inconclusive",
        f'Of {longest} responses, {totals.mean():.2f}{spread} are "{top}"; in the first third of the session'
        f" {early.mean():.0f} % of the responses, in the last third {late.mean():.0f} % (means over participants);"
        f" difference {more} (supports: an interval above 0).",
    )
    chances = np.asarray(analysis.aggregate.individuals.class_probabilities)
    sides = [_largest(row, study.goal.category) for row in chances]
    likeliest, unlike = sides.count("supports"), sides.count("contradicts")
    yield Evidence(
        "supports" if likeliest > people / 2 else "contradicts" if unlike > people / 2 else "inconclusive",
        f'At the individual optimum "{top}" is the most probable response of {likeliest} of {people} participants'
        f" (median probability {100 * np.median(chances[:, study.goal.category]):.0f} %; supports: more than half of"
        " them).",
    )


def _nearer_to_others(progress):
    """Evidence whether individual optima approach the optimum of participants who are not among them, from a third of
    the trials to the last.
    """
    row = _early(progress.counts)
    early, late = (100 * progress.individual_to_half[k] for k in (row, -1))
    nearer = _difference(early - late)
    return Evidence(
        nearer.side,
        "The distance of individual optima from the optimum of half of the other participants is"
        f" {np.median(early):.0f} % after {progress.counts[row]} trials and {np.median(late):.0f} % after"
        f" {progress.counts[-1]} (NRMSE, medians); it falls by {nearer} on average (supports: an interval above 0).",
    )


def _early(counts):
    """Index into `counts` (numbers of trials, rising) of the first one that is at least a third of the last."""
    return int(np.searchsorted(counts, max(int(counts[-1]) // 3, 1)))


def _population(results):
    """Generate the evidence for H2: distance of the optimum to the reference, probability of the goal
    there, and the validation.
    """
    analysis, study = results.analysis, results.analysis.study
    best = analysis.aggregate.optimum
    if results.reference is not None:
        ours, _ = misses(study, best.x, results.reference.x)
        individual_misses, _ = misses(study, analysis.aggregate.individuals.x, results.reference.x)
        mean, _ = misses(study, analysis.aggregate.mean_of_optima, results.reference.x)
        low, middle, high = np.percentile(individual_misses, [25, 50, 75])
        farther = _difference(100 * (np.asarray(individual_misses) - float(ours)))
        yield Evidence(
            farther.side if farther.side != "supports" or mean > ours else "inconclusive",
            f"From {results.reference.name} the population optimum is {100 * ours:.1f} % away (NRMSE), the individual"
            f" optima {100 * middle:.0f} % (median; quartiles {100 * low:.0f} and {100 * high:.0f} %), their mean"
            f" {100 * mean:.1f} %; individual optima are farther by {farther} on average"
            " (supports: an interval above 0, and their mean is farther too).",
        )
    yield _likeliest(analysis)
    if results.validated is None:
        yield Evidence("inconclusive", "There are no validation sessions.")
        return
    yield from _validation(results.validated, study)


def _likeliest(analysis):
    """Evidence whether a new participant's likeliest response at the optimum is the goal, with all of its
    probability's 95 % interval; inconclusive for methods that do not predict a new participant.
    """
    highest, goal = analysis.population.highest, analysis.study.goal
    if highest is None:
        words = f"The method {analysis.study.rule} does not predict a new participant's responses."
        return Evidence("inconclusive", words)
    chances = np.asarray(analysis.aggregate.optimum.class_probabilities)
    side = _largest(chances, goal.category)
    if side == "supports" and highest.low <= np.delete(chances, goal.category).max():
        side = "inconclusive"
    return Evidence(
        side,
        f'At the population optimum a new participant responds "{analysis.study.goal_label}" with a probability of'
        f" {highest.probability:.0%} (95 % interval {highest.low:.0%} to {highest.high:.0%}; supports: more probable"
        " than any other response).",
    )


def _validation(validated, study, numbers=("II", "III", "IV")):
    """Generate the evidence of the validation sessions for H2: the confusion matrix, for three responses, and
    coefficients of the tables of these `numbers`, as far as there are such.
    """
    counts, responses, goal = validated.tables.confusion.to_numpy(), study.responses, study.goal_label
    if study.goal.is_highest and len(counts) == 3 and counts.sum(axis=1).all() and len(responses) == 3:
        sides = [_largest(row, place) for place, row in enumerate(counts)]
        yield Evidence(
            "contradicts" if "contradicts" in sides else "inconclusive" if "inconclusive" in sides else "supports",
            f'Best, mid and worst were called "{responses[-1]}", "{responses[1]}" and "{responses[0]}" in'
            f" {', '.join(f'{100 * v:.0f} %' for v in np.diagonal(counts) / counts.sum(axis=1))} of the cases"
            " (supports: each is the most frequent response to its set).",
        )
    for number, term, words, sign in (
        ("II", "Best", f'the best set is called "{goal}" more often than the others', 1),
        ("III", "Best", f'the best set differs from the mid set, towards "{goal}"', -1),
        ("III", "Worst", f'the worst set differs from the mid set, away from "{goal}"', 1),
        ("IV", "Aggregate-Best", "the population optimum is preferred to individual optima", 1),
    ):
        table = validated.regressions().get(number)
        if table is None or number not in numbers:
            continue
        rows = safest(table).set_index("term")
        if term not in rows.index:
            continue
        low, high = sorted((sign * rows.at[term, "low"], sign * rows.at[term, "high"]))
        side: Side = "supports" if low > 0 else "contradicts" if high < 0 else "inconclusive"
        yield Evidence(
            side,
            f"Table {number}, {term}: {rows.at[term, 'estimate']:.2f}, 95 % interval {rows.at[term, 'low']:.2f} to"
            f" {rows.at[term, 'high']:.2f}; {'' if low > 0 else 'it does not show that '}{words}.",
        )


def _convergence(results):
    """Generate the evidence for H3: optima of random halves of the participants, and of everyone, after a third of the
    trials.
    """
    analysis = results.analysis
    progress = analysis.progress
    if len(progress.counts) <= 2 or not progress.splits:
        yield Evidence("inconclusive", "This needs several participants and trials.")
        return
    how = how_aggregated(analysis.aggregate.map)
    how = f" (aggregated {how})" if how else ""
    row = _early(progress.counts)
    half, end, individual = (
        100 * float(np.median(v)) for v in (progress.halves[row], progress.halves[-1], progress.individual_to_half[row])
    )
    farther = _difference(100 * progress.individual_to_half[row] - half)
    yield Evidence(
        farther.side,
        f"After {progress.counts[row]} trials the optimum of one half of the participants{how} is {half:.0f} % (NRMSE,"
        f" median of {progress.splits} random halves) from that of the other half after all trials, and individual"
        f" optima are {individual:.0f} % from it, farther by {farther} on average (supports: an interval above 0);"
        f" after all trials the distance between the halves is {end:.0f} %.",
    )
    if results.reference is not None:
        miss = [
            float(misses(analysis.study, x, results.reference.x)[0])
            for x in (analysis.progress.population[row], analysis.progress.population[-1])
        ]
        yield Evidence(
            "supports" if miss[0] <= miss[1] + _NEAR else "contradicts",
            f"The optimum of the first {progress.counts[row]} trials is {100 * miss[0]:.1f} % from"
            f" {results.reference.name}, that of all {100 * miss[1]:.1f} %{how}"
            f" (supports: at most {100 * _NEAR:.0f} % more).",
        )


def _materials(results):
    """Generate the evidence for H4 from all materials but the first; inconclusive for one material."""
    if len(results) < 2:
        yield Evidence("inconclusive", "One material was studied.")
    for one in results[1:]:
        items = list(_near(one))
        if one.validated is not None:
            own = _validation(one.validated, one.analysis.study, _STAGED)
            items += [Evidence(item.side, f"{one.name}: {item.text}") for item in own]
            items += _preferred(one.name, one.validated)
        words = (
            f"{one.name}: there is no reference, and no decided comparison of the population optimum with individual"
            " optima."
        )
        yield from items or [Evidence("inconclusive", words)]


def _near(one):
    """Generate evidence whether the population optimum is nearer to the reference than individual optima on average;
    none without reference.
    """
    if one.reference is None:
        return
    analysis = one.analysis
    ours = float(misses(analysis.study, analysis.aggregate.optimum.x, one.reference.x)[0])
    individual_misses = np.asarray(misses(analysis.study, analysis.aggregate.individuals.x, one.reference.x)[0])
    farther = _difference(100 * (individual_misses - ours))
    yield Evidence(
        farther.side,
        f"{one.name}: the population optimum is {100 * ours:.1f} % from {one.reference.name}, the median individual one"
        f" {100 * float(np.median(individual_misses)):.0f} %, farther by {farther} on average (supports: an interval"
        " above 0).",
    )


def _preferred(name, validated):
    """Generate evidence whether the aggregate's set was preferred (table IV); none without decided comparisons."""
    table = validated.regressions().get("IV")
    if table is None or validated.overall is None:
        return
    row = safest(table).set_index("term").loc["Aggregate-Best"]
    side: Side = "supports" if row["low"] > 0 else "contradicts" if row["high"] < 0 else "inconclusive"
    yield Evidence(
        side,
        f"{name}: the population optimum was preferred in {100 * validated.overall['rate'].iloc[0]:.1f} % of the"
        f" decided comparisons ({int(validated.people['ties'].sum())} ties; table IV: {row['estimate']:.2f}, 95 %"
        f" interval {row['low']:.2f} to {row['high']:.2f}).",
    )
