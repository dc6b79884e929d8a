"""Figures of population maps: slices, progress over trials, individual optima.

A figure is a function from results to a matplotlib `Figure`; nothing is shown or saved here. Axes are in physical
units.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from hilbo.numerics.host import to_device
from hilbo.report.figures.answers import answer_handles, mark_along, mark_trials
from hilbo.report.figures.style import (
    BLUE,
    GREEN,
    GREY,
    ONE_COLUMN,
    ORANGE,
    RED,
    STYLE,
    TWO_COLUMNS,
    few_ticks,
    label_axes,
    legend,
    level_words,
    star,
    title,
)
from hilbo.study.analysis.progress import Progress
from hilbo.study.cohort import Cohort
from hilbo.study.config import Study
from hilbo.study.estimate.optimum import predict_map

__all__ = [
    "Slice",
    "grid_slice",
    "map_handles",
    "map_panels",
    "map_slices",
    "maps_beside",
    "moved_optima",
    "optima_scatter",
    "sides",
    "slices_after",
]

_CELLS = 101
_MEANS, _SDS = 8, 4  # contours of a map, about
_APART = 0.15  # between slices, in the unit cube


Surface = Callable[..., tuple[Any, Any]]
"""Mean and variance (m,) of a map at points (m, d) of the unit cube."""


class Slice(NamedTuple):
    """Mean and standard deviation (r, c) of a map over the first two parameters, NaN where nothing may be rendered."""

    mean: Float[np.ndarray, "r c"]
    sd: Float[np.ndarray, "r c"]


def map_slices(study: Study, surface: Surface, optimum: Float[np.ndarray, " d"], cohort: Cohort) -> Figure:
    """Slices of the population map's mean through the optimum, the non-passive part white, near trials marked.

    The first two parameters span the slices; there is one at the optimum's value of the third, and one on either side.
    Further parameters stay at the optimum. With one parameter, the map is a curve with its standard deviation.
    `surface`: the map's mean and variance at points (m, d) of the unit cube.
    """
    if study.space.dim == 1:
        return _map_curve(study, surface, optimum, cohort)
    thirds = [None] if study.space.dim == 2 else _levels(study.space.parameters[2], float(optimum[2]))
    grids = [grid_slice(study, surface, optimum, third) for third in thirds]
    figure, panels, draw = map_panels(study, grids)
    counts = []
    for axes, third, values in zip(panels, thirds, grids, strict=True):
        draw(axes, values)
        counts.append(mark_trials(axes, study, cohort, third))
        here = third is None or third == float(optimum[2])
        if here:
            star(axes, study, optimum)
        title(axes, "" if third is None else level_words(study, 2, third) + (" (optimum)" if here else ""))
    legend(figure, [*answer_handles(study, np.concatenate(counts)), *map_handles(study)])
    return figure


def slices_after(study: Study, progress: Progress) -> Figure:
    """The population map after the first trials of everybody, each at its own optimum (the star)."""
    maps = {f"{count} trials": partial(predict_map, map_) for count, map_ in progress.maps.items()}
    return maps_beside(study, maps, progress.population[progress.at(progress.moments)])


def maps_beside(study: Study, maps: Mapping[str, Surface], optima: Float[np.ndarray, "k d"]) -> Figure:
    """Named population maps side by side, each sliced through its own optimum (the star), on one colour scale."""
    if study.space.dim == 1:
        return _curves_beside(study, maps, optima)
    thirds = [float(x[2]) if study.space.dim > 2 else None for x in optima]
    grids = [
        grid_slice(study, surface, x, third) for surface, x, third in zip(maps.values(), optima, thirds, strict=True)
    ]
    figure, panels, draw = map_panels(study, grids)
    for axes, name, x, third, values in zip(panels, maps, optima, thirds, grids, strict=True):
        draw(axes, values)
        star(axes, study, x)
        title(axes, name + (f", {level_words(study, 2, third)}" if third is not None else ""))
    return figure


def moved_optima(names: Sequence[str], moves: Float[ArrayLike, " M"], population_move: float, limit: float) -> Figure:
    """How far everybody's own optimum moved (dots, in order) and the population's (line), in % of the search ranges."""
    percent = 100 * np.asarray(moves)
    order, rows = np.argsort(percent), np.arange(len(percent))
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(ONE_COLUMN, 1.2 + 0.14 * len(percent)), layout="constrained")
        axes = figure.subplots()
        axes.scatter(percent[order], rows, s=20, color=np.where(percent[order] < 100 * limit, BLUE, ORANGE), zorder=3)
        axes.axvline(100 * population_move, color=RED, label="population map")
        axes.axvline(100 * limit, color=GREY, linestyle="--", linewidth=1, label=f"flagged from {100 * limit:g} %")
        axes.set_yticks(rows, [names[int(i)] for i in order], fontsize=7)
        axes.set(xlabel="NRMSE between the optima (%)", xlim=(0, None), ylim=(-0.7, len(percent) - 0.3))
        legend(figure, axes.get_legend_handles_labels()[0])
    return figure


def optima_scatter(study: Study, optima: Float[np.ndarray, "M d"], marks: dict[str, Float[np.ndarray, " d"]]) -> Figure:
    """Everybody's own optimum, pair by pair of parameters, with named points (the population optimum, ...)."""
    d = study.space.dim
    pairs = [(0, 1), (0, 2), (1, 2)] if d > 2 else [(0, d - 1)]
    physical = np.asarray(study.space.to_physical(optima))
    points = {name: np.asarray(study.space.to_physical(x)) for name, x in marks.items()}
    styles = (("*", RED, 140), ("X", ORANGE, 60), ("P", "black", 60), ("D", GREEN, 40))
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(TWO_COLUMNS if len(pairs) > 1 else ONE_COLUMN, 2.7), layout="constrained")
        for axes, (i, j) in zip(_row(figure, len(pairs)), pairs, strict=True):
            axes.scatter(
                physical[:, i], physical[:, j], s=20, color=BLUE, alpha=0.7, label="individuals", clip_on=False
            )
            for (name, point), (marker, colour, size) in zip(points.items(), styles, strict=False):
                look = {"marker": marker, "s": size, "color": colour, "edgecolor": "white", "linewidth": 0.6}
                axes.scatter(point[i], point[j], label=name, zorder=3, clip_on=False, **look)
            label_axes(axes, study, i, j)
        labels = figure.axes[0].get_legend_handles_labels()
        legend(figure, labels[0])
    return figure


