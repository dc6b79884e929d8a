"""The figure of `hilbo power`: errors against trials, one line for each number of participants."""

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from hilbo.report.figures.style import BLUE, GREEN, GREY, ORANGE, RED, TWO_COLUMNS, few_ticks, new_figure, styled

__all__ = ["power_figure"]

_LOOKS = [
    (RED, "o", "-"),
    (ORANGE, "s", "--"),
    (GREEN, "^", "-."),
    (BLUE, "D", ":"),
    ("black", "v", "-"),
    (GREY, "P", "--"),
]


@styled
def power_figure(summary: pd.DataFrame, error: float) -> Figure:
    """Median error of the optimum with quartiles, share of studies within `error`, and median error of the map.

    `summary`: of `power.summarise`. Lines differ by colour, marker and dashes.
    """
    figure, (left, middle, right) = new_figure(TWO_COLUMNS, 2.7, 1, 3)
    shift = 0.25 * (summary["trials"].max() - summary["trials"].min() + 1) / 25
    for i, (count, rows) in enumerate(summary.groupby("participants")):
        colour, marker, dashes = _LOOKS[i % len(_LOOKS)]
        look = {"color": colour, "marker": marker, "linestyle": dashes, "markersize": 4, "linewidth": 1.2}
        trials, label = rows["trials"], f"{count} participants"
        left.plot(trials, 100 * rows["optimum_median"], label=label, **look)
        left.vlines(trials + shift * (i - 1), 100 * rows["optimum_low"], 100 * rows["optimum_high"], color=colour,
                    linewidth=0.8, alpha=0.7)  # fmt: skip
        below, above = rows["reached"] - rows["reached_low"], rows["reached_high"] - rows["reached"]
        bars = 100 * np.maximum([below, above], 0.0)  # 0 and 1 end their own intervals, to rounding
        middle.errorbar(trials + shift * (i - 1), 100 * rows["reached"], yerr=bars, capsize=2, **look)
        right.plot(trials, rows["map_median"], **look)
    left.axhline(100 * error, color=GREY, linewidth=0.8)
    left.set(ylabel="error of the optimum, NRMSE (%)", ylim=(0, None))
    middle.set(ylabel=f"studies within {100 * error:g} % (%)", ylim=(0, 100))
    right.set(ylabel="error of the map, P(goal)", ylim=(0, None))
    for axes in (left, middle, right):
        axes.set_xlabel("trials of each participant")
        few_ticks(axes.xaxis, 5, integer=True)
        few_ticks(axes.yaxis, 5)
    figure.legend(*left.get_legend_handles_labels(), loc="outside upper center", ncols=4, frameon=False)
    return figure
