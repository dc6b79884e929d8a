"""Key results of one material as a table: errors, responses, validation, next to those of another study.

The rows are those that the paper prints about its study. The interval of a reference set, as `hilbo identify` writes it
beside the values, gives the range of errors to any set within it.
"""

from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float

from hilbo.report.digits import rounded
from hilbo.report.results import misses
from hilbo.report.validation import Validated
from hilbo.study.analysis.analysis import Analysis, moved_by_evidence
from hilbo.study.folder import Reference

__all__ = ["KeyNumber", "key_numbers", "key_numbers_table", "key_numbers_words"]

Range = Literal["", "quartiles", "standard deviation", "95 % interval", "within the interval of the reference"]
_ROLES = ("best", "mid", "worst")


class KeyNumber(NamedTuple):
    """A row: `key` as in `[report] compare_with`, `result` in words, `value` with `low` and `high` in `unit`."""

    key: str
    result: str
    value: float
    low: float = np.nan
    high: float = np.nan
    range: Range = ""
    unit: str = "%"


def key_numbers(analysis: Analysis, validated: Validated | None, reference: Reference | None) -> list[KeyNumber]:
    """The key results that the data of one material have, in the order of the paper."""
    rows = [] if reference is None else list(_errors(analysis, reference))
    shift = 100 * moved_by_evidence(analysis)
    rows.append(KeyNumber("hyperparameter_shift", "Shift of the optimum by optimised hyperparameters (NRMSE)", shift))
    rows.append(_goal_answers(analysis))
    return rows if validated is None else [*rows, *_validation(analysis, validated)]


def key_numbers_table(analysis: Analysis, rows: list[KeyNumber]) -> pd.DataFrame:
    """The rows of key_numbers.csv, with the column `compared_with` from the study file, and a row without a value for
    each of its results that this study does not have."""
    others = analysis.study.file.report.compare_with
    missing = [key for key in others if key not in {row.key for row in rows}]
    rows = [*rows, *(KeyNumber(key, key.replace("_", " ").capitalize(), np.nan) for key in missing)]
    table = pd.DataFrame(rows, columns=list(KeyNumber._fields))
    return table.assign(compared_with=[_other(others.get(row.key, ""), row.unit) for row in rows])


def _other(value: str | float, unit: str) -> str:
    """A text of `[report] compare_with`, or a number with its unit, with all of its digits."""
    return value if isinstance(value, str) else f"{value:.12g}" + ("" if unit == "answers" else f" {unit}")


def key_numbers_words(table: pd.DataFrame) -> list[list[str]]:
    """Rows of the page's table, as texts: result with its unit, value with its range, and what it is compared with
    where the study file has anything."""
    rows = [
        [_head(row), _words(row), row.compared_with.removesuffix(f" {row.unit}")]
        for row in table.itertuples(index=False)
    ]
    return rows if table["compared_with"].any() else [row[:2] for row in rows]


def _errors(analysis: Analysis, reference: Reference) -> Iterator[KeyNumber]:
    """Three rows, NRMSE to the reference in %: the population optimum, the individual optima (median and quartiles) and
    their mean; the first and the last with the range of errors to sets within the reference's interval, if any."""
    study, aggregate = analysis.study, analysis.aggregate

    def error(key: str, what: str, x: Float[np.ndarray, " d"]) -> KeyNumber:
        """Row of one point in the unit cube."""
        value = 100 * float(misses(study, x, reference.x)[0])
        words = f"{what}: error to {reference.name} (NRMSE)"
        if reference.low is None or reference.high is None:
            return KeyNumber(key, words, value)
        low, high = _distances(np.asarray(x), reference.low, reference.high)
        return KeyNumber(key, words, value, 100 * low, 100 * high, "within the interval of the reference")

    yield error("population_error", "Population optimum", np.asarray(aggregate.optimum.x))
    own = 100 * np.asarray(misses(study, aggregate.individuals.x, reference.x)[0])
    low, middle, high = np.percentile(own, [25, 50, 75])
    words = f"Individual optima: error to {reference.name} (NRMSE), median"
    yield KeyNumber("individual_error", words, middle, low, high, "quartiles")
    yield error("mean_of_optima_error", "Mean of individual optima", np.asarray(aggregate.mean_of_optima))


def _distances(
    x: Float[np.ndarray, " d"], low: Float[np.ndarray, " d"], high: Float[np.ndarray, " d"]
) -> tuple[float, float]:
    """Smallest and largest NRMSE of a point to any point of a box, all in the unit cube."""
    nearest = np.maximum(np.maximum(low - x, x - high), 0.0)
    farthest = np.maximum(np.abs(x - low), np.abs(x - high))
    return float(np.sqrt(np.mean(nearest**2))), float(np.sqrt(np.mean(farthest**2)))


def _goal_answers(analysis: Analysis) -> KeyNumber:
    """Number of responses per participant that are the goal: mean, and a standard deviation on either side."""
    trials, goal = analysis.cohort.trials, analysis.study.goal
    counts = (np.asarray(trials.q == goal.category) & np.asarray(trials.mask)).sum(axis=1)
    mean, sd = float(counts.mean()), float(counts.std(ddof=1)) if len(counts) > 1 else np.nan
    longest = int(analysis.cohort.counts().max())
    words = f'Responses "{analysis.study.goal_label}" of {longest} per participant, mean'
    return KeyNumber("goal_answers", words, mean, mean - sd, mean + sd, "standard deviation", "answers")


def _validation(analysis: Analysis, validated: Validated) -> Iterator[KeyNumber]:
    """Yield the shares of the expected response to best, mid and worst, for three responses of which the highest is the
    goal, and the rate of preference for the aggregate's set, if there is one; in per cent."""
    counts, responses = validated.tables.confusion, analysis.study.responses
    if analysis.study.goal.is_highest and len(responses) == len(_ROLES) == len(counts):
        for role, label, (_, row) in zip(_ROLES, reversed(responses), counts.iterrows(), strict=True):
            if total := float(row.sum()):
                words = f'{role.capitalize()} set called "{label}"'
                yield KeyNumber(f"{role}_called", words, 100 * float(row[label]) / total)
    if validated.overall is not None:
        widest = validated.overall.loc[(validated.overall["high"] - validated.overall["low"]).idxmax()]
        share, low, high = (100 * float(widest[name]) for name in ("rate", "low", "high"))
        words = "Population optimum preferred to individual optima, of decided comparisons"
        yield KeyNumber("preferred", words, share, low, high, "95 % interval")


def _head(row) -> str:
    """Name of a row of the table, with the unit of its numbers; a number of responses has none."""
    return row.result if row.unit == "answers" else f"{row.result} ({row.unit})"


def _words(row) -> str:
    """Value of a row of the table with its range, as text without the unit: with the digits of the range, without one
    with one decimal.
    """
    if not np.isfinite(row.value):
        return "–"
    if not np.isfinite(row.low) or not np.isfinite(row.high):
        return f"{row.value:.1f}"
    value, low, high = (rounded(x, row.high - row.low) for x in (row.value, row.low, row.high))
    if row.range == "standard deviation":
        sd = row.high - row.value
        return f"{rounded(row.value, sd)} ± {rounded(sd, sd)}"
    return f"{value} ({row.range}: {low} to {high})"
