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
from jaxtyping import Bool, Float
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from hilbo.numerics.host import to_device
from hilbo.report.figures.answers import answer_handles, mark_along, mark_trials
from hilbo.report.figures.style import (
    BLUE,
    COLOURS,
    GREEN,
    GREY,
    ONE_COLUMN,
    ORANGE,
    RED,
    TWO_COLUMNS,
    few_ticks,
    label_axes,
    legend,
    level_words,
    new_figure,
    plain,
    score_label,
    star,
    star_at,
    styled,
    title,
)
from hilbo.study.analysis.progress import Progress
from hilbo.study.cohort import Cohort
from hilbo.study.config import Study
from hilbo.study.estimate.optimum import predict_map

__all__ = [
    "Plane",
    "Slice",
    "along",
    "curve",
    "draw_curve",
    "grid_slice",
    "map_handles",
    "map_panels",
    "map_slices",
    "maps_beside",
    "moved_optima",
    "optima_scatter",
    "plane",
    "slices_after",
    "third_of",
    "third_words",
]

_CELLS = 101
_MEANS, _SDS = 8, 4  # contours of a map, about
_APART = 0.15  # between slices, in the unit cube


Surface = Callable[..., tuple[Any, Any]]
"""Mean and variance (m,) of a map at points (m, d) of the unit cube."""


class Slice(NamedTuple):
    """Mean and standard deviation (r, c) of a map over the first two free parameters, NaN where not feasible; and the
    physical values of these parameters (c,) and (r,)."""

    mean: Float[np.ndarray, "r c"]
    sd: Float[np.ndarray, "r c"]
    sides: tuple[np.ndarray, np.ndarray]


def map_slices(study: Study, surface: Surface, optimum: Float[np.ndarray, " d"], cohort: Cohort) -> Figure:
    """Slices of the population map's mean through the optimum, with trials near them; infeasible points are white.

    The first two free parameters span the slices; there is one at the optimum's value of the third, and one on either
    side. Further ones stay at the optimum, and dependent ones follow from the study's equalities. With one free
    parameter, the map is a curve with its standard deviation.
    `surface`: the map's mean and variance at points (m, d) of the unit cube; `optimum` (d,): in the unit cube.
    """
    if len(study.space.free) == 1:
        return _map_curve(study, surface, optimum, cohort)
    at = third_of(study)
    thirds = [None] if at is None else _slice_values(study.space.parameters[at], float(optimum[at]))
    grids = [grid_slice(study, surface, optimum, third) for third in thirds]
    figure, panels, draw = map_panels(study, grids)
    counts = []
    for axes, third, values in zip(panels, thirds, grids, strict=True):
        draw(axes, values)
        counts.append(mark_trials(axes, study, cohort, third))
        here = at is None or third == float(optimum[at])
        if here:
            star(axes, study, optimum)
        title(axes, third_words(study, third) + (" (optimum)" if at is not None and here else ""))
    legend(figure, [*answer_handles(study, np.concatenate(counts)), *map_handles(study)])
    return figure


def slices_after(study: Study, progress: Progress) -> Figure:
    """Population maps after the first few numbers of trials side by side, each sliced through its own optimum (the
    star).
    """
    maps = {f"{count} trials": partial(predict_map, map_) for count, map_ in progress.maps.items()}
    return maps_beside(study, maps, progress.population[progress.at(progress.moments)])


def maps_beside(
    study: Study, maps: Mapping[str, Surface], optima: Float[np.ndarray, "k d"], *, own_scales: bool = False
) -> Figure:
    """Named population maps side by side, each sliced through its own optimum (the star).

    `optima` (k, d): in the unit cube, in the order of the maps; `own_scales`: each map has a colour scale of its own,
    as for latent scores of different hyperparameters. With one parameter the means are curves on one panel.
    """
    if len(study.space.free) == 1:
        return _curves_beside(study, maps, optima)
    at = third_of(study)
    thirds = [None if at is None else float(x[at]) for x in optima]
    grids = [
        grid_slice(study, surface, x, third) for surface, x, third in zip(maps.values(), optima, thirds, strict=True)
    ]
    figure, panels, draw = map_panels(study, grids, own_scales=own_scales)
    for axes, name, x, third, values in zip(panels, maps, optima, thirds, grids, strict=True):
        draw(axes, values)
        star(axes, study, x)
        title(axes, third_words(study, third, f"{name}, ") or name)
    return figure