def _row(figure, count):
    return np.atleast_1d(figure.subplots(1, count))


def _levels(parameter, third):
    """The optimum's value of the third parameter and one on either side, as far as the unit cube goes; of levels all,
    up to three."""
    if parameter.levels:
        others = [x for x in parameter.axis(parameter.steps).tolist() if abs(x - third) > 1e-9]
        return sorted((third, *others[:2]))
    beside = (third - _APART, third + _APART)
    if beside[0] < 0:
        beside = (third + _APART, third + 2 * _APART)
    elif beside[1] > 1:
        beside = (third - 2 * _APART, third - _APART)
    if parameter.discrete:
        beside = np.unique(np.asarray(parameter.to_unit(parameter.to_physical(np.asarray(beside))))).tolist()
        return sorted({third, *(x for x in beside if abs(x - third) > 1e-9)})
    return sorted((third, *beside))


def map_panels(study: Study, grids):
    """A figure with a panel for each grid, and what draws a grid on one, all on one colour scale."""
    heights = np.concatenate([g.mean.ravel() for g in grids])
    low, high = np.nanmin(heights), np.nanmax(heights)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(ONE_COLUMN, 2.9) if len(grids) == 1 else (TWO_COLUMNS, 2.6), layout="constrained")
        panels = np.atleast_1d(figure.subplots(1, len(grids), sharey=True))
        scale = ScalarMappable(Normalize(low, high), "cividis")
        bar = figure.colorbar(scale, ax=list(panels), label=f"{study.attribute} f", fraction=0.05, pad=0.02)
        few_ticks(bar.ax.yaxis, 5)
        for axes in panels:
            label_axes(axes, study, 0, 1)
        for axes in panels[1:]:
            axes.set_ylabel("")

    def draw(axes, values):
        first, second = sides(study)
        mean, sd = values
        axes.pcolormesh(first, second, mean, cmap="cividis", norm=scale.norm, shading="nearest", rasterized=True)
        if np.isnan(mean).all() or min(mean.shape) < 2:  # nothing may be rendered, or nothing is between the steps
            return
        if not _has_lines(study):
            return
        if np.nanmax(mean) > np.nanmin(mean):
            axes.contour(first, second, mean, levels=_MEANS, colors="white", linewidths=0.4, linestyles="solid")
        if np.nanmax(sd) > np.nanmin(sd):
            lines = axes.contour(first, second, sd, levels=_SDS, colors="black", linewidths=0.7, linestyles="dotted")
            axes.clabel(lines, fmt="%.2g", fontsize=6)

    return figure, panels, draw


