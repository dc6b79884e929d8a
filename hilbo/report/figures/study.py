"""Figures of a study's report, beside the paper's figures 4 to 8.

As in `maps`, a figure is a function from results to a matplotlib `Figure`. What differs does so by shape, hatching
or words too, never by colour alone: the pages are printed, and read by the colour-blind.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
import pandas as pd
from jax.typing import ArrayLike
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from hilbo.report.figures.answers import answer_handles, mark_trials
from hilbo.report.figures.maps import Slice, grid_slice, map_handles, map_panels, maps_beside, sides
from hilbo.report.figures.style import (
    BLUE,
    GREEN,
    GREY,
    ONE_COLUMN,
    ORANGE,
    RED,
    STYLE,
    TWO_COLUMNS,
    band,
    few_ticks,
    label_axes,
    legend,
    level_words,
    star,
    title,
)
from hilbo.search.apart import nrmse
from hilbo.study.analysis import Analysis
from hilbo.study.cohort import Cohort
from hilbo.study.config import Study
from hilbo.study.map_summary import Sets
from hilbo.study.progress import Progress

__all__ = [
    "individual_convergence",
    "people_figure",
    "population_convergence",
    "posterior_progress",
    "predictive_check",
    "sets_on_map",
    "typical_person",
]

UNKNOWN = 0.8
"""Share of its standard deviation without answers above which a map is drawn as not sampled."""
_MARKS = {"best": ("*", 170, GREEN), "mid": ("D", 45, ORANGE), "worst": ("X", 80, RED)}
_CELLS = 101


def typical_person(analysis: Analysis) -> int:
    """Whose own optimum is nearest to the median distance from the population's: shown as the example."""
    x, best = np.asarray(analysis.aggregate.individuals.x), np.asarray(analysis.aggregate.optimum.x)
    miss = np.asarray(nrmse(x, best, analysis.study.gp.kernel.levels))
    return int(np.argsort(miss, kind="stable")[(len(miss) - 1) // 2])


def posterior_progress(study: Study, cohort: Cohort, progress: Progress, row: int) -> Figure:
    """One participant's posterior mean after their first trials, sliced at their final third parameter.

    Paper, figure 4.
    """
    person, optima = cohort.rows(np.array([row])), progress.individual[progress.at(progress.moments), row]
    maps = {f"{count} trials": posterior.predict for count, posterior in progress.person(row).items()}
    if study.space.dim == 1:
        return maps_beside(study, maps, optima)
    third = float(optima[-1][2]) if study.space.dim > 2 else None
    grids = [grid_slice(study, predict, optima[-1], third) for predict in maps.values()]
    figure, panels, draw = map_panels(study, grids)
    counts = []
    for axes, name, n, x, values in zip(panels, maps, progress.moments, optima, grids, strict=True):
        draw(axes, values)
        counts.append(mark_trials(axes, study, person.first(n), third))
        star(axes, study, x)
        title(axes, name if third is None else f"{name}, {level_words(study, 2, third)}")
    legend(figure, [*answer_handles(study, np.concatenate(counts)), *map_handles()])
    return figure


def individual_convergence(study: Study, cohort: Cohort, progress: Progress) -> Figure:
    """Left: everybody's running optimum against their final one, and against that of a half of the people without them.
    Right: answers in the highest category so far.

    Median and quartiles over people. Paper, figure 5.
    """
    trials, (_, errors) = progress.counts, progress.to_end()
    top = np.asarray((cohort.trials.q == len(study.responses) - 1) & cohort.trials.mask)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(TWO_COLUMNS, 2.6), layout="constrained")
        left, right = figure.subplots(1, 2)
        band(left, trials, 100 * errors.T, BLUE, "to their own final optimum")
        if progress.splits:
            others = 100 * np.nanmedian(np.where(np.isnan(errors), np.nan, progress.individual_to_half), axis=1)
            left.plot(trials, others, color=GREY, linestyle="--", label="to that of half of the others")
        left.set(xlabel="trials", ylabel="NRMSE of individual optima (%)", ylim=(0, None))
        left.legend(frameon=False)
        band(right, trials, np.cumsum(top, axis=1)[:, trials - 1], GREEN, "median, quartiles")
        right.set(xlabel="trials", ylabel=f'answers "{study.responses[-1]}" so far', ylim=(0, None))
        right.legend(frameon=False, loc="upper left")
        few_ticks(right.yaxis, 5, integer=True)
        for axes in (left, right):
            few_ticks(axes.xaxis, 6, integer=True)
    return figure


def population_convergence(progress: Progress, references: Mapping[str, Float[np.ndarray, " d"]]) -> Figure:
    """The population's running optimum against its final one, and against named references (system identification,
    the truth); dashed, that of one half of the people against the other half's. Paper, figure 7b."""
    looks = [(RED, "o", "-"), (BLUE, "s", "--"), (GREEN, "^", "-.")]
    targets = {"its final optimum": progress.population[-1]} | dict(references)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(ONE_COLUMN, 2.7), layout="constrained")
        axes = figure.subplots()
        for (name, x), (colour, marker, dashes) in zip(targets.items(), looks, strict=False):
            miss = 100 * np.asarray(nrmse(progress.population, x, progress.levels))
            axes.plot(
                progress.counts, miss, color=colour, marker=marker, linestyle=dashes, markersize=3.5, label=f"to {name}"
            )
        if progress.splits:
            halves = 100 * np.median(progress.halves, axis=1)
            axes.plot(progress.counts, halves, color=GREY, linestyle="--", label="between halves")
        axes.set(xlabel="trials of each participant", ylabel="NRMSE of the population optimum (%)", ylim=(0, None))
        few_ticks(axes.xaxis, 6, integer=True)
        legend(figure, axes.get_legend_handles_labels()[0])
    return figure


