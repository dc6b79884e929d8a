"""The results folder of a large population: what the report of a small one has, as far as it pays.

The map's grid is coarser, and the figures of progress are left out: each of their points is a fit of everybody.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from scipy.interpolate import RegularGridInterpolator

from hilbo.report.page import results_page
from hilbo.report.participants import people_of
from hilbo.report.results import result, save_figures, write_numbers
from hilbo.study.cohort import Cohort
from hilbo.study.config import Study
from hilbo.study.estimate.batch_optimum import LargeAggregate
from hilbo.study.formats.json_file import Content
from hilbo.study.results.map_netcdf import map_dataset, on_grid

__all__ = ["population_map", "write_population"]

_POINTS = 5000  # of the map's grid
_CELLS = 41
_DRAWN = 200  # participants whose answers the figure shows
_DOTS = 2000  # individual optima in a figure


def population_map(study: Study, large: LargeAggregate) -> xr.Dataset:
    """The map on a grid of at most 5,000 points, or at as many: a pass over all people, by the whole crew."""
    cells = min(_CELLS, int(_POINTS ** (1 / min(study.space.dim, 3))))
    return map_dataset(study, large.surface, cells)


def write_population(
    study: Study,
    large: LargeAggregate,
    grid: xr.Dataset,
    folder: Path,
    seed: int = 0,
    say=lambda text: None,
    left_out: Sequence[str] = (),
) -> Content:
    """Write result.json, optima.csv, map.nc, figures and report.html; returns the content of result.json. `left_out`:
    sentences on who is not in it."""
    people = people_of(study, large)
    content = result(study, large, seed, None, people, left_out)
    say("writing results")
    write_numbers(content, people, grid, folder)
    say("figures and report")
    figures, drawn = _figures(study, large, grid)
    page = results_page(study, content, save_figures(figures, folder), people, drawn=drawn)
    (folder / "report.html").write_text(page, encoding="utf-8")
    return content


def _figures(study, aggregate, grid):
    """Name -> figure, and how many participants and individual optima they show."""
    from hilbo.report.figures import maps

    figures, best, drawn = {}, np.asarray(aggregate.optimum.x), {}
    if on_grid(study.space):
        subset = _some(aggregate.cohort)
        figures["map"] = maps.map_slices(study, _from(grid), best, subset)
        drawn["participants"] = len(subset.names)
    if aggregate.individuals is not None and study.space.dim > 1:
        x = np.asarray(aggregate.individuals.x)
        rows = np.unique(np.linspace(0, len(x) - 1, min(len(x), _DOTS)).round().astype(int))
        marks = {"population map": best, "mean of optima": np.asarray(aggregate.mean_of_optima)}
        figures["optima"] = maps.optima_scatter(study, x[rows], marks)
        drawn["optima"] = len(rows)
    return figures, drawn


def _some(cohort: Cohort) -> Cohort:
    """A few participants, evenly chosen."""
    rows = np.unique(np.linspace(0, len(cohort.names) - 1, _DRAWN).round().astype(int))
    return cohort.rows(rows)


def _from(grid):
    """The map between the grid's points, to what a figure shows: mean and variance at points of the unit cube."""
    shape = grid["mean"].shape
    sides = tuple(np.linspace(0.0, 1.0, count) for count in shape)
    values = np.stack([grid["mean"].values, grid["variance"].values], axis=-1)
    between = RegularGridInterpolator(sides, values, method="cubic")

    def surface(x):
        values = between(np.asarray(x))
        return values[:, 0], values[:, 1]

    return surface
