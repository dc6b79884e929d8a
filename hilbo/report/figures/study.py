"""Figures of a study's report, in addition to the paper's figures 4 to 8.

As in `maps`, a figure is a function from results to a matplotlib `Figure`. Differences are shown by shape, hatching or
text too, never by colour alone, for prints and for readers with colour-blindness.
"""

from typing import Any

import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from hilbo.report.figures.answers import answer_handles, mark_trials
from hilbo.report.figures.maps import (
    Slice,
    curve,
    draw_curve,
    grid_slice,
    map_handles,
    map_panels,
    maps_beside,
    third_of,
    third_words,
)
from hilbo.report.figures.style import (
    ONE_COLUMN,
    ORANGE,
    RED,
    legend,
    new_figure,
    star,
    styled,
    title,
)
from hilbo.search.apart import nrmse
from hilbo.study.analysis.analysis import Analysis
from hilbo.study.analysis.best_mid_worst import Sets
from hilbo.study.analysis.progress import Progress
from hilbo.study.cohort import Cohort
from hilbo.study.config import Study

__all__ = ["posterior_progress", "sets_on_map", "typical_person"]

UNKNOWN = 0.8
"""Share of its standard deviation without answers above which a map is drawn as not sampled."""
_MARKS = {"best": ("*", 12, RED, "white"), "mid": ("D", 6, ORANGE, "black"), "worst": ("X", 8, "white", "black")}
"""Marker, size (points), colour and edge of each set; that of the best is the mark of an optimum."""


def typical_person(analysis: Analysis) -> int:
    """Row of the participant whose distance (NRMSE) from individual to population optimum is the median one."""
    x, best = np.asarray(analysis.aggregate.individuals.x), np.asarray(analysis.aggregate.optimum.x)
    miss = np.asarray(nrmse(x, best, analysis.study.gp.kernel.levels))
    return int(np.argsort(miss, kind="stable")[(len(miss) - 1) // 2])


def posterior_progress(study: Study, cohort: Cohort, progress: Progress, row: int) -> Figure:
    """Posterior means of one participant (`row`) after growing numbers of trials, side by side, with the trials.

    All are sliced at the third parameter of the participant's last optimum; the star is each mean's own optimum. Paper,
    figure 4.
    """
    person, optima = cohort.rows(np.array([row])), progress.individual[progress.at(progress.moments), row]
    maps = {f"{count} trials": posterior.predict for count, posterior in progress.person(row).items()}
    if len(study.space.free) == 1:
        return maps_beside(study, maps, optima)
    at = third_of(study)
    third = None if at is None else float(optima[-1][at])
    grids = [grid_slice(study, predict, optima[-1], third) for predict in maps.values()]
    figure, panels, draw = map_panels(study, grids)
    counts = []
    for axes, name, n, x, values in zip(panels, maps, progress.moments, optima, grids, strict=True):
        draw(axes, values)
        counts.append(mark_trials(axes, study, person.first(n), third))
        star(axes, study, x)
        title(axes, third_words(study, third, f"{name}, ") or name)
    legend(figure, [*answer_handles(study, np.concatenate(counts)), *map_handles(study)])
    return figure


def sets_on_map(
    study: Study, surface, sets: Sets | None, best: Float[np.ndarray, " d"], cohort: Cohort, prior: ArrayLike
) -> tuple[Figure, bool]:
    """The population map sliced through its best, mid and worst sets, hatched where its standard deviation is above
    `UNKNOWN` times that without responses; and whether any part is hatched. Paper, figure 6a.

    `sets`: None shows the optimum `best` (d,) alone; `prior`: the map's variance without responses
    (`RuleMap.map_prior`). With one free parameter it is a curve, without hatching.
    """
    points: dict[str, Any] = {"best": best}
    if sets is not None:
        points = dict(zip(_MARKS, np.asarray(sets.x), strict=True))
    if len(study.space.free) == 1:
        return _sets_on_curve(study, surface, points), False
    at = third_of(study)
    thirds = {"best": None} if at is None else {name: float(x[at]) for name, x in points.items()}
    grids = [grid_slice(study, surface, best, third) for third in thirds.values()]
    figure, panels, draw = map_panels(study, grids)
    hatched, counts = False, []
    for axes, (name, third), values in zip(panels, thirds.items(), grids, strict=True):
        draw(axes, values)
        hatched |= _hatch(axes, values, prior)
        counts.append(mark_trials(axes, study, cohort, third))
        for shown in points if third is None else [name]:
            _mark(axes, study, shown, points[shown])
        title(axes, "" if third is None else f"{third_words(study, third)} ({name})")
    handles: list[Any] = [_handle(name) for name in points]
    handles += [*answer_handles(study, np.concatenate(counts)), *map_handles(study)]
    if hatched:
        handles.append(Patch(facecolor="white", edgecolor="black", hatch="////", label="hardly sampled"))
    legend(figure, handles)
    return figure, hatched


def _hatch(axes, values: Slice, prior: ArrayLike) -> bool:
    """Hatch the feasible part of a slice on `axes` in which the standard deviation is above `UNKNOWN` times that
    without responses; return whether there is such a part.
    """
    unknown = (values.sd > UNKNOWN * np.sqrt(np.asarray(prior))).astype(float)  # NaN is not
    if unknown.any():
        with mpl.rc_context({"hatch.linewidth": 0.5, "hatch.color": "white"}):
            axes.contourf(*values.sides, unknown, levels=[0.5, 1.5], colors="none", hatches=["////"])
    return bool(unknown.any())


def _mark(axes, study, name, x):
    """Mark a point `x` (d,) of the unit cube as the set `name` ("best", "mid" or "worst") on `axes`."""
    point = np.asarray(study.space.to_physical(np.asarray(x)))[list(study.space.free[:2])]
    axes.plot(*point, zorder=5, clip_on=False, **_look(name))


def _handle(name: str) -> Line2D:
    """Legend handle of a set."""
    marker, size, colour, edge = _MARKS[name]
    look = Line2D([], [], marker=marker, color=colour, markeredgecolor=edge, linestyle="", label=name)
    look.set_markersize(size)
    return look


def _look(name):
    """Properties of the marker of a set."""
    marker, size, colour, edge = _MARKS[name]
    return {"marker": marker, "markersize": size, "color": colour, "markeredgecolor": edge, "linestyle": ""}


@styled
def _sets_on_curve(study, surface, points):
    """Figure of `sets_on_map` for one parameter; `points`: set name -> point (1,) of the unit cube."""
    figure, axes = new_figure(ONE_COLUMN, 2.6)
    draw_curve(axes, study, curve(study, surface))
    for name, x in points.items():
        physical = np.asarray(study.space.to_physical(np.asarray(x)))
        height = float(surface(jnp.asarray(x)[None, :])[0][0])
        axes.plot(physical[study.space.free[0]], height, label=name, zorder=3, **_look(name))
    axes.legend(frameon=False)
    return figure