@styled
def moved_optima(names: Sequence[str], moves: Float[ArrayLike, " M"], population_move: float, limit: float) -> Figure:
    """NRMSE between each participant's two optima (dots, sorted) and between the population's (line), in per cent.

    `moves` (M,), `population_move` and `limit`, from which a shift is flagged: NRMSE, fractions of the search ranges.
    """
    percent = 100 * np.asarray(moves)
    order, rows = np.argsort(percent), np.arange(len(percent))
    figure, axes = new_figure(ONE_COLUMN, 1.2 + 0.14 * len(percent))
    axes.scatter(percent[order], rows, s=20, color=np.where(percent[order] < 100 * limit, BLUE, ORANGE), zorder=3)
    axes.axvline(100 * population_move, color=RED, label="population map")
    axes.axvline(100 * limit, color=GREY, linestyle="--", linewidth=1, label=f"flagged from {100 * limit:g} %")
    axes.set_yticks(rows, [plain(names[int(i)]) for i in order], fontsize=7)
    axes.set(xlabel="NRMSE between the optima (%)", xlim=(0, None), ylim=(-0.7, len(percent) - 0.3))
    legend(figure, axes.get_legend_handles_labels()[0])
    return figure


@styled
def optima_scatter(study: Study, optima: Float[np.ndarray, "M d"], marks: dict[str, Float[np.ndarray, " d"]]) -> Figure:
    """Individual optima (M, d), pair by pair of the first three parameters, with named points `marks`, such as the
    population optimum, the star, which is the first; all in the unit cube.
    """
    d = study.space.dim
    pairs = [(0, 1), (0, 2), (1, 2)] if d > 2 else [(0, d - 1)]
    physical = np.asarray(study.space.to_physical(optima))
    styles = (("X", ORANGE, 60), ("P", "black", 60), ("D", GREEN, 40))
    (first, best), *others = marks.items()
    figure, panels = new_figure(TWO_COLUMNS if len(pairs) > 1 else ONE_COLUMN, 2.7, 1, len(pairs), squeeze=False)
    for axes, (i, j) in zip(panels[0], pairs, strict=True):
        axes.scatter(physical[:, i], physical[:, j], s=20, color=BLUE, alpha=0.7, label="individuals", clip_on=False)
        point = np.asarray(study.space.to_physical(best))
        star_at(axes, point[i], point[j], first)
        for (name, x), (marker, colour, size) in zip(others, styles, strict=False):
            point = np.asarray(study.space.to_physical(x))
            look = {"marker": marker, "s": size, "color": colour, "edgecolor": "white", "linewidth": 0.6}
            axes.scatter(point[i], point[j], label=name, zorder=6, clip_on=False, **look)
        label_axes(axes, study, i, j)
    legend(figure, panels[0, 0].get_legend_handles_labels()[0])
    return figure


def _slice_values(parameter, third):
    """Three values of the third parameter in the unit cube, sorted: the optimum's (`third`) and one on either side;
    near the edge of the cube both others on the inner side.

    For a categorical parameter up to three of its levels; for other discrete ones the distinct steps, which may be
    fewer.
    """
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


