"""Figures of population maps: slices, progress over trials, individual optima; and the style that all figures share.

A figure is a function from results to a matplotlib `Figure`; nothing is shown or saved here. Maps use cividis and lines
the Okabe-Ito colours, which people with colour-blindness can tell apart. Axes are in physical units.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

from hilbo.study.aggregate import predict_map
from hilbo.study.analysis import Population
from hilbo.study.cohort import Cohort
from hilbo.study.config import Study
from hilbo.study.progress import Progress

__all__ = [
    "BLUE",
    "GREEN",
    "GREY",
    "ORANGE",
    "RED",
    "STYLE",
    "band",
    "grid_slice",
    "label_axes",
    "level_words",
    "map_panels",
    "map_slices",
    "maps_beside",
    "mark_trials",
    "moved_optima",
    "optima_scatter",
    "progress_figure",
    "sides",
    "slices_after",
    "star",
]

BLUE, ORANGE, GREEN, RED, GREY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#666666"
STYLE: dict = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.labelsize": 9,
    "legend.fontsize": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
}
_CELLS = 101
_NEAR = 0.08  # trials within this distance of a slice, in the unit cube, are drawn on it
_APART = 0.15  # between slices, in the unit cube
_OTHER: dict = {"s": 7, "marker": "o", "facecolor": "white", "edgecolor": "black", "linewidth": 0.4}
_TOP: dict = {"s": 16, "marker": "o", "facecolor": ORANGE, "edgecolor": "black", "linewidth": 0.5}


Surface = Callable[..., tuple[Any, Any]]
"""Mean and variance (m,) of a map at points (m, d) of the unit cube."""


def map_slices(study: Study, surface: Surface, optimum: Float[np.ndarray, " d"], cohort: Cohort) -> Figure:
    """Slices of the population map's mean through the optimum, the non-passive part white, near trials marked.

    The first two parameters span the slices; there is one at the optimum's value of the third, and one on either side.
    Further parameters stay at the optimum. With one parameter, the map is a curve with its standard deviation.
    `surface`: the map's mean and variance at points (m, d) of the unit cube.
    """
    if study.space.dim == 1:
        return _map_curve(study, surface, optimum, cohort)
    thirds = [None] if study.space.dim == 2 else _levels(float(optimum[2]))
    grids = [grid_slice(study, surface, optimum, third) for third in thirds]
    figure, panels, draw = map_panels(study, grids)
    for axes, third, values in zip(panels, thirds, grids, strict=True):
        draw(axes, values)
        mark_trials(axes, study, cohort, third)
        here = third is None or third == float(optimum[2])
        if here:
            star(axes, study, optimum)
        axes.set_title(
            "" if third is None else level_words(study, 2, third) + (" (optimum)" if here else ""), fontsize=9
        )
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
        axes.set_title(name + (f", {level_words(study, 2, third)}" if third is not None else ""), fontsize=9)
    return figure


def moved_optima(names: Sequence[str], moves: Float[ArrayLike, " M"], population_move: float, limit: float) -> Figure:
    """How far everybody's own optimum moved (dots, in order) and the population's (line), in % of the search ranges."""
    percent = 100 * np.asarray(moves)
    order, rows = np.argsort(percent), np.arange(len(percent))
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(4.6, 1.2 + 0.16 * len(percent)), layout="constrained")
        axes = figure.subplots()
        axes.scatter(percent[order], rows, s=20, color=np.where(percent[order] < 100 * limit, BLUE, ORANGE), zorder=3)
        axes.axvline(100 * population_move, color=RED, label="population map")
        axes.axvline(100 * limit, color=GREY, linestyle="--", linewidth=1, label=f"flagged from {100 * limit:g} %")
        axes.set_yticks(rows, [names[int(i)] for i in order], fontsize=7)
        axes.set(xlabel="NRMSE between the optima (%)", xlim=(0, None), ylim=(-0.7, len(percent) - 0.3))
        figure.legend(loc="outside upper center", ncols=2, frameon=False)
    return figure


def progress_figure(study: Study, population: Population, truth: Float[np.ndarray, " d"] | None = None) -> Figure:
    """How the optima settle (left, NRMSE to the last trial's, or to the truth), and answers in the top category."""
    progress, cohort = population.progress, population.cohort
    trials = progress.counts
    to_end, individual_errors = progress.to_end()
    from_goal = to_end
    if truth is not None:
        from_goal = np.sqrt(np.mean((progress.population - truth) ** 2, axis=1))
        individual_errors = np.sqrt(np.mean((progress.own - truth) ** 2, axis=2))
    top = np.asarray((cohort.trials.q == len(study.responses) - 1) & cohort.trials.mask)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 3.0), layout="constrained")
        left, right = figure.subplots(1, 2)
        goal = "the final optimum" if truth is None else "the truth"
        band(left, trials, 100 * individual_errors.T, BLUE, "individuals: median, quartiles")
        left.plot(trials, 100 * from_goal, color=RED, marker="o", markersize=3, label="population map")
        if truth is not None:
            left.plot(trials, 100 * to_end, color=GREY, linestyle="--", label="population map, to its final optimum")
        left.set(xlabel="trials of each participant", ylabel=f"NRMSE to {goal} (%)")
        left.set_ylim(0, left.get_ylim()[1] * 1.25)  # room for the legend
        left.legend(frameon=False, loc="upper right")
        band(right, trials, np.cumsum(top, axis=1)[:, trials - 1], GREEN, "median, quartiles")
        right.set(xlabel="trials of each participant", ylabel=f'answers "{study.responses[-1]}" so far', ylim=(0, None))
        right.legend(frameon=False, loc="upper left")
        for axes in (left, right):
            axes.xaxis.get_major_locator().set_params(integer=True)
    return figure


