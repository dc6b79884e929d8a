"""The style that all figures share: colours, widths, axes with units, marks of optima.

All values on maps have one sequential colour map, lines the Okabe-Ito colours; both are distinguishable with
colour-blindness, and what differs does so by shape too. The optimum is a red star everywhere, and red is the
population. Widths are those of one and of two columns of a journal.
"""

import io
from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.textpath import TextPath
from matplotlib.ticker import FormatStrFormatter, LogLocator, MaxNLocator, NullFormatter

from hilbo.study.config import Study

__all__ = [
    "BLUE",
    "COLOURS",
    "GREEN",
    "GREY",
    "ONE_COLUMN",
    "ORANGE",
    "RED",
    "STYLE",
    "TWO_COLUMNS",
    "band",
    "few_ticks",
    "label_axes",
    "legend",
    "level_words",
    "new_figure",
    "plain",
    "score_label",
    "star",
    "star_at",
    "styled",
    "title",
]

BLUE, ORANGE, GREEN, RED, GREY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#666666"
COLOURS = "cividis"
"""Name of the sequential colour map; the pages of a session (static/map.js) have the same."""
ONE_COLUMN, TWO_COLUMNS = 3.46, 7.13
"""Widths of figures, inches."""
STYLE: dict = {
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.labelsize": 8,
    "legend.fontsize": 7.5,
    "legend.handlelength": 1.5,
    "legend.columnspacing": 1.2,
    "lines.linewidth": 1.3,
    "axes.spines.top": False,
    "axes.spines.right": False,
}
styled = mpl.rc_context(STYLE)
"""Decorator of a function that draws: in this style."""
_WIDEST = 1.1  # inches of an entry of a legend


class NotebookFigure(Figure):
    """A figure that a notebook shows at the end of a cell, although pyplot does not know it."""

    def _repr_png_(self) -> bytes:
        """PNG at 150 dots an inch; IPython calls it."""
        content = io.BytesIO()
        self.savefig(content, format="png", dpi=150)
        return content.getvalue()


def new_figure(width: float, height: float, rows: int = 1, columns: int = 1, **subplots: Any) -> tuple[Figure, Any]:
    """A matplotlib figure (inches) and its axes, one or an array, as `Figure.subplots` returns them; not shown but by a
    notebook, and no part of pyplot. `subplots`: further arguments of `Figure.subplots`.
    """
    figure = NotebookFigure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(rows, columns, **subplots)


def few_ticks(axis, count: int = 4, *, integer: bool = False) -> None:
    """Limit the ticks of a linear axis to about `count`, so that their numbers do not overlap; `integer`: at
    integers.
    """
    axis.set_major_locator(MaxNLocator(count, integer=integer, steps=[1, 2, 2.5, 5, 10]))


def legend(figure, handles) -> None:
    """Put a legend of these handles above the axes of a figure, in as many columns as its width allows."""
    across = max(1, min(len(handles), int(figure.get_figwidth() / _WIDEST)))
    size, labels = STYLE["legend.fontsize"], [handle.get_label() for handle in handles]
    while across > 1 and _legend_width(labels, across, size) > 72 * figure.get_figwidth():
        across -= 1
    figure.legend(handles=handles, loc="outside upper center", ncols=across, frameon=False, fontsize=size)


def _legend_width(labels: Sequence[str], across: int, size: float) -> float:
    """Width (points) of a legend with `across` columns and text of `size` points: widest labels, handles, spacing."""
    look = mpl.rcParams

    def width(line: str) -> float:
        return TextPath((0, 0), line, size=size).get_extents().width if line.strip() else 0.0

    columns = np.array_split(np.array(labels, dtype=object), across)
    widest = [max((width(line) for label in column for line in label.split("\n")), default=0.0) for column in columns]
    spaces = (
        across * (look["legend.handlelength"] + look["legend.handletextpad"])
        + (across - 1) * look["legend.columnspacing"]
    )
    return sum(widest) + size * (spaces + 2 * look["legend.borderpad"])


def plain(words: str) -> str:
    """A user's text, with dollar signs escaped: matplotlib reads text between two of them as a formula."""
    return words.replace("$", r"\$")