@styled
def map_panels(study: Study, grids, *, own_scales: bool = False):
    """A figure with a panel for each grid, its list of panels (axes), and a function (axes, grid) that draws a grid on
    one.

    `grids`: of `grid_slice`; all have one colour scale, unless `own_scales`. Contours are drawn only between numeric
    parameters.
    """
    size = (ONE_COLUMN, 2.9) if len(grids) == 1 else (TWO_COLUMNS, 2.6)
    figure, ((*panels,),) = new_figure(*size, 1, len(grids), sharey=True, squeeze=False)
    scales = {}
    together = [([axes], [grid]) for axes, grid in zip(panels, grids, strict=True)] if own_scales else [(panels, grids)]
    for shared, of in together:
        heights = np.concatenate([g.mean.ravel() for g in of])
        scale = ScalarMappable(Normalize(np.nanmin(heights), np.nanmax(heights)), COLOURS)
        scales |= dict.fromkeys(shared, scale.norm)
        label = score_label(study) if shared[-1] is panels[-1] else ""
        few_ticks(figure.colorbar(scale, ax=shared, label=label, fraction=0.05, pad=0.02).ax.yaxis, 5)
    for axes in panels:
        label_axes(axes, study, *study.space.free[:2])
    for axes in panels[1:]:
        axes.set_ylabel("")

    def draw(axes, values):
        mean, sd, sides = values
        axes.pcolormesh(*sides, mean, cmap=COLOURS, norm=scales[axes], shading="nearest", rasterized=True)
        # Nothing may be rendered, or nothing is between the steps.
        if np.isnan(mean).all() or min(mean.shape) < 2 or not _has_lines(study):
            return
        if np.nanmax(mean) > np.nanmin(mean):
            axes.contour(*sides, mean, levels=_MEANS, colors="white", linewidths=0.4, linestyles="solid")
        if np.nanmax(sd) > np.nanmin(sd):
            lines = axes.contour(*sides, sd, levels=_SDS, colors="black", linewidths=0.7, linestyles="dotted")
            axes.clabel(lines, fmt="%.2g", fontsize=6)

    return figure, panels, draw


def _has_lines(study: Study) -> bool:
    """Whether a map has contours: not if one of the first two parameters is categorical."""
    return not any(study.space.parameters[i].levels for i in study.space.free[:2])


def map_handles(study: Study) -> list[Any]:
    """Legend handles for a map's contours: mean and standard deviation; an empty list if it has none."""
    if not _has_lines(study):
        return []
    white = Line2D([], [], color="#bbbbbb", linewidth=0.8, label="mean")
    return [white, Line2D([], [], color="black", linewidth=0.8, linestyle="dotted", label="standard deviation")]


class Plane(NamedTuple):
    """A grid over two parameters, rows upwards: its `points` (r * c, d) of the unit cube, the physical values of both
    parameters (c,) and (r,), and which points are feasible (r, c)."""

    points: Float[np.ndarray, "rc d"]
    sides: tuple[np.ndarray, np.ndarray]
    feasible: Bool[np.ndarray, "r c"]

    def image(self, values: ArrayLike) -> Float[np.ndarray, "r c"]:
        """Values (r * c,) of the points as a grid (r, c), NaN where a point is not feasible."""
        return np.where(self.feasible, np.asarray(values).reshape(self.feasible.shape), np.nan)


def third_of(study: Study) -> int | None:
    """Index of the third free parameter, at values of which slices are shown; None if there are two or one."""
    return study.space.free[2] if len(study.space.free) > 2 else None


def third_words(study: Study, third: float | None, before: str = "") -> str:
    """Text `before` and the third free parameter with its value `third` (unit cube) on a slice; "" if that is None."""
    at = third_of(study)
    return "" if at is None or third is None else before + level_words(study, at, third)


def plane(study: Study, point: Float[ArrayLike, " d"], pair: tuple[int, int], cells: int = _CELLS) -> Plane:
    """Grid of `cells` values of each of two parameters (fewer for discrete ones), with the others as in `point` (d,) of
    the unit cube, but those that the study's equalities determine. `pair`: indices of the parameters across and up.
    """
    searched = [study.space.parameters[k] for k in pair]
    axes = [p.axis(cells) for p in searched]
    grid = np.tile(np.asarray(point, float), (len(axes[1]), len(axes[0]), 1))
    grid[..., pair[0]], grid[..., pair[1]] = np.meshgrid(*axes)
    points = np.asarray(study.space.completed(grid.reshape(-1, grid.shape[-1]), pair))
    across, up = (np.asarray(p.to_physical(axis)) for p, axis in zip(searched, axes, strict=True))
    return Plane(points, (across, up), np.asarray(study.space.feasible(points)).reshape(grid.shape[:-1]))


