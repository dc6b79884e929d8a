"""Every figure; the only module that imports matplotlib.

A figure is a function from results to a matplotlib `Figure`; nothing is shown or saved here. Maps use cividis and lines
the Okabe-Ito colours, which people with colour-blindness can tell apart. Axes are in physical units.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from jaxtyping import Float, Int
from matplotlib.figure import Figure

from hilbo.config import Study
from hilbo.study import Cohort, fit_cohort, population

__all__ = ["map_slices", "optima_scatter", "progress_figure", "slices_after"]

BLUE, ORANGE, GREEN, RED, GREY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#666666"
_STYLE: dict = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.labelsize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
}
_CELLS = 61
_NEAR = 0.08  # trials within this distance of a slice, in the unit cube, are drawn on it


def map_slices(
    study: Study, posteriors, optimum: Float[np.ndarray, " d"], cohort: Cohort, levels=(0.25, 0.5)
) -> Figure:
    """Slices of the population map's mean through the optimum, the non-passive part white, near trials marked.

    The first two parameters span the slices; for a third one there is a slice at the optimum and at the quantiles
    `levels` of its range beside it. The optimum is the star.
    """
    thirds = [None] if study.space.dim == 2 else sorted({round(float(v), 3) for v in (optimum[2], *levels)})
    grids = [_slice(study, posteriors, optimum, third) for third in thirds]
    low, high = _limits(grids)
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(3.3 * len(grids) + 0.9, 3.2), layout="constrained")
        for axes, third, values in zip(_row(figure, len(grids)), thirds, grids, strict=True):
            image = _draw_slice(axes, study, values, low, high)
            _mark_trials(axes, study, cohort, third)
            if third is None or abs(third - optimum[2]) < 1e-2:
                _star(axes, study, optimum)
            axes.set_title("population map" if third is None else _level(study, 2, third))
        figure.colorbar(image, ax=figure.axes, label="perceived realism f (mean)")
    return figure


def slices_after(study: Study, cohort: Cohort, optima: Float[np.ndarray, "k d"], counts: Sequence[int]) -> Figure:
    """The population map after the first `counts` trials of everybody, each at its own optimum (the star)."""
    grids = [
        _slice(study, fit_cohort(study, cohort.first(n)), x, x[2] if len(x) > 2 else None)
        for n, x in zip(counts, optima, strict=True)
    ]
    low, high = _limits(grids)
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(3.3 * len(grids) + 0.9, 3.2), layout="constrained")
        for axes, count, x, values in zip(_row(figure, len(grids)), counts, optima, grids, strict=True):
            image = _draw_slice(axes, study, values, low, high)
            _star(axes, study, x)
            level = f", {_level(study, 2, x[2])}" if study.space.dim > 2 else ""
            axes.set_title(f"after {count} trials{level}")
        figure.colorbar(image, ax=figure.axes, label="perceived realism f (mean)")
    return figure


def progress_figure(
    study: Study,
    cohort: Cohort,
    population_optima: Float[np.ndarray, "p d"],
    individual: Float[np.ndarray, "p M d"],
    truth: Float[np.ndarray, " d"] | None = None,
    counts: Int[np.ndarray, " p"] | None = None,
) -> Figure:
    """How the optima settle (left, NRMSE to the last trial's, or to the truth), and answers in the top category."""
    trials = np.arange(1, len(population_optima) + 1) if counts is None else counts
    reference = population_optima[-1] if truth is None else truth
    target = individual[-1] if truth is None else np.broadcast_to(truth, individual.shape[1:])
    own = np.sqrt(np.mean((individual - target) ** 2, axis=2))
    merged = np.sqrt(np.mean((population_optima - reference) ** 2, axis=1))
    top = np.cumsum(np.asarray((cohort.trials.q == len(study.responses) - 1) & cohort.trials.mask), axis=1)[
        :, trials - 1
    ]
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(7.2, 3.0), layout="constrained")
        left, right = figure.subplots(1, 2)
        _band(left, trials, 100 * own.T, BLUE, "individuals: median, quartiles")
        left.plot(trials, 100 * merged, color=RED, marker="o", markersize=3, label="population map")
        left.set(xlabel="trials of each participant", ylim=(0, None))
        left.set_ylabel(f"NRMSE to {'the final optimum' if truth is None else 'the truth'} (%)")
        left.legend(frameon=False)
        _band(right, trials, top, GREEN, "median, quartiles")
        right.set(xlabel="trials of each participant", ylabel=f'answers "{study.responses[-1]}" so far', ylim=(0, None))
        right.legend(frameon=False, loc="upper left")
    return figure


