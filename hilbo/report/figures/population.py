"""Figures of aggregation: comparison of the methods, and the part of the space that the responses cover."""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from hilbo.numerics.host import to_device
from hilbo.report.figures.maps import curve, plane
from hilbo.report.figures.style import (
    BLUE,
    COLOURS,
    GREY,
    ONE_COLUMN,
    ORANGE,
    TWO_COLUMNS,
    few_ticks,
    label_axes,
    new_figure,
    styled,
)
from hilbo.study.config import Study

__all__ = ["coverage_figure", "reliability_figure", "rules_figure"]

_CELLS = 61


@styled
def rules_figure(content: dict[str, Any]) -> Figure:
    """Cross-validated prediction by every aggregation method. Left: negative log density minus the best one's (bars:
    two standard errors of the paired difference); right: share of responses in the central 95 %.

    `content`: of `rule_comparison.compare`; methods without a density are left out.
    """
    rules = {rule: entry for rule, entry in content["rules"].items() if "negative_log_density" in entry}
    order = sorted(rules, key=lambda rule: -rules[rule]["negative_log_density"])
    rows = np.arange(len(order))
    figure, (left, right) = new_figure(TWO_COLUMNS, 0.9 + 0.24 * len(order), 1, 2, sharey=True)
    for axes, key, scale, bars in ((left, "difference", 1.0, 2.0), (right, "central_95", 100.0, 1.0)):
        values = np.array([scale * rules[rule][key] for rule in order])
        errors = bars * scale * np.array([rules[rule][f"{key}_error"] for rule in order])
        axes.errorbar(values, rows, xerr=errors, fmt="o", color=BLUE, ecolor=GREY, markersize=4, linewidth=1)
        few_ticks(axes.xaxis, 5)
    left.axvline(0, color=ORANGE, linewidth=1)
    right.axvline(95, color=ORANGE, linewidth=1)
    left.set_yticks(rows, order)
    left.set_xlabel("loss above the best method (nats per response)")
    right.set_xlabel("responses in the central 95 % interval (%)")
    return figure


@styled
def reliability_figure(content: dict[str, Any]) -> Figure:
    """Calibration curve: observed frequency against predicted probability of a category, for "bcm" and "hierarchical".

    `content`: of `rule_comparison.compare`; a method without bins has an empty line.
    """
    figure, axes = new_figure(ONE_COLUMN, 3.0)
    axes.plot([0, 1], [0, 1], color=GREY, linewidth=1)
    for rule, colour, marker in (("bcm", ORANGE, "s"), ("hierarchical", BLUE, "o")):
        bins = content["rules"].get(rule, {}).get("reliability", [])
        points = [[b[key] for b in bins] for key in ("predicted", "observed")]
        axes.plot(*points, color=colour, marker=marker, markersize=4, linewidth=1, label=rule)
    axes.set(xlabel="predicted probability of a category", ylabel="observed frequency")
    axes.set(xlim=(0, 1), ylim=(0, 1))
    axes.legend(frameon=False)
    return figure


@styled
def coverage_figure(
    study: Study, predict: Callable[..., Any], point: Float[np.ndarray, " d"], prior: float, limit: float = 0.8
) -> Figure:
    """Standard deviation of the map over that without responses, on the slice of the first two free parameters
    through `point` (d,) of the unit cube; hatched where it is above `limit`.

    `predict`: points (m, d) -> mean and variance (m,); `prior`: variance of the map without responses.
    """
    figure, axes = new_figure(ONE_COLUMN, 2.9)
    hatch = {"hatch": "///", "facecolor": "none", "edgecolor": GREY, "linewidth": 0}
    if len(study.space.free) == 1:
        along, _, sd = curve(study, predict)
        ratio = sd / np.sqrt(prior)
        unknown = ratio > limit
        axes.plot(along, ratio, color=BLUE)
        axes.bar(along[unknown], 1.0, np.gradient(along)[unknown], **hatch)
        label_axes(axes, study, *2 * study.space.free[:1])
        axes.set(ylabel="posterior SD / prior SD", yscale="linear", ylim=(0, 1.05))
    else:
        across, up = study.space.free[:2]
        grid = plane(study, point, (across, up), cells=_CELLS)
        ratio = grid.image(np.sqrt(np.asarray(predict(to_device(grid.points))[1]) / prior))
        shown = axes.pcolormesh(*grid.sides, ratio, cmap=COLOURS, vmin=0, vmax=1, shading="nearest", rasterized=True)
        unknown = np.ma.masked_where(~(ratio > limit), ratio)
        axes.pcolor(*grid.sides, unknown, shading="nearest", rasterized=True, **hatch)
        figure.colorbar(shown, ax=axes, label="posterior SD / prior SD")
        label_axes(axes, study, across, up)
    return figure