def grid_slice(study: Study, surface: Surface, optimum: Float[ArrayLike, " d"], third: float | None) -> Slice:
    """Mean and standard deviation of a map over the first two free parameters, NaN where not feasible.

    `optimum` (d,) of the unit cube: where the other parameters are; `third`: value of the third one instead, in the
    unit cube too, or None. `surface`: points (m, d) -> mean and variance (m,). Needs two free parameters.
    """
    point = np.array(optimum, float)
    if third is not None:
        point[third_of(study)] = third
    across, up = study.space.free[:2]
    grid = plane(study, point, (across, up))
    mean, variance = map(grid.image, surface(to_device(grid.points)))
    return Slice(mean, np.sqrt(variance), grid.sides)


def curve(study: Study, surface: Surface) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Physical values, mean and standard deviation of a map of one free parameter, (m,) each; of a discrete one at its
    values alone. NaN where an equality leaves nothing."""
    side, points = along(study)
    mean, variance = surface(to_device(points))
    inside = np.asarray(study.space.feasible(points))
    mean, sd = np.where(inside, np.asarray(mean), np.nan), np.where(inside, np.sqrt(np.asarray(variance)), np.nan)
    return np.asarray(study.space.parameters[study.space.free[0]].to_physical(side)), mean, sd


def along(study: Study) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m d"]]:
    """Values (m,) of the only free parameter on [0, 1], and their points (m, d) of the unit cube."""
    index = study.space.free[0]
    side = np.asarray(study.space.parameters[index].axis(_CELLS))
    points = np.zeros((len(side), study.space.dim))
    points[:, index] = side
    return side, np.asarray(study.space.completed(points))


def label_curve(axes, study: Study) -> None:
    """Label `axes` for a map of one parameter: its values across, the latent score up."""
    label_axes(axes, study, *2 * study.space.free[:1])
    axes.set(yscale="linear", ylabel=score_label(study))


def draw_curve(axes, study: Study, curve: Sequence[np.ndarray], sd_label: str = "", label: str = "") -> None:
    """Draw a map of one parameter with a band of its standard deviation on `axes`, and label them.

    `curve`: physical values, mean, and standard deviation, (m,) each; `sd_label`, `label`: legend texts of band and
    line.
    """
    physical, mean, sd = curve
    label_curve(axes, study)
    axes.fill_between(physical, mean - sd, mean + sd, color=BLUE, alpha=0.25, linewidth=0, label=sd_label)
    axes.plot(physical, mean, color=BLUE, label=label)
    axes.autoscale(axis="y")


@styled
def _map_curve(study, surface, optimum, cohort):
    """Figure of `map_slices` for one parameter: the map's curve, the responses, and a star at the optimum."""
    figure, axes = new_figure(ONE_COLUMN, 2.5)
    physical, mean, sd = curve(study, surface)
    draw_curve(axes, study, (physical, mean, sd), "± standard deviation", "population map")
    counts = mark_along(axes, study, cohort)
    best = np.asarray(study.space.to_physical(np.asarray(optimum)))[study.space.free[0]]
    star_at(axes, float(best), float(np.interp(best, physical, mean)), "optimum")
    legend(figure, [*axes.get_legend_handles_labels()[0], *answer_handles(study, counts, discs=False)])
    return figure


@styled
def _curves_beside(study, maps, optima):
    """Figure of `maps_beside` for one parameter: at most four maps' means on one panel, each with its optimum."""
    figure, axes = new_figure(ONE_COLUMN, 2.5)
    label_curve(axes, study)
    shades = mpl.colormaps[COLOURS](np.linspace(0.85, 0.0, len(maps)))  # the more trials, the darker
    for (name, surface), x, colour, dashes in zip(maps.items(), optima, shades, ("-", "--", "-.", ":"), strict=False):
        physical, mean, _ = curve(study, surface)
        axes.plot(physical, mean, color=colour, linestyle=dashes, label=name)
        best = float(np.asarray(study.space.to_physical(np.asarray(x)))[study.space.free[0]])
        star_at(axes, best, float(np.interp(best, physical, mean)))
    axes.autoscale(axis="y")
    axes.legend(frameon=False)
    return figure