def sets_on_map(
    study: Study, surface, sets: Sets | None, best: Float[np.ndarray, " d"], cohort: Cohort, prior: ArrayLike
) -> tuple[Figure, bool]:
    """The population map through its best, mid and worst sets, hatched where it is hardly sampled, and whether there
    is such a part. Paper, figure 6a. `prior`: the map's variance where nobody answered (`RuleMap.map_prior`)."""
    points: dict[str, Any] = {"best": best}
    if sets is not None:
        points = dict(zip(_MARKS, np.asarray(sets.x), strict=True))
    if study.space.dim == 1:
        return _sets_on_curve(study, surface, points), False
    thirds = {name: float(x[2]) for name, x in points.items()} if study.space.dim > 2 else {"best": None}
    grids = [grid_slice(study, surface, best, third) for third in thirds.values()]
    figure, panels, draw = map_panels(study, grids)
    hatched, counts = False, []
    for axes, (name, third), values in zip(panels, thirds.items(), grids, strict=True):
        draw(axes, values)
        hatched |= _hatch(axes, study, values, prior)
        counts.append(mark_trials(axes, study, cohort, third))
        for shown in points if third is None else [name]:
            _mark(axes, study, shown, points[shown])
        title(axes, "" if third is None else f"{level_words(study, 2, third)} ({name})")
    handles: list[Any] = [
        Line2D([], [], linestyle="", marker=_MARKS[n][0], color=_MARKS[n][2], markeredgecolor="black", label=n)
        for n in points
    ]
    handles += [*answer_handles(study, np.concatenate(counts)), *map_handles()]
    if hatched:
        handles.append(Patch(facecolor="white", edgecolor="black", hatch="////", label="hardly sampled"))
    legend(figure, handles)
    return figure, hatched


def _hatch(axes, study: Study, values: Slice, prior: ArrayLike) -> bool:
    """Hatch what is feasible and of which the map knows less than `UNKNOWN`; whether there is such a part."""
    unknown = (values.sd > UNKNOWN * np.sqrt(np.asarray(prior))).astype(float)  # NaN is not
    if unknown.any():
        with mpl.rc_context({"hatch.linewidth": 0.5, "hatch.color": "white"}):
            axes.contourf(*sides(study), unknown, levels=[0.5, 1.5], colors="none", hatches=["////"])
    return bool(unknown.any())


