"""Marks of responses on maps: one shape for each response, and a pie marker of response proportions where several
responses were given at one point.

Marks at one point would cover each other, and the category that is drawn last would hide all others.
"""

from typing import Any

import numpy as np
from jaxtyping import Float, Int
from matplotlib.lines import Line2D

from hilbo.report.figures.style import plain
from hilbo.study.cohort import Cohort
from hilbo.study.config import Study

__all__ = ["answer_handles", "mark_along", "mark_trials"]

_NEAR = 0.08  # trials within this distance of a slice, in the unit cube, are drawn on it
_SHAPES = ("v", "s", "^", "D", "P", "X", "p", "h", "<", ">")
_DARK = 0.5  # lightness below which a mark has a white edge, so that it is seen on any colour of a map
_FEW, _MANY = 24.0, 80.0  # areas of the discs of two answers and of the most, points²
_CORNERS = 60  # of a whole disc


def mark_trials(axes, study: Study, cohort: Cohort, third: float | None) -> Int[np.ndarray, " p"]:
    """Draw the responses near a slice on `axes`: one mark for each, or a pie marker for several at one point.

    `third`: value of the third free parameter on the slice (unit cube), of which trials within 0.08 are drawn;
    None: all. Returns the number of responses at each point drawn, (p,).
    """
    x, q = _answers(cohort)
    free = study.space.free
    near = np.ones(len(x), bool) if third is None else np.abs(x[:, free[2]] - third) < _NEAR
    points = np.asarray(study.space.to_physical(x))[near][:, list(free[:2])]
    places, place, counts = np.unique(points, axis=0, return_inverse=True, return_counts=True)
    place = place.reshape(-1)  # NumPy 2.0 gives it the shape of the points
    alone = counts[place] == 1
    for category in range(len(study.responses)):
        shown = points[alone & (q[near] == category)]
        axes.scatter(*shown.T, clip_on=False, zorder=3, **_look(study, category))
    tally = np.zeros((len(places), len(study.responses)), int)
    np.add.at(tally, (place, q[near]), 1)
    for row in np.flatnonzero(counts > 1):
        _disc(axes, study, places[row], tally[row], _area(int(counts[row]), int(counts.max())))
    return counts


def mark_along(axes, study: Study, cohort: Cohort) -> Int[np.ndarray, " p"]:
    """Draw the responses at the bottom of `axes` of a map of one parameter: a row of marks for each category, larger
    where the same response was given more often. Returns the number of responses of each mark, (p,).
    """
    x, q = _answers(cohort)
    points, places = np.asarray(study.space.to_physical(x))[:, study.space.free[0]], axes.get_xaxis_transform()
    marks = [np.unique(points[q == category], return_counts=True) for category in range(len(study.responses))]
    counts = np.concatenate([number for _, number in marks])
    for category, (shown, number) in enumerate(marks):
        look = _look(study, category)
        sizes = np.where(number > 1, _area(number, int(counts.max(initial=1))), look["s"])
        height = np.full(len(shown), 0.03 + 0.05 * category)
        axes.scatter(shown, height, transform=places, clip_on=False, **look | {"s": sizes})
    return counts


def answer_handles(study: Study, counts: Int[np.ndarray, " p"], *, discs: bool = True) -> list[Any]:
    """Legend handles for the responses, lowest first, and one for pie markers (`discs`) or larger marks if there are
    any.

    `counts` (p,): numbers of responses, as `mark_trials` and `mark_along` return. Where all points are pie markers,
    every handle is a circle.
    """
    several = counts[counts > 1]
    no_marks = discs and 0 < len(several) == len(counts)
    handles = []
    for category, label in enumerate(study.responses):
        look = _look(study, category)
        marker = "o" if no_marks else look["marker"]
        handles.append(_handle(plain(label), marker=marker, markerfacecolor=look["facecolor"]))
    if len(several):
        low, high = several.min(), several.max()
        number = f"{low}\n" if low == high else f"{low}\nto {high} "
        fills = {"markerfacecolor": _fill(study, len(study.responses) - 1), "markerfacecoloralt": _fill(study, 0)}
        shares = {"marker": "o", "fillstyle": "left", **fills}
        larger = {"marker": "o", "markerfacecolor": "none"}
        words = ("proportions of " if discs else "mark of ") + f"{number}responses"
        handles.append(_handle(words, **(shares if discs else larger) | {"markersize": 7}))
    return handles


def _answers(cohort: Cohort) -> tuple[Float[np.ndarray, "n d"], Int[np.ndarray, " n"]]:
    """Points (n, d) of the unit cube and categories (n,) of all responses of all participants."""
    mask = np.asarray(cohort.trials.mask)
    return np.asarray(cohort.trials.x)[mask], np.asarray(cohort.trials.q)[mask]


def _look(study: Study, category: int) -> dict[str, Any]:
    """Keyword arguments of `scatter` for a category: a distinct shape, and the darker the higher the category, so that
    ordered responses are told apart in print without colours too; the goal is a circle.
    """
    top = category == study.goal.category
    look: dict[str, Any] = {"marker": "o" if top else _SHAPES[category % len(_SHAPES)], "s": 20 if top else 14}
    return look | {"facecolor": _fill(study, category), "edgecolor": _edge(study, category), "linewidth": 0.5}


def _lightness(study: Study, category: int) -> float:
    """Lightness of a category in equal steps: 1 (white) for the lowest, 0 (black) for the highest."""
    return 1 - category / (len(study.responses) - 1)


def _fill(study: Study, category: int) -> tuple[float, ...]:
    """Grey (red, green, blue) of a category."""
    return (_lightness(study, category),) * 3


def _edge(study: Study, category: int) -> str:
    """Colour of the outline of a category's mark: black around a light one, white around a dark one."""
    return "white" if _lightness(study, category) < _DARK else "black"


def _area(count: Any, most: int) -> Any:
    """Area (points²) of the pie marker of `count` responses; it grows linearly up to that of `most` responses."""
    return _FEW + (_MANY - _FEW) * (count - 2) / max(most - 2, 1)


def _disc(axes, study: Study, point: Float[np.ndarray, " 2"], tally: Int[np.ndarray, " C"], area: float) -> None:
    """Draw a pie marker of the response counts `tally` at a `point` in physical units on `axes`, lowest category first,
    clockwise from the top. `area`: in points².
    """
    ends = 2 * np.pi * np.cumsum([0, *tally]) / tally.sum()
    for category in np.flatnonzero(tally).tolist():
        turns = np.linspace(ends[category], ends[category + 1], 2 + int(_CORNERS * tally[category] / tally.sum()))
        corners = np.stack([np.sin(turns), np.cos(turns)], axis=1)
        if tally[category] < tally.sum():
            corners = np.concatenate([[[0.0, 0.0]], corners])
        # Matplotlib scales a marker until its farthest corner is at the edge.
        size = area * np.abs(corners).max() ** 2
        look = {"facecolor": _fill(study, category), "edgecolor": _edge(study, category), "linewidth": 0.4}
        axes.scatter(*point, marker=corners, s=size, clip_on=False, zorder=3, **look)


def _handle(label: str, **look: Any) -> Line2D:
    """A legend handle without a line; `look`: further properties of the marker."""
    edge = {"markeredgecolor": "black", "markeredgewidth": 0.5, "markersize": 4.5}
    return Line2D([], [], linestyle="", label=label, **edge | look)
