"""Figure of the result card: probability that a new participant gives the goal, with the optimum's credible region."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from matplotlib.figure import Figure
from scipy.spatial import cKDTree

from hilbo.kernels import Stationary, embedded
from hilbo.report.figures.maps import along, label_curve, plane
from hilbo.report.figures.style import (
    BLUE,
    COLOURS,
    RED,
    few_ticks,
    label_axes,
    new_figure,
    plain,
    star,
    star_at,
    styled,
)
from hilbo.study.analysis.region import Region
from hilbo.study.config import Study
from hilbo.study.estimate.aggregate import Aggregate

__all__ = ["goal_map"]

_WIDTH, _HEIGHT = 3.2, 2.5  # inches
_ENDS = (0.05, 0.1, 0.25, 0.5)  # of scales

_Points = Float[np.ndarray, "m d"]


@styled
def goal_map(study: Study, aggregate: Aggregate, region: Region | None) -> Figure:
    """Probability of the goal over the first two free parameters through the optimum, with the outline of the slice of
    the credible region; of one parameter a curve with the region as a band.

    Infeasible points are white. `region`: None draws no outline.
    """

    def chances(points: _Points) -> Float[np.ndarray, " m"]:
        return np.asarray(aggregate.class_probabilities(study.gp.likelihood, points))[:, study.goal.category]

    figure, axes = new_figure(_WIDTH, _HEIGHT)
    best, label = np.asarray(aggregate.optimum.x), f'probability of "{plain(study.goal_label)}"'
    if len(study.space.free) == 1:
        _curve(axes, study, chances, region, label)
        index = study.space.free[0]
        star_at(axes, np.asarray(study.space.to_physical(best))[index], chances(best[None, :])[0])
        return figure
    pair = study.space.free[0], study.space.free[1]
    grid = plane(study, best, pair)
    label_axes(axes, study, *pair)
    image = grid.image(chances(grid.points))
    scale = {"vmin": 0.0, "vmax": _scale_end(image), "cmap": COLOURS, "shading": "nearest", "rasterized": True}
    bar = figure.colorbar(axes.pcolormesh(*grid.sides, image, **scale), ax=axes, label=label)
    few_ticks(bar.ax.yaxis)
    if region is not None:
        inside = np.where(grid.feasible, held(region, grid.points, study.gp.kernel).reshape(grid.feasible.shape), False)
        if inside.any() and not inside.all():
            axes.contour(*grid.sides, inside.astype(float), levels=[0.5], colors=[RED], linewidths=1.2)
    star(axes, study, best)
    return figure


def _scale_end(chances: Float[np.ndarray, "r c"]) -> float:
    """Upper end of the scale of probabilities (NaN where not feasible): 1, or less where all are small, as with many
    responses."""
    return next((end for end in _ENDS if np.nanmax(chances) <= end), 1.0)


def held(region: Region, points: _Points, kernel: Stationary) -> Bool[np.ndarray, " m"]:
    """Whether each point (m, d) of the unit cube is in the region: whether the nearest of the region's even points, by
    the kernel's distance, is."""
    even = np.concatenate([region.points, region.others])
    places = np.asarray(embedded(kernel, np.concatenate([even, points])))
    _, nearest = cKDTree(places[: len(even)]).query(places[len(even) :])
    return nearest < len(region.points)


def _curve(
    axes, study: Study, chances: Callable[[_Points], Float[np.ndarray, " m"]], region: Region | None, label: str
) -> None:
    """Draw the probability over the only free parameter on `axes`, with the region as a band."""
    side, points = along(study)
    inside = np.asarray(study.space.feasible(jnp.asarray(points)))
    across = np.asarray(study.space.parameters[study.space.free[0]].to_physical(side))
    label_curve(axes, study)
    axes.plot(across[inside], chances(points)[inside], color=BLUE)
    if region is not None:
        within = held(region, points, study.gp.kernel) & inside
        axes.fill_between(across, 0.0, 1.0, where=within, color=RED, alpha=0.15, linewidth=0)
    axes.set(ylabel=label, ylim=(0.0, 1.0))