def optima_scatter(study: Study, optima: Float[np.ndarray, "M d"], marks: dict[str, Float[np.ndarray, " d"]]) -> Figure:
    """Everybody's own optimum, pair by pair of parameters, with named points (the population optimum, ...)."""
    d = study.space.dim
    pairs = [(0, 1), (0, 2), (1, 2)] if d > 2 else [(0, d - 1)]
    physical = np.asarray(study.space.to_physical(optima))
    points = {name: np.asarray(study.space.to_physical(x)) for name, x in marks.items()}
    styles = (("*", RED, 140), ("X", ORANGE, 60), ("P", "black", 60), ("D", GREEN, 40))
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.4 if len(pairs) > 1 else 4.0, 2.9), layout="constrained")
        for axes, (i, j) in zip(_row(figure, len(pairs)), pairs, strict=True):
            axes.scatter(
                physical[:, i], physical[:, j], s=20, color=BLUE, alpha=0.7, label="individuals", clip_on=False
            )
            for (name, point), (marker, colour, size) in zip(points.items(), styles, strict=False):
                look = {"marker": marker, "s": size, "color": colour, "edgecolor": "white", "linewidth": 0.6}
                axes.scatter(point[i], point[j], label=name, zorder=3, clip_on=False, **look)
            label_axes(axes, study, i, j)
        labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(*labels, loc="outside upper center", ncols=4 if len(pairs) > 1 else 2, frameon=False)
    return figure


def _row(figure, count):
    return np.atleast_1d(figure.subplots(1, count))


def _levels(third):
    """The optimum's value of the third parameter and one on either side, as far as the unit cube goes."""
    beside = (third - _APART, third + _APART)
    if beside[0] < 0:
        beside = (third + _APART, third + 2 * _APART)
    elif beside[1] > 1:
        beside = (third - 2 * _APART, third - _APART)
    return sorted((third, *beside))


def map_panels(study: Study, grids):
    """A figure with a panel for each grid, and what draws a grid on one, all on one colour scale."""
    low, high = min(np.nanmin(g) for g in grids), max(np.nanmax(g) for g in grids)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(4.0 if len(grids) == 1 else 7.4, 2.7), layout="constrained")
        panels = np.atleast_1d(figure.subplots(1, len(grids), sharey=True))
        scale = ScalarMappable(Normalize(low, high), "cividis")
        figure.colorbar(scale, ax=list(panels), label=f"{study.attribute} f (mean)", fraction=0.05, pad=0.02)
        for axes in panels:
            label_axes(axes, study, 0, 1)
        for axes in panels[1:]:
            axes.set_ylabel("")

    def draw(axes, values):
        first, second = sides(study)
        axes.pcolormesh(first, second, values, cmap="cividis", norm=scale.norm, shading="nearest", rasterized=True)

    return figure, panels, draw


def sides(study: Study) -> list[np.ndarray]:
    """Physical values of the first two parameters along a slice."""
    side = np.linspace(0.0, 1.0, _CELLS)
    return [np.asarray(p.to_physical(jnp.asarray(side))) for p in study.space.parameters[:2]]


