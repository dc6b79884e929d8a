"""Figure of the effect of each parameter: a panel for each, where a map of two or three parameters cannot show all."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from hilbo.report.figures.style import BLUE, ORANGE, label_axes, new_figure, score_label, star_at, styled
from hilbo.study.analysis.effects import Effect
from hilbo.study.config import Study

__all__ = ["effects_figure"]

_ACROSS = 4  # panels in a row


@styled
def effects_figure(study: Study, effects: Sequence[Effect], optimum: Float[np.ndarray, " d"]) -> Figure:
    """For each parameter the map along the slice through the optimum, with its standard deviation, and the main effect;
    all on one scale. Whole numbers and levels are points."""
    rows, across = -(-len(effects) // _ACROSS), min(len(effects), _ACROSS)
    best = np.asarray(study.space.to_physical(np.asarray(optimum)))
    figure, grid = new_figure(1.2 + 2.0 * across, 0.5 + 1.9 * rows, rows, across, sharey=True, squeeze=False)
    for axes in grid.ravel()[len(effects) :]:
        axes.remove()
    for i, (axes, effect) in enumerate(zip(grid.ravel(), effects, strict=False)):
        label_axes(axes, study, i, i)
        axes.set(yscale="linear", ylabel=score_label(study) if i % across == 0 else "")
        _draw(axes, effect, study.space.parameters[i].discrete, best[i])
    for axes in grid.ravel()[: len(effects)]:
        axes.autoscale(axis="y")
    labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(*labels, loc="outside upper center", ncols=3, frameon=False)
    return figure


def _draw(axes, effect: Effect, steps: bool, best: float) -> None:
    """Draw one panel on `axes`: lines for a continuous parameter, points with bars for a discrete one (`steps`); and
    the star at the optimum's value `best`.
    """
    slice_words, average_words = "through the optimum, ± sd", "on average (main effect)"
    if steps:
        bars = {"fmt": "o", "color": BLUE, "markersize": 4, "linewidth": 1}
        axes.errorbar(effect.values, effect.mean, yerr=effect.sd, label=slice_words, **bars)
        axes.plot(effect.values, effect.average, "D", color=ORANGE, markersize=4, label=average_words)
    else:
        low, high = effect.mean - effect.sd, effect.mean + effect.sd
        axes.fill_between(effect.values, low, high, color=BLUE, alpha=0.25, linewidth=0)
        axes.plot(effect.values, effect.mean, color=BLUE, label=slice_words)
        axes.plot(effect.values, effect.average, color=ORANGE, linestyle="--", label=average_words)
    star_at(axes, best, float(np.interp(best, effect.values, effect.mean)), "optimum")