def _mark(axes, study, name, x):
    marker, size, colour = _MARKS[name]
    point = np.asarray(study.space.to_physical(np.asarray(x)))
    axes.scatter(
        *point[:2], marker=marker, s=size, color=colour, edgecolor="black", linewidth=0.7, zorder=5, clip_on=False
    )


def _sets_on_curve(study, surface, points):
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(ONE_COLUMN, 2.6), layout="constrained")
        axes = figure.subplots()
        side = jnp.linspace(0.0, 1.0, _CELLS)
        mean, variance = (np.asarray(moment) for moment in surface(side[:, None]))
        physical_side, sd = np.asarray(study.space.parameters[0].to_physical(side)), np.sqrt(variance)
        label_axes(axes, study, 0, 0)
        axes.fill_between(physical_side, mean - sd, mean + sd, color=BLUE, alpha=0.25, linewidth=0)
        axes.plot(physical_side, mean, color=BLUE)
        for name, x in points.items():
            marker, size, colour = _MARKS[name]
            physical = np.asarray(study.space.to_physical(np.asarray(x)))
            height = float(surface(jnp.asarray(x)[None, :])[0][0])
            axes.scatter(
                physical[0], height, marker=marker, s=size, color=colour, edgecolor="black", label=name, zorder=3
            )
        axes.set(yscale="linear", ylabel=f"{study.attribute} f")
        axes.autoscale(axis="y")
        axes.legend(frameon=False)
    return figure


def people_figure(people: pd.DataFrame, left_out: Mapping[str, str]) -> Figure:
    """Consistency, lapse rate and drift of every participant, each with its 95 % interval; crosses: left out."""
    rows = np.arange(len(people))[::-1]
    out = people["participant"].isin(list(left_out)).to_numpy()
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(TWO_COLUMNS, 1.2 + 0.14 * max(len(people), 4)), layout="constrained")
        panels = figure.subplots(1, 3, sharey=True)
        words = ("agreement of repeats", "lapse rate", "drift (prior standard deviations)")
        for axes, measure, label in zip(panels, ("consistency", "lapse", "drift"), words, strict=True):
            value, low, high = (people[f"{measure}{end}"].to_numpy(float) for end in ("", "_low", "_high"))
            finite = np.isfinite(value)
            limits = (-3.5, 3.5) if measure == "drift" else (-0.03, 1.03)
            axes.hlines(
                rows[finite],
                np.maximum(low, limits[0])[finite],
                np.minimum(high, limits[1])[finite],
                color=BLUE,
                linewidth=1,
            )
            axes.scatter(value[finite & ~out], rows[finite & ~out], s=16, color=BLUE, zorder=3)
            axes.scatter(value[finite & out], rows[finite & out], s=26, marker="x", color=RED, zorder=3)
            axes.set(xlabel=label, xlim=limits)
        panels[2].axvline(0, color=GREY, linestyle="--", linewidth=1)
        panels[0].set_yticks(rows, list(people["participant"]), fontsize=6)
    return figure


def predictive_check(
    responses: Sequence[str], observed: Float[np.ndarray, " C"], predicted: Float[np.ndarray, "draws C"]
) -> Figure:
    """Shares of the answers given, and of those that the posterior would give again."""
    positions = np.arange(len(responses))
    low, middle, high = 100 * np.percentile(predicted, [2.5, 50, 97.5], axis=0)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(ONE_COLUMN, 2.5), layout="constrained")
        axes = figure.subplots()
        axes.bar(
            positions,
            100 * observed,
            width=0.6,
            color="#c9d9e8",
            edgecolor="black",
            linewidth=0.6,
            label="answers given",
        )
        axes.vlines(positions, low, high, color=RED, linewidth=2)
        axes.scatter(positions, middle, s=26, color=RED, zorder=3, label="would be given again")
        axes.set_xticks(positions, list(responses))
        axes.set(ylabel="share of the answers (%)", ylim=(0, None))
        legend(figure, axes.get_legend_handles_labels()[0])
    return figure
