"""Figures of validation sessions: classes of the sets, preferences of their pairs, the aggregate's set against others'.

As in `maps`, a figure is a function from results to a matplotlib `Figure`, and nothing is shown or saved here. Shades
repeat the numbers written in the cells.
"""

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from hilbo.report.figures.style import BLUE, COLOURS, GREY, ORANGE, RED, TWO_COLUMNS, new_figure, plain, styled

__all__ = ["aggregate_best_figure", "preference_rows", "validation_figure"]


@styled
def validation_figure(confusion: pd.DataFrame, preferences: pd.DataFrame) -> Figure:
    """Left: how often each set (row) was put in each class (column). Right: how often one of a pair was preferred.

    `confusion`: counts, sets by classes; `preferences`: of `preferences.preference_rates`. Paper, figures 6b and 6c.
    """
    figure, (left, right) = new_figure(TWO_COLUMNS, 2.9, 1, 2, width_ratios=(1.0, 1.25))
    _matrix(left, confusion)
    _rates(right, preference_rows(preferences))
    return figure


@styled
def aggregate_best_figure(people: pd.DataFrame, overall: pd.DataFrame) -> Figure:
    """Figure of the share of comparisons in which the aggregate's set was preferred to an individual's, by person and
    overall.

    `people`: columns `name`, `rate`, `low`, `high`, a row for each person. `overall`: the rows of `preferences.rate`,
    of which the one with the widest interval is drawn.
    """
    best = _widest(overall)
    rows = np.arange(len(people))[::-1] + 1
    figure, axes = new_figure(5.2, 1.3 + 0.2 * len(people))
    axes.hlines(rows, people["low"], people["high"], color=BLUE, linewidth=1)
    axes.scatter(people["rate"], rows, s=22, color=BLUE, zorder=3, label="one participant (exact interval)")
    axes.hlines([0], best["low"], best["high"], color=RED, linewidth=2)
    axes.scatter([best["rate"]], [0], s=50, marker="D", color=RED, zorder=3, label=f"all ({best['errors']})")
    axes.axvline(0.5, color=GREY, linestyle="--", linewidth=1)
    axes.set_yticks([*rows, 0], [*people["name"], "all"], fontsize=7)
    axes.set(xlim=(0, 1), ylim=(-0.7, len(people) + 0.7), xlabel="proportion preferring the aggregate's set")
    figure.legend(loc="outside upper center", ncols=2, frameon=False)
    return figure


def preference_rows(preferences: pd.DataFrame) -> pd.DataFrame:
    """For each pair of sets the row of `preferences` with the widest interval (docs/methods/statistics.md)."""
    if preferences.empty:
        return preferences
    groups = preferences.groupby(["set", "over"], sort=False)
    return pd.DataFrame([_widest(rows) for _, rows in groups])


def _widest(rows):
    """The row with the widest interval among Wilson's and the clustered ones, or among the exact ones over participants
    if there are such, where all agreed; the first row of a pair that was only tied.
    """
    if "errors" not in rows or rows["errors"].isna().all():  # a pair that was only ever tied
        return rows.iloc[0]
    people = rows[rows["errors"].str.startswith("exact, of")]
    if len(people):
        return people.loc[(people["high"] - people["low"]).idxmax()]
    plain = rows[(rows["errors"] == "Wilson") | rows["errors"].str.startswith(("clustered", "jackknife"))]
    return plain.loc[(plain["high"] - plain["low"]).fillna(-1.0).idxmax()]


def _matrix(axes, counts):
    """Draw a confusion matrix on `axes`: share of each row and count in each cell, a dash in rows without responses."""
    totals = counts.to_numpy().sum(axis=1, keepdims=True)
    shares = np.divide(counts.to_numpy(), totals, out=np.zeros(counts.shape), where=totals > 0)
    axes.imshow(shares, cmap=COLOURS, vmin=0, vmax=1, aspect="auto")
    for (i, j), share in np.ndenumerate(shares):
        words = f"{100 * share:.0f} %\n{counts.iat[i, j]}" if totals[i, 0] else "–"
        axes.text(j, i, words, ha="center", va="center", color="white" if share < 0.6 else "black", fontsize=8)
    axes.set_xticks(range(counts.shape[1]), list(counts.columns))
    axes.set_yticks(range(counts.shape[0]), [str(name) for name in counts.index])
    axes.set(xlabel="response", ylabel="set")
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)


def _rates(axes, rows):
    """Draw preference rates with their intervals on `axes`, one row for each pair; a text if there are none."""
    axes.axvline(0.5, color=GREY, linestyle="--", linewidth=1)
    axes.set(xlim=(-0.02, 1.02), xlabel="proportion preferring the first")
    if rows.empty:
        axes.text(0.5, 0.5, "no preferences", ha="center", transform=axes.transAxes)
        return
    places = np.arange(len(rows))[::-1]
    if "low" in rows:
        axes.hlines(places, rows["low"], rows["high"], color=BLUE, linewidth=1.5)
    axes.scatter(rows["rate"], places, s=36, color=ORANGE, edgecolor="black", linewidth=0.6, zorder=3, clip_on=False)
    labels = [
        f"{plain(a)} over {plain(b)}\n{wins} of {wins + losses}" + (f", {ties} tied" if ties else "")
        for a, b, wins, losses, ties in zip(
            rows["set"], rows["over"], rows["wins"], rows["losses"], rows["ties"], strict=True
        )
    ]
    axes.set_yticks(places, labels)
    axes.set_ylim(-0.6, len(rows) - 0.4)
