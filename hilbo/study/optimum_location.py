"""Where an optimum lies, in sentences: at an edge of what was searched, or where nobody was asked."""

import math

import numpy as np
from jaxtyping import Array, Float

from hilbo.study.config import Study

__all__ = ["location_sentences", "optimum_sentence"]

_AT = 1e-6  # of a range


def optimum_sentence(study: Study, x: Float[Array, " d"]) -> str:
    """The optimum x (d,) of the unit cube in the study's units."""
    values = np.asarray(study.space.to_physical(x))
    sets = (
        f"{parameter.name} = {value:.4g}{f' {parameter.unit}' if parameter.unit else ''}"
        for parameter, value in zip(study.space.parameters, values, strict=True)
    )
    return f"The population optimum is {', '.join(sets)}."


def location_sentences(
    study: Study, x: Float[Array, " d"], sd: Float[Array, ""], asked: Float[Array, ""] | None
) -> list[str]:
    """What must be said of an optimum x (d,) of the unit cube, where the map has the standard deviation `sd`; `asked`:
    its largest variance where somebody answered (None: not known)."""
    sentences = [*_edges(study, np.asarray(x))]
    if asked is not None and float(sd) > (1.0 + _AT) * math.sqrt(float(asked)):
        sentences.append(
            f"The optimum is an extrapolation: the map's standard deviation there, {float(sd):.2g}, is larger than"
            f" wherever somebody answered ({math.sqrt(float(asked)):.2g} at most). Have people judge it before it is"
            " used."
        )
    return sentences


def _edges(study: Study, x: Float[np.ndarray, " d"]) -> list[str]:
    """The edges of the search ranges, and the border of what may be rendered, that hold the optimum."""
    inner = np.asarray(study.space.to_box(x))
    ends, border = [], []
    for i, parameter in enumerate(study.space.parameters):
        unit = f" {parameter.unit}" if parameter.unit else ""
        for place, end, word in ((0.0, parameter.low, "lowest"), (1.0, parameter.high, "highest")):
            if abs(x[i] - place) < _AT:
                ends.append(f"the {word} {parameter.name} that was searched ({end:g}{unit})")
            elif abs(inner[i] - place) < _AT:
                border.append(parameter.name)
    sentences = []
    if ends:
        sentences.append(
            f"The optimum lies at {' and '.join(ends)}: whether people would like what is beyond is not known from"
            " this study."
        )
    if border:
        sentences.append(
            f"The optimum lies at the border of what the device may render: {' and '.join(border)} could not be higher"
            " there."
        )
    return sentences