def grid_slice(
    study: Study, surface: Surface, optimum: Float[ArrayLike, " d"], third: float | None
) -> Float[np.ndarray, "c c"]:
    """Mean of the population map over the first two parameters, NaN where nothing may be rendered."""
    side = np.linspace(0.0, 1.0, _CELLS)
    x = np.tile(np.asarray(optimum, float), (_CELLS, _CELLS, 1))
    x[..., 0], x[..., 1] = np.meshgrid(side, side)
    if third is not None:
        x[..., 2] = third
    flat = jnp.asarray(x.reshape(-1, x.shape[-1]))
    mean = np.asarray(surface(flat)[0])
    return np.where(np.asarray(study.space.feasible(flat)), mean, np.nan).reshape(_CELLS, _CELLS)


def _curve(study: Study, surface: Surface) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Physical values, mean and standard deviation of a map of one parameter."""
    side = jnp.linspace(0.0, 1.0, _CELLS)
    mean, variance = surface(side[:, None])
    return np.asarray(study.space.parameters[0].to_physical(side)), np.asarray(mean), np.sqrt(np.asarray(variance))


def _curve_axes(study):
    figure = Figure(figsize=(4.5, 2.9), layout="constrained")
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
        mask = np.asarray(cohort.trials.mask)
        answers = np.asarray(study.space.to_physical(np.asarray(cohort.trials.x)[mask]))[:, 0]
        top = np.asarray(cohort.trials.q)[mask] == len(study.responses) - 1
        for shown, height, look in ((~top, 0.03, _OTHER), (top, 0.08, _TOP)):
            at_height = np.full(int(shown.sum()), height)
            axes.scatter(answers[shown], at_height, transform=axes.get_xaxis_transform(), clip_on=False, **look)
        best = np.asarray(study.space.to_physical(np.asarray(optimum)))[0]
        axes.axvline(float(best), color=RED, linewidth=1, label="optimum")
        axes.legend(frameon=False)
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


def label_axes(axes, study: Study, i: int, j: int) -> None:
    """Names, units, limits and scales of two parameters."""
    for which, parameter in (("x", study.space.parameters[i]), ("y", study.space.parameters[j])):
        unit = f" ({_unit(parameter.unit)})" if parameter.unit else ""
        getattr(axes, f"set_{which}label")(_name(parameter.name) + unit)
        getattr(axes, f"set_{which}lim")(parameter.low, parameter.high)
        if parameter.scale == "log":
            getattr(axes, f"set_{which}scale")("log")
            axis = getattr(axes, f"{which}axis")
            axis.set_major_locator(LogLocator(subs=(1.0,) if parameter.high > 20 * parameter.low else (1.0, 3.0, 5.0)))
            axis.set_major_formatter(FormatStrFormatter("%g"))
            axis.set_minor_formatter(NullFormatter())


def _name(name: str) -> str:
    symbols = {"alpha": "α", "K1": "$K_1$", "B1": "$B_1$"}
    return symbols[name] if name in symbols else name.replace("_", " ")


def _unit(unit):
    return unit.replace("s^alpha", "s$^α$").replace(".", "·")


def level_words(study: Study, index: int, unit_value: float) -> str:
    """A parameter's name and physical value."""
    parameter = study.space.parameters[index]
    value = float(parameter.to_physical(jnp.asarray(float(unit_value))))
    return f"{_name(parameter.name)} = {value:.3g} {parameter.unit}".strip()


def mark_trials(axes, study: Study, cohort: Cohort, third: float | None) -> None:
    """Renderings that were asked near a slice, those with the highest answer filled."""
    mask = np.asarray(cohort.trials.mask)
    x, q = np.asarray(cohort.trials.x)[mask], np.asarray(cohort.trials.q)[mask]
    near = np.ones(len(x), bool) if third is None else np.abs(x[:, 2] - third) < _NEAR
    physical = np.asarray(study.space.to_physical(x))[near]
    top = q[near] == len(study.responses) - 1
    axes.scatter(*physical[~top, :2].T, **_OTHER)
    axes.scatter(*physical[top, :2].T, **_TOP)


def star(axes, study: Study, x, pair: tuple[int, int] = (0, 1)) -> None:
    """An optimum, on axes of two of the parameters."""
    point = np.asarray(study.space.to_physical(np.asarray(x)))[list(pair)]
    axes.plot(*point, marker="*", markersize=13, color=RED, markeredgecolor="white", clip_on=False)


def band(axes, trials, values, colour: str, label: str) -> None:
    """Median over the first axis of `values` as a line, quartiles as a band; NaN is left out."""
    low, middle, high = np.nanpercentile(values, [25, 50, 75], axis=0)
    axes.fill_between(trials, low, high, color=colour, alpha=0.25, linewidth=0)
    axes.plot(trials, middle, color=colour, label=label)