def score_label(study: Study) -> str:
    """Label of axes and colour bars for the mean of the latent function, which has no unit: f and the study's
    attribute.
    """
    return f"mean latent score f (no unit)\n{plain(study.file.attribute)}"


def title(axes, text: str) -> None:
    """Set the title of a panel."""
    axes.set_title(text, fontsize=STYLE["axes.titlesize"])


def label_axes(axes, study: Study, i: int, j: int) -> None:
    """Set labels (name and unit), limits, scales and ticks of `axes` for parameter `i` across and `j` up."""
    for which, parameter in (("x", study.space.parameters[i]), ("y", study.space.parameters[j])):
        unit = f" ({_unit(parameter.unit)})" if parameter.unit else ""
        getattr(axes, f"set_{which}label")(_name(parameter.name) + unit)
        getattr(axes, f"set_{which}lim")(parameter.low, parameter.high)
        if parameter.discrete:
            _steps_on(axes, which, parameter)
        if parameter.scale == "log":
            getattr(axes, f"set_{which}scale")("log")
            axis = getattr(axes, f"{which}axis")
            axis.set_major_locator(LogLocator(subs=(1.0,) if parameter.high > 20 * parameter.low else (1.0, 3.0, 5.0)))
            axis.set_major_formatter(FormatStrFormatter("%g"))
            axis.set_minor_formatter(NullFormatter())
        elif not parameter.discrete:
            few_ticks(getattr(axes, f"{which}axis"))


def _steps_on(axes, which, parameter) -> None:
    """Set limits and ticks of one axis (`which`: "x" or "y") for a discrete parameter: half a step of margin (below the
    low end only on a linear scale), and the names of levels or whole numbers.
    """
    getattr(axes, f"set_{which}lim")(parameter.low - 0.5 * (parameter.scale == "linear"), parameter.high + 0.5)
    if parameter.levels:
        getattr(axes, f"set_{which}ticks")(range(len(parameter.levels)), [*map(plain, parameter.levels)])
    elif parameter.scale == "linear":
        getattr(axes, f"{which}axis").get_major_locator().set_params(integer=True)


def _name(name: str) -> str:
    """A parameter's name as text of a figure: α, K₁ and B₁ as symbols, underscores as spaces."""
    symbols = {"alpha": "α", "K1": "$K_1$", "B1": "$B_1$"}
    return symbols[name] if name in symbols else plain(name.replace("_", " "))


def _unit(unit):
    """A unit of a study file as text of a figure."""
    return plain(unit).replace("s^alpha", "s$^α$").replace(".", "·")


def level_words(study: Study, index: int, unit_value: float) -> str:
    """A parameter's name, physical value and unit as text, such as "K₁ = 3 N/mm". `index`: of the parameter;
    `unit_value`: its value in the unit cube.
    """
    parameter = study.space.parameters[index]
    value = float(parameter.to_physical(np.asarray(float(unit_value))))
    words = parameter.words(value) if parameter.discrete else f"{value:.3g}"
    return f"{_name(parameter.name)} = {plain(words)} {plain(parameter.unit)}".strip()


def star(axes, study: Study, x, pair: tuple[int, ...] | None = None) -> None:
    """Draw a star at a point `x` (d,) of the unit cube on `axes` of the parameters `pair`, by default the first two
    free ones, in physical units."""
    star_at(axes, *np.asarray(study.space.to_physical(np.asarray(x)))[list(pair or study.space.free[:2])])


def star_at(axes, across: float, up: float, label: str = "") -> None:
    """Draw the mark of an optimum, a red star with a white edge, at a point in data coordinates. `label`: in legends,
    if there is one.
    """
    look = {"marker": "*", "markersize": 12, "color": RED, "markeredgecolor": "white", "linestyle": ""}
    axes.plot([across], [up], clip_on=False, zorder=5, label=label or None, **look)


def band(axes, trials, values, colour: str, label: str) -> None:
    """Draw the median over the first axis of `values` (k, m) on `axes` as a line over `trials` (m,), and the quartiles
    as a band; NaN are ignored.
    """
    low, middle, high = np.nanpercentile(values, [25, 50, 75], axis=0)
    axes.fill_between(trials, low, high, color=colour, alpha=0.25, linewidth=0)
    axes.plot(trials, middle, color=colour, label=label)
