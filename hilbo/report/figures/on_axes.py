"""A map on given axes: for notebooks, and figures of several panels.

figure, axes = pyplot.subplots(1, 2)
plot_map(study, posterior, ax=axes[0])
plot_map(study, aggregate, ("K1", "alpha"), ax=axes[1])
"""

from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from hilbo.errors import InputError
from hilbo.ordinal_gp import Posterior
from hilbo.report.figures.maps import curve, draw_curve, plane
from hilbo.report.figures.style import COLOURS, label_axes, level_words, score_label, star, styled
from hilbo.search.candidates import search_points
from hilbo.study.config import Study
from hilbo.study.estimate.aggregate import Aggregate
from hilbo.study.estimate.optimum import best_point

__all__ = ["plot_map"]

_CELLS = 61


@styled
def plot_map(
    study: Study, model: Posterior | Aggregate, pair: tuple[str, str] | None = None, *, ax: Axes | None = None
) -> Axes:
    """Draw the mean of one participant's posterior, or of the population map, over two parameters through its maximum.

    **Arguments:**

    - `pair`: names of the parameters across and up; without it the first two free ones. Of a study with one free
      parameter the mean is drawn as a curve with its standard deviation.
    - `ax`: the axes to draw on; without it those of a new figure of pyplot, which notebooks show.

    **Returns:** the axes. Infeasible stimuli are left white, the maximum is a star; the values of the other parameters
    are in the title, but those that an equality determines. Raises `InputError` for parameters that the study does not
    have, for a pair that an equality makes dependent, and for a model of another type.
    """
    names, free = study.space.names, study.space.free
    axes = _new_axes() if ax is None else ax
    best = _maximum(study, model)
    if len(free) == 1 and pair is None:
        draw_curve(axes, study, curve(study, partial(_mean_and_variance, model)))
        return axes
    i, j = _places(names, [names[k] for k in free[:2]] if pair is None else pair)
    dependent = study.space.determined((i, j))
    if dependent is None:
        words = " and ".join(c.words for c in study.space.constraints if c.equality)
        raise InputError(
            f"plot_map: {names[i]} and {names[j]} are not free of each other ({words}); give another pair."
        )
    grid = plane(study, best, (i, j), _CELLS)
    mean = grid.image(_mean_and_variance(model, grid.points)[0])
    drawn = axes.pcolormesh(*grid.sides, mean, cmap=COLOURS, shading="nearest", rasterized=True)
    axes.figure.colorbar(drawn, ax=axes, label=score_label(study))
    label_axes(axes, study, i, j)
    star(axes, study, best, (i, j))
    held = [level_words(study, k, float(best[k])) for k in range(len(names)) if k not in (i, j, *dependent)]
    axes.set_title(", ".join(held))
    return axes


def _new_axes() -> Axes:
    """Axes of a new pyplot figure."""
    from matplotlib import pyplot  # looks for a display: who brings axes does not wait for it

    return pyplot.subplots(figsize=(4.0, 3.2), layout="constrained")[1]


def _maximum(study: Study, model: Any) -> np.ndarray:
    """Optimum (d,) in the unit cube: for a posterior the feasible point that is best by the study's goal, which is
    searched for, for an aggregate its own optimum. Raises `InputError` for a model of another type.
    """
    if isinstance(model, Aggregate):
        return np.asarray(model.optimum.x)
    if not isinstance(model, Posterior):
        raise InputError(f"plot_map: model is a {type(model).__name__}; give a Posterior or an Aggregate.")
    return np.asarray(best_point(study.goal, study.space, model, search_points(study.space, 0)).x)


def _places(names: tuple[str, ...], pair: Any) -> tuple[int, int]:
    """Indices of a pair of parameters. Raises `InputError` unless they are two different names of `names`."""
    if len(pair) != 2 or len(set(pair)) != 2 or not set(pair) <= set(names):
        raise InputError(f"plot_map: pair is {tuple(pair)}; give two of {', '.join(names)}.")
    return names.index(pair[0]), names.index(pair[1])


def _mean_and_variance(model: Any, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance (m,) of a posterior or an aggregate at points (m, d) of the unit cube, as NumPy arrays."""
    mean, variance = model.surface(x) if isinstance(model, Aggregate) else model.predict(x)
    return np.asarray(mean), np.asarray(variance)
