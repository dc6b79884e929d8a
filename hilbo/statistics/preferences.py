"""Counts of validation sessions: classes of each set, preferences of each pair, rates with every kind of interval.

The rate of a pair is wins/(wins + losses); ties are counted separately, and modelled by `logits.tied_preferences`.
Wilson and Clopper-Pearson ("exact") intervals assume independent responses. The clustered ones are those of the logit's
intercept, mapped to rates, so that they stay within 0 and 1. If one set always won, errors cannot be clustered; then
the exact interval of the participants, who all agreed, is given in addition to that of the responses.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from scipy.special import expit
from scipy.stats import binomtest

from hilbo.errors import InputError
from hilbo.statistics.columns import check_level, is_yes_or_no, labels_of
from hilbo.statistics.logits import binary_logit
from hilbo.statistics.regression import Clusters
from hilbo.study.tables.validation import NONE, RESPONSES, TIE

__all__ = ["classifications", "confusion", "preference_rates", "rate"]

_INDEPENDENT = "all answers are independent"


def classifications(table: pd.DataFrame, responses: Sequence[str] = RESPONSES) -> pd.DataFrame:
    """One row per set shown and classified: `participant`, `set`, `class` and `category` (0 = lowest response).
    `table`: a checked validation table."""
    halves = [
        table[["participant", f"set_{side}", f"class_{side}"]].set_axis(["participant", "set", "class"], axis=1)
        for side in "ab"
    ]
    answers = pd.concat(halves)
    answers = answers[answers["class"] != NONE].reset_index(drop=True)
    return answers.assign(category=answers["class"].map({label: i for i, label in enumerate(responses)}).astype(int))


def confusion(table: pd.DataFrame, responses: Sequence[str] = RESPONSES, sets: Sequence[str] = ()) -> pd.DataFrame:
    """Confusion matrix: number of times each set (row) was put in each class (column, highest first). `sets`: the rows,
    by default all sets that were classified, sorted."""
    answers = classifications(table, responses)
    rows = list(sets) or sorted(answers["set"].unique())
    return pd.crosstab(answers["set"], answers["class"]).reindex(rows, columns=list(responses)[::-1], fill_value=0)


def rate(
    success: Sequence | np.ndarray | pd.Series, clusters: Clusters | None = None, *, level: float = 0.95
) -> pd.DataFrame:
    """Proportion of successes (n,) with every kind of interval.

    Columns `rate`, `errors`, `low`, `high`, `p_value` (of a rate of 1/2), `assumes`. Raises `InputError`.
    """
    check_level(level)
    hits = np.asarray(success)
    if hits.ndim != 1 or not is_yes_or_no(hits):
        raise InputError("a rate needs a list of 0 and 1 (or no and yes) that is not empty.")
    labels = labels_of(clusters, hits.size)
    test = binomtest(int(hits.sum()), hits.size)
    rows = [
        ("Wilson", *test.proportion_ci(level, "wilson"), np.nan, _INDEPENDENT),
        ("exact", *test.proportion_ci(level, "exact"), test.pvalue, _INDEPENDENT),
    ]
    if hits.min() == hits.max():
        rows += _unanimous(hits, labels, level)
    elif labels:
        fitted = binary_logit(hits, None, clusters, level=level).table
        fitted = fitted[fitted["errors"] != "iid"]
        fitted = fitted.assign(low=expit(fitted["low"]), high=expit(fitted["high"]))
        rows += fitted[["errors", "low", "high", "p_value", "assumes"]].itertuples(index=False, name=None)
    table = pd.DataFrame(rows, columns=["errors", "low", "high", "p_value", "assumes"])
    table.insert(0, "rate", float(hits.mean()))
    return table


def preference_rates(table: pd.DataFrame, sets: Sequence[str] = (), *, level: float = 0.95) -> pd.DataFrame:
    """For each pair of sets the rate at which the first was preferred: one row per pair and kind of interval.

    `sets`: the ones to compare, in the order in which a pair names them; default: all, sorted. Columns `set`, `over`,
    `comparisons`, `wins`, `losses`, `ties`, and those of `rate`, which a pair with ties only does not have. An empty
    table without preferences. Raises `InputError` for a `level` that is not between 0 and 1.
    """
    check_level(level)
    compared = table[table["preferred"] != NONE]
    names = list(sets) or sorted({*compared["set_a"], *compared["set_b"]})
    place = {name: i for i, name in enumerate(names)}
    compared = compared[compared["set_a"].isin(names) & compared["set_b"].isin(names)]
    turned = compared["set_a"].map(place) > compared["set_b"].map(place)
    one = compared["set_a"].mask(turned, compared["set_b"])
    other = compared["set_b"].mask(turned, compared["set_a"])
    blocks = []
    for (a, b), rows in compared.groupby([one.map(place), other.map(place)]):
        decided = rows[rows["preferred"] != TIE]
        won = (decided["preferred"] == names[a]).to_numpy()
        counts = {"set": names[a], "over": names[b], "comparisons": len(rows), "wins": int(won.sum())}
        counts |= {"losses": int((~won).sum()), "ties": len(rows) - len(decided)}
        rates = rate(won, decided[["participant"]], level=level) if len(won) else pd.DataFrame({"rate": [np.nan]})
        blocks.append(pd.DataFrame([counts] * len(rates)).join(rates))
    return pd.concat(blocks, ignore_index=True) if blocks else pd.DataFrame()


def _unanimous(
    hits: np.ndarray, labels: Mapping[str, np.ndarray], level: float
) -> list[tuple[str, float, float, float, str]]:
    """Rows of `rate`'s table for unanimous responses, one per clustering variable: exact interval of the proportion of
    clusters that agree in every response."""
    rows = []
    for name, codes in labels.items():
        people = int(codes.max()) + 1
        test = binomtest(people if hits[0] else 0, people)
        assumes = f"clusters of {name} are independent; share of them that agree in every answer"
        rows.append((f"exact, of {people} by {name}", *test.proportion_ci(level, "exact"), test.pvalue, assumes))
    return rows
