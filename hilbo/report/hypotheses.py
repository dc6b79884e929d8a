"""What a study's results say of the paper's hypotheses H1 to H4, item by item.

Every item is a sentence with its figures, and whether it speaks for the hypothesis, against it, or leaves it open. The
thresholds are stated in the sentence; the verdict counts the items and is no test of its own.

    H1  individuals' parameters can be found by asking      H3  individuals need not have converged for that
    H2  a population's map has an optimum that people share  H4  it holds for other materials
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from hilbo.report.results import misses
from hilbo.report.validation import Validated, safest
from hilbo.study.analysis import Analysis
from hilbo.study.heterogeneity import in_place
from hilbo.study.progress import settled

__all__ = ["Evidence", "Hypothesis", "Results", "hypotheses"]

Side = Literal["for", "against", "open"]
_NEAR = 0.05


class Results(NamedTuple):
    """What is known of one material."""

    name: str
    found: Analysis
    validated: Validated | None
    reference: np.ndarray | None
    reference_name: str


class Evidence(NamedTuple):
    """One item."""

    side: Side
    text: str


class Hypothesis(NamedTuple):
    """A hypothesis, its evidence and what that comes to."""

    number: str
    statement: str
    evidence: tuple[Evidence, ...]

    @property
    def verdict(self) -> str:
        """In words."""
        sides = [item.side for item in self.evidence]
        pro, con = sides.count("for"), sides.count("against")
        if not pro + con:
            return "These data cannot say."
        if not con:
            return f"All that can be said ({pro} of {pro}) speaks for it."
        return f"{pro} of {pro + con} items speak for it, {con} against."


def hypotheses(results: Sequence[Results]) -> list[Hypothesis]:
    """H1 to H3 by the first material, H4 by the others."""
    first = results[0]
    whose = f" (Of {first.name}.)" if len(results) > 1 else ""
    return [
        Hypothesis(
            "H1",
            "The parameters can be found for individuals by Bayesian optimisation with qualitative answers." + whose,
            tuple(_individuals(first)),
        ),
        Hypothesis(
            "H2",
            "Individuals' maps can be merged into one whose optimum people in general find realistic." + whose,
            tuple(_population(first)),
        ),
        Hypothesis(
            "H3",
            "Individuals need not have converged for the merged map to have its optimum in the right place." + whose,
            tuple(_convergence(first)),
        ),
        Hypothesis("H4", "The same holds for materials of other mechanical properties.", tuple(_materials(results))),
    ]


def _side(good: bool) -> Side:
    return "for" if good else "against"


def _individuals(results):
    found, study = results.found, results.found.study
    counts = found.progress.counts
    top, people = study.responses[-1], len(found.cohort.names)
    if len(counts) > 2:
        known = [n for n in found.progress.settled(_NEAR) if n is not None]
        yield Evidence(
            _side(len(known) > people / 2),
            f"{len(known)} of {people} individual optima stayed within {100 * _NEAR:.0f} % (NRMSE) of their final place"
            " before their last trial"
            f"{f', the median of these from trial {np.median(known):.0f} on' if known else ''} (for: more than half).",
        )
    answers = np.asarray(found.cohort.trials.q) == len(study.responses) - 1
    mask = np.asarray(found.cohort.trials.mask)
    totals = (answers & mask).sum(axis=1)
    spread = f" ± {totals.std(ddof=1):.2f}" if people > 1 else ""
    longest = int(found.cohort.counts().max())
    third = max(longest // 3, 1)
    early, late = (
        float((answers & mask)[:, part].sum() / max(mask[:, part].sum(), 1))
        for part in (slice(0, third), slice(longest - third, longest))
    )
    yield Evidence(
        _side(late > early) if longest >= 6 else "open",
        f'Of {longest} trials, {totals.mean():.2f}{spread} were answered "{top}"; in the first third of the session'
        f" {100 * early:.0f} % of the answers, in the last third {100 * late:.0f} % (for: more than in the first).",
    )
    chances = np.asarray(found.aggregate.individuals.class_probabilities)
    likeliest = int((chances.argmax(axis=1) == chances.shape[1] - 1).sum())
    yield Evidence(
        _side(likeliest > people / 2),
        f'At their own optimum "{top}" is the likeliest answer for {likeliest} of {people} participants (median'
        f" probability {100 * np.median(chances[:, -1]):.0f} %; for: more than half of them).",
    )


def _population(results):
    found, study = results.found, results.found.study
    best = found.aggregate.optimum
    if results.reference is not None:
        ours, _ = misses(study, best.x, results.reference)
        own, _ = misses(study, found.aggregate.individuals.x, results.reference)
        mean, _ = misses(study, found.aggregate.mean_of_optima, results.reference)
        low, middle, high = np.percentile(own, [25, 50, 75])
        yield Evidence(
            _side(bool(ours < middle and ours < mean)),
            f"From {results.reference_name} the population optimum is {100 * ours:.1f} % away (NRMSE), the individual"
            f" optima {100 * middle:.0f} % (median; quartiles {100 * low:.0f} and {100 * high:.0f} %), their mean"
            f" {100 * mean:.1f} % (for: nearer than both the median and the mean).",
        )
    p = float(best.class_probabilities[-1])
    yield Evidence(
        _side(int(np.argmax(np.asarray(best.class_probabilities))) == len(study.responses) - 1),
        f'At the population optimum the map gives "{study.responses[-1]}" a probability of {100 * p:.0f} % (for: the'
        " likeliest answer).",
    )
    if results.validated is None:
        yield Evidence("open", "No validation session asked people again.")
        return
    yield from _validation(results.validated, study.responses)


def _validation(validated, responses):
    counts = validated.tables.confusion.to_numpy()
    if len(counts) == 3 and counts.sum(axis=1).all() and len(responses) == 3:
        diagonal = bool((counts.argmax(axis=1) == np.arange(3)).all())
        yield Evidence(
            _side(diagonal),
            f"The confusion matrix is {'' if diagonal else 'not '}diagonally dominant: best, mid and worst were called"
            f' "{responses[-1]}", "{responses[1]}" and "{responses[0]}" in'
            f" {', '.join(f'{100 * v:.0f} %' for v in np.diagonal(counts) / counts.sum(axis=1))} of the cases.",
        )
    for number, term, words, sign in (
        ("II", "Best", f'the best set is called "{responses[-1]}" more often than the others', 1),
        ("III", "Best", "the best set differs from the mid set, towards the highest answer", -1),
        ("III", "Worst", "the worst set differs from the mid set, towards the lowest answer", 1),
        ("IV", "Aggregate-Best", "the aggregate's set is preferred to individuals' own", 1),
    ):
        table = validated.regressions().get(number)
        if table is None:
            continue
        rows = safest(table).set_index("term")
        if term not in rows.index:
            continue
        low, high = sorted((sign * rows.at[term, "low"], sign * rows.at[term, "high"]))
        side: Side = "for" if low > 0 else "against" if high < 0 else "open"
        yield Evidence(
            side,
            f"Table {number}, {term}: {rows.at[term, 'estimate']:.2f}, 95 % interval {rows.at[term, 'low']:.2f} to"
            f" {rows.at[term, 'high']:.2f}; {'' if low > 0 else 'it does not show that '}{words}.",
        )


def _convergence(results):
    found = results.found
    counts, (merged, own) = found.progress.counts, found.progress.to_end()
    people = len(found.cohort.names)
    if len(counts) <= 2 or people < 2:
        yield Evidence("open", "It takes several participants and trials to say.")
        return
    first = settled(counts, merged, _NEAR)
    how = in_place(found.aggregate.map)
    how = f" (merged {how})" if how else ""
    if first is None:
        yield Evidence(
            "against",
            f"The population optimum{how} still moved by more than {100 * _NEAR:.0f} % before the last trial.",
        )
        return
    at = int(np.searchsorted(counts, first))
    answering, open_ = int(np.isfinite(own[at]).sum()), int((own[at] > _NEAR).sum())
    yield Evidence(
        _side(open_ > 0),
        f"From trial {first} on the population optimum{how} stayed within {100 * _NEAR:.0f} % (NRMSE) of its final"
        f" place; {open_} of {answering} individual optima that could still move were further from theirs then"
        " (for: one at least).",
    )
    if results.reference is not None:
        miss = [
            float(misses(found.study, x, results.reference)[0])
            for x in (found.progress.population[at], found.progress.population[-1])
        ]
        yield Evidence(
            _side(miss[0] <= miss[1] + _NEAR),
            f"It was then {100 * miss[0]:.1f} % from {results.reference_name}, and {100 * miss[1]:.1f} % in the"
            f" end{how} (for: at most {100 * _NEAR:.0f} % more).",
        )


def _materials(results):
    if len(results) < 2:
        yield Evidence("open", "One material was studied.")
    for one in results[1:]:
        items = [*_near(one), *([] if one.validated is None else _preferred(one.name, one.validated))]
        words = f"{one.name}: there is no reference, and no decided comparison of the map's set with individuals'."
        yield from items or [Evidence("open", words)]


def _near(one):
    if one.reference is None:
        return
    found = one.found
    ours = float(misses(found.study, found.aggregate.optimum.x, one.reference)[0])
    own = float(np.median(misses(found.study, found.aggregate.individuals.x, one.reference)[0]))
    yield Evidence(
        _side(ours < own),
        f"{one.name}: the population optimum is {100 * ours:.1f} % from {one.reference_name}, the median individual one"
        f" {100 * own:.0f} % (for: nearer than that).",
    )


def _preferred(name, validated):
    table = validated.regressions().get("IV")
    if table is None or validated.overall is None:
        return
    row = safest(table).set_index("term").loc["Aggregate-Best"]
    side: Side = "for" if row["low"] > 0 else "against" if row["high"] < 0 else "open"
    yield Evidence(
        side,
        f"{name}: the aggregate's set was preferred in {100 * validated.overall['rate'].iloc[0]:.1f} % of the decided"
        f" comparisons ({int(validated.people['ties'].sum())} ties; table IV: {row['estimate']:.2f}, 95 % interval"
        f" {row['low']:.2f} to {row['high']:.2f}).",
    )
