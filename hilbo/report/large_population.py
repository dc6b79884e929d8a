"""Grid and figures for maps that are expensive to evaluate, since each point needs the fits of many participants.

The grid is coarse, and the figures are interpolated from it. Figures of progress over trials are left out: each of
their points is a fit of all participants.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import xarray as xr
from jax.typing import ArrayLike
from jaxtyping import Float
from scipy.interpolate import RegularGridInterpolator

from hilbo.study.cohort import Cohort
from hilbo.study.config import Study
from hilbo.study.estimate.aggregate import Aggregate
from hilbo.study.results.map_netcdf import on_grid

__all__ = ["coarse_cells", "figures_of_many"]

_POINTS = 5000  # of the map's grid
_CELLS = 41
_DRAWN = 200  # participants whose answers the figure shows
_DOTS = 2000  # individual optima in a figure


def coarse_cells(study: Study) -> int:
    """Number of grid points along each side: at most 41, so that the grid (of at most 3 dimensions) has at most
    5,000.
    """
    return min(_CELLS, int(_POINTS ** (1 / min(study.space.dim, 3))))


def figures_of_many(study: Study, aggregate: Aggregate, grid: xr.Dataset) -> tuple[dict[str, Any], dict[str, int]]:
    """Matplotlib figures by name, and how many `participants` and individual `optima` they show.

    `grid`: dataset with `mean` and `variance` of the map on a grid of the unit cube. The map figure shows the responses
    of at most 200 participants, evenly spaced in their order, and is missing for a space without a grid. The figure of
    the optima shows at most 2,000; it is missing if individual optima were not computed, and for one parameter. The
    counts of missing figures are missing too.
    """
    from hilbo.report.figures import maps

    figures, best, drawn = {}, np.asarray(aggregate.optimum.x), {}
    if on_grid(study.space):
        subset = _even_subset(aggregate.cohort)
        figures["map"] = maps.map_slices(study, _interpolated(grid), best, subset)
        drawn["participants"] = len(subset.names)
    if aggregate.own is not None and study.space.dim > 1:
        x = np.asarray(aggregate.own.x)
        rows = np.unique(np.linspace(0, len(x) - 1, min(len(x), _DOTS)).round().astype(int))
        marks = {"population map": best, "mean of optima": np.asarray(aggregate.mean_of_optima)}
        figures["optima"] = maps.optima_scatter(study, x[rows], marks)
        drawn["optima"] = len(rows)
    return figures, drawn


def _even_subset(cohort: Cohort) -> Cohort:
    """At most 200 participants of a cohort, evenly spaced in their order."""
    people = len(cohort.names)
    return cohort.rows(np.unique(np.linspace(0, people - 1, min(people, _DRAWN)).round().astype(int)))


def _interpolated(grid: xr.Dataset) -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    """Map interpolated from its grid (cubic): a function of points (m, d) of the unit cube that returns mean and
    variance, (m,) each.
    """
    sides = tuple(np.linspace(0.0, 1.0, count) for count in grid["mean"].shape)
    values = np.stack([grid["mean"].values, grid["variance"].values], axis=-1)
    between = RegularGridInterpolator(sides, values, method="cubic")

    def surface(x: Float[ArrayLike, "m d"]) -> tuple[np.ndarray, np.ndarray]:
        values = between(np.asarray(x))
        return values[:, 0], values[:, 1]

    return surface
