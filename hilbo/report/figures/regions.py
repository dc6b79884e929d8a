"""Figure of class regions: the most probable response around an optimum, and tolerance intervals (paper, figure 8)."""

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from hilbo.report.figures.maps import along, plane
from hilbo.report.figures.style import (
    COLOURS,
    RED,
    TWO_COLUMNS,
    label_axes,
    legend,
    new_figure,
    plain,
    star,
    styled,
    title,
)
from hilbo.study.analysis.analysis import Reading
from hilbo.study.analysis.tolerance import slice_through

__all__ = ["class_regions"]


@styled
def class_regions(readings: Mapping[str, Reading]) -> Figure:
    """The most probable response around the optimum of each of several analyses, and its tolerance intervals. Paper,
    figure 8.

    One row for each reading (fixed and optimised hyperparameters), with slices of the first free parameter with the
    second and with the third; of two free parameters or one, the readings are side by side. White: infeasible.
    """
    study = next(iter(readings.values())).study
    free, labels = study.space.free, [*map(plain, study.responses)]
    pairs = [(free[0], j) for j in (free[1:3] or free)]
    shades = ListedColormap(mpl.colormaps[COLOURS](np.linspace(0.12, 1.0, len(labels))))
    rows, across = (len(readings), len(pairs)) if len(pairs) > 1 else (1, len(readings))
    figure, grid = new_figure(TWO_COLUMNS, 2.4 * rows + 0.4, rows, across, squeeze=False)
    for (name, reading), row in zip(readings.items(), grid.reshape(len(readings), len(pairs)), strict=True):
        for axes, (i, j) in zip(row, pairs, strict=True):
            if len(free) == 1:
                _class_curves(axes, reading, shades)
            else:
                _regions(axes, reading, i, j, shades)
            title(axes, name)
    handles: list[Any] = [
        Patch(facecolor=shades(k), edgecolor="black", linewidth=0.5, label=label) for k, label in enumerate(labels)
    ]
    handles.append(Line2D([], [], color=RED, linewidth=2, label="tolerance interval"))
    legend(figure, handles)
    return figure


def _regions(axes, reading, i, j, shades):
    """Draw the most probable response over parameters `i` and `j` through the optimum on `axes`, in the colours
    `shades`, with both tolerance intervals and the optimum.
    """
    study, best = reading.study, np.asarray(reading.aggregate.optimum.x)
    grid = plane(study, best, (i, j))
    likeliest = np.argmax(np.asarray(_probabilities(reading, jnp.asarray(grid.points))), axis=1)
    label_axes(axes, study, i, j)
    scale = {"vmin": -0.5, "vmax": len(study.responses) - 0.5}
    axes.pcolormesh(*grid.sides, grid.image(likeliest), cmap=shades, **scale, shading="nearest", rasterized=True)
    for index in (i, j):
        _interval(axes, reading, index, i, j)
    star(axes, study, best, (i, j))


def _interval(axes, reading, index, i, j):
    """Draw the tolerance interval of parameter `index` on `axes` of parameters `i` and `j`, as a line along the slice
    on which it was computed, with dots at the ends; nothing if there is none.
    """
    study = reading.study
    parameter = study.space.parameters[index]
    interval, _ = reading.tolerances.get(parameter.name, (None, None))  # levels have none
    if interval is None:
        return
    ends = np.asarray(parameter.to_unit(jnp.asarray([interval.low, interval.high])))
    points, _ = slice_through(study, reading.aggregate.optimum.x, parameter.name, jnp.linspace(ends[0], ends[1], 65))
    physical = np.asarray(study.space.to_physical(points))
    axes.plot(physical[:, i], physical[:, j], color=RED, linewidth=2, solid_capstyle="butt")
    axes.plot(physical[[0, -1], i], physical[[0, -1], j], linestyle="", marker="o", color=RED, markersize=3.5)


def _class_curves(axes, reading, shades):
    """Draw the probabilities of the responses over the only parameter on `axes`, stacked, in the colours `shades`, with
    the tolerance interval if there is one.
    """
    study = reading.study
    index = study.space.free[0]
    side, points = along(study)
    side, points = (values[np.asarray(study.space.feasible(points))] for values in (side, points))
    physical_side = np.asarray(study.space.parameters[index].to_physical(side))
    chances = np.asarray(_probabilities(reading, jnp.asarray(points))).T
    label_axes(axes, study, index, index)
    axes.stackplot(physical_side, chances, colors=[shades(k) for k in range(len(chances))])
    interval, _ = reading.tolerances.get(study.space.parameters[index].name, (None, None))
    if interval is not None:
        axes.hlines(0.5, interval.low, interval.high, color=RED, linewidth=2)
    axes.set(yscale="linear", ylabel="probability of each response", ylim=(0, 1))


def _probabilities(reading, x):
    """Probabilities (m, C) of a new participant's responses at points (m, d) of the unit cube, by one reading."""
    return reading.aggregate.class_probabilities(reading.study.gp.likelihood, x)