def _has_lines(study: Study) -> bool:
    """Whether a map has contours: between levels there is nothing."""
    return not any(p.levels for p in study.space.parameters[:2])


def map_handles(study: Study) -> list[Any]:
    """What a legend shows of a map's lines."""
    if not _has_lines(study):
        return []
    white = Line2D([], [], color="#bbbbbb", linewidth=0.8, label="mean")
    return [white, Line2D([], [], color="black", linewidth=0.8, linestyle="dotted", label="standard deviation")]


def sides(study: Study) -> list[np.ndarray]:
    """Physical values of the first two parameters along a slice."""
    return [np.asarray(p.to_physical(p.axis(_CELLS))) for p in study.space.parameters[:2]]


def grid_slice(study: Study, surface: Surface, optimum: Float[ArrayLike, " d"], third: float | None) -> Slice:
    """A map over the first two parameters, at `third` of the third; `optimum` (d,): where the others stay."""
    first, second = (p.axis(_CELLS) for p in study.space.parameters[:2])
    x = np.tile(np.asarray(optimum, float), (len(second), len(first), 1))
    x[..., 0], x[..., 1] = np.meshgrid(first, second)
    if third is not None:
        x[..., 2] = third
    flat = x.reshape(-1, x.shape[-1])
    feasible = np.asarray(study.space.feasible(flat))
    mean, variance = (np.where(feasible, np.asarray(m), np.nan).reshape(x.shape[:-1]) for m in surface(to_device(flat)))
    return Slice(mean, np.sqrt(variance))


def _curve(study: Study, surface: Surface) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Physical values, mean and standard deviation of a map of one parameter."""
    side = np.asarray(study.space.parameters[0].axis(_CELLS))
    mean, variance = surface(to_device(side[:, None]))
    return np.asarray(study.space.parameters[0].to_physical(side)), np.asarray(mean), np.sqrt(np.asarray(variance))


def _curve_axes(study):
    figure = Figure(figsize=(ONE_COLUMN, 2.5), layout="constrained")
    axes = figure.subplots()
    label_axes(axes, study, 0, 0)
    axes.set(yscale="linear", ylabel=f"{study.attribute} f")
    return figure, axes


def _map_curve(study, surface, optimum, cohort):
    with mpl.rc_context(STYLE):
        figure, axes = _curve_axes(study)
        physical, mean, sd = _curve(study, surface)
        axes.fill_between(
            physical, mean - sd, mean + sd, color=BLUE, alpha=0.25, linewidth=0, label="± standard deviation"
        )
        axes.plot(physical, mean, color=BLUE, label="population map")
        axes.autoscale(axis="y")
        counts = mark_along(axes, study, cohort)
        best = np.asarray(study.space.to_physical(np.asarray(optimum)))[0]
        axes.axvline(float(best), color=RED, linewidth=1, label="optimum")
        legend(figure, [*axes.get_legend_handles_labels()[0], *answer_handles(study, counts, discs=False)])
    return figure


def _curves_beside(study, maps, optima):
    with mpl.rc_context(STYLE):
        figure, axes = _curve_axes(study)
        for (name, surface), x, colour in zip(maps.items(), optima, (ORANGE, GREEN, BLUE, RED), strict=False):
            physical, mean, _ = _curve(study, surface)
            axes.plot(physical, mean, color=colour, label=name)
            best = float(np.asarray(study.space.to_physical(np.asarray(x)))[0])
            axes.plot(best, np.interp(best, physical, mean), "*", color=colour, markersize=11, markeredgecolor="white")
        axes.autoscale(axis="y")
        axes.legend(frameon=False)
    return figure
