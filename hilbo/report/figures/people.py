"""Figures of participants and their responses: response quality, and the posterior predictive check."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib.figure import Figure

from hilbo.report.figures.style import BLUE, GREY, ONE_COLUMN, ORANGE, TWO_COLUMNS, legend, new_figure, plain, styled

__all__ = ["people_figure", "predictive_check"]


@styled
def people_figure(people: pd.DataFrame, left_out: Mapping[str, str]) -> Figure:
    """Consistency, lapse rate and drift of every participant: a line for the 95 % interval, a mark for the estimate if
    there is one; orange crosses: excluded participants.

    `people`: of `measure_people`; `left_out`: excluded participant -> reason.
    """
    rows = np.arange(len(people))[::-1]
    out = people["participant"].isin(list(left_out)).to_numpy()
    figure, panels = new_figure(TWO_COLUMNS, 1.2 + 0.14 * max(len(people), 4), 1, 3, sharey=True)
    words = ("test–retest agreement", "lapse rate", "drift (prior SD)")
    for axes, measure, label in zip(panels, ("consistency", "lapse", "drift"), words, strict=True):
        value, low, high = (people[f"{measure}{end}"].to_numpy(float) for end in ("", "_low", "_high"))
        limits = (-3.5, 3.5) if measure == "drift" else (-0.03, 1.03)
        for part, color, mark in ((~out, BLUE, {"s": 16}), (out, ORANGE, {"s": 26, "marker": "x"})):
            ends = np.maximum(low[part], limits[0]), np.minimum(high[part], limits[1])
            axes.hlines(rows[part], *ends, color=color, linewidth=1)
            known = part & np.isfinite(value)
            axes.scatter(value[known], rows[known], color=color, zorder=3, **mark)
        axes.set(xlabel=label, xlim=limits)
    panels[2].axvline(0, color=GREY, linestyle="--", linewidth=1)
    panels[0].set_yticks(rows, list(people["participant"]), fontsize=6)
    return figure


@styled
def predictive_check(
    responses: Sequence[str], observed: Float[np.ndarray, " C"], predicted: Float[np.ndarray, "draws C"]
) -> Figure:
    """Observed response proportions (bars), and those of responses drawn from the posterior (median, 95 % interval).

    `observed` (C,), `predicted` (draws, C): fractions.
    """
    positions = np.arange(len(responses))
    low, middle, high = 100 * np.percentile(predicted, [2.5, 50, 97.5], axis=0)
    figure, axes = new_figure(ONE_COLUMN, 2.5)
    look = {"width": 0.6, "color": "#dddddd", "edgecolor": "black", "linewidth": 0.6}
    axes.bar(positions, 100 * observed, label="observed", **look)
    axes.vlines(positions, low, high, color=BLUE, linewidth=2)
    axes.scatter(positions, middle, s=26, color=BLUE, zorder=3, label="replicated")
    axes.set_xticks(positions, [*map(plain, responses)])
    axes.set(ylabel="proportion of responses (%)", ylim=(0, None))
    legend(figure, axes.get_legend_handles_labels()[0])
    return figure