def optima_scatter(study: Study, optima: Float[np.ndarray, "M d"], marks: dict[str, Float[np.ndarray, " d"]]) -> Figure:
    """Everybody's own optimum, pair by pair of parameters, with named points (the population optimum, ...)."""
    pairs = [(0, 1), (0, 2), (1, 2)] if study.space.dim > 2 else [(0, 1)]
    physical = np.asarray(study.space.to_physical(optima))
    styles = zip(
        marks.items(), (("*", RED, 140), ("X", ORANGE, 60), ("P", "black", 60), ("D", GREEN, 40)), strict=False
    )
    styles = list(styles)
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(3.2 * len(pairs), 3.2), layout="constrained")
        for axes, (i, j) in zip(_row(figure, len(pairs)), pairs, strict=True):
            axes.scatter(physical[:, i], physical[:, j], s=22, color=BLUE, alpha=0.7, label="individuals")
            for (name, x), (marker, colour, size) in styles:
                point = np.asarray(study.space.to_physical(x))
                axes.scatter(
                    point[i], point[j], marker=marker, s=size, color=colour, edgecolor="white", label=name, zorder=3
                )
            _axes(axes, study, i, j)
        figure.axes[0].legend(frameon=True, fontsize=8)
    return figure


def _row(figure, count):
    return np.atleast_1d(figure.subplots(1, count))


def _slice(study, posteriors, optimum, third):
    """Mean of the population map over the first two parameters, NaN where nothing may be rendered."""
    side = np.linspace(0.0, 1.0, _CELLS)
    x = np.tile(np.asarray(optimum, float), (_CELLS, _CELLS, 1))
    x[..., 0], x[..., 1] = np.meshgrid(side, side)
    if third is not None:
        x[..., 2] = third
    flat = jnp.asarray(x.reshape(-1, x.shape[-1]))
    mean = np.asarray(population(posteriors, flat)[0])
    return np.where(np.asarray(study.space.feasible(flat)), mean, np.nan).reshape(_CELLS, _CELLS)


def _limits(grids):
    return min(np.nanmin(g) for g in grids), max(np.nanmax(g) for g in grids)


def _draw_slice(axes, study, values, low, high):
    side = np.linspace(0.0, 1.0, _CELLS)
    first, second = (np.asarray(p.to_physical(jnp.asarray(side))) for p in study.space.parameters[:2])
    image = axes.pcolormesh(
        first, second, values, cmap="cividis", vmin=low, vmax=high, shading="nearest", rasterized=True
    )
    _axes(axes, study, 0, 1)
    return image


def _axes(axes, study, i, j):
    for which, parameter in (("x", study.space.parameters[i]), ("y", study.space.parameters[j])):
        unit = f" ({_unit(parameter.unit)})" if parameter.unit else ""
        getattr(axes, f"set_{which}label")(_name(parameter.name) + unit)
        getattr(axes, f"set_{which}scale")("log" if parameter.scale == "log" else "linear")
        getattr(axes, f"set_{which}lim")(parameter.low, parameter.high)


def _name(name: str) -> str:
    symbols = {"alpha": "α", "K1": "$K_1$", "B1": "$B_1$"}
    return symbols[name] if name in symbols else name.replace("_", " ")


def _unit(unit):
    return unit.replace("s^alpha", "s$^α$").replace(".", "·")


def _level(study, index, unit_value):
    parameter = study.space.parameters[index]
    value = float(parameter.to_physical(jnp.asarray(float(unit_value))))
    return f"{_name(parameter.name)} = {value:.3g} {parameter.unit}".strip()


def _mark_trials(axes, study, cohort, third):
    mask = np.asarray(cohort.trials.mask)
    x, q = np.asarray(cohort.trials.x)[mask], np.asarray(cohort.trials.q)[mask]
    near = np.ones(len(x), bool) if third is None else np.abs(x[:, 2] - third) < _NEAR
    physical = np.asarray(study.space.to_physical(x))[near]
    top = q[near] == len(study.responses) - 1
    axes.scatter(*physical[~top, :2].T, s=7, marker="x", color="white", linewidth=0.7, alpha=0.8)
    axes.scatter(*physical[top, :2].T, s=13, marker="o", facecolor="none", edgecolor=ORANGE, linewidth=0.9)


def _star(axes, study, x):
    point = np.asarray(study.space.to_physical(np.asarray(x)))
    axes.plot(point[0], point[1], marker="*", markersize=13, color=RED, markeredgecolor="white", clip_on=False)


def _band(axes, trials, values, colour, label):
    low, middle, high = np.percentile(values, [25, 50, 75], axis=0)
    axes.fill_between(trials, low, high, color=colour, alpha=0.25, linewidth=0)
    axes.plot(trials, middle, color=colour, label=label)
