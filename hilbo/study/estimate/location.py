"""Location of an optimum in sentences: at a range limit, on a constraint or a limit of the device, or an
extrapolation."""

import dataclasses
import math
from typing import NamedTuple

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from hilbo.ordinal_gp import Trials
from hilbo.search.linear import rows_of
from hilbo.study.config import Study

__all__ = ["goal_sentences", "location_notes", "location_sentences", "optimum_sentence", "truth_sentence"]

_AT = 1e-6  # of a range
_BORDERS = {
    "passive boundary": ("the passive region of the device", "on the device"),
    "effective damping": ("the study's range of effective damping", "within the range of effective damping"),
}


class _Edges(NamedTuple):
    """The limits that an optimum lies on: ends of the search ranges, constraints, and limits of the renderer."""

    ends: list[str]
    natural: list[str]
    """Ends beyond which nothing exists."""
    constraints: list[str]
    border: list[tuple[str, str, tuple[str, str]]]
    """Parameter, direction ("higher" or "lower") that the renderer does not allow there, and the limit in words, for a
    sentence and for a note."""


def optimum_sentence(study: Study, x: Float[Array, " d"]) -> str:
    """Sentence with the population optimum, x (d,) in the unit cube, in physical units."""
    return f"The population optimum is {_rendering(study, x)}."


def truth_sentence(study: Study, truth: Float[np.ndarray, " d"], nrmse: float) -> str:
    """Sentence with the true optimum of a simulated study, `truth` (d,) in the unit cube, in physical units, and the
    distance of the estimate, `nrmse`, in %."""
    far = f"the optimum found is {100 * nrmse:.1f} % of the search ranges away (NRMSE)"
    return f"The true optimum of the simulated participants is {_rendering(study, truth)}; {far}."


def _rendering(study: Study, x: Float[ArrayLike, " d"]) -> str:
    """A point of the unit cube as text: "NAME = VALUE UNIT, …"."""
    values = np.asarray(study.space.to_physical(np.asarray(x)))
    return ", ".join(
        f"{parameter.name} = {parameter.words(value)}{f' {parameter.unit}' if parameter.unit else ''}"
        for parameter, value in zip(study.space.parameters, values, strict=True)
    )


def goal_sentences(study: Study, trials: Trials) -> list[str]:
    """A warning if none of the responses is the goal; else an empty list. `trials`: those of the map, masked."""
    if np.any((np.asarray(trials.q) == study.goal.category) & np.asarray(trials.mask)):
        return []
    return [f'No response is "{study.goal_label}": its probability is an extrapolation of the model.']


def location_sentences(
    study: Study, x: Float[Array, " d"], sd: Float[Array, ""], asked: Float[Array, ""] | None
) -> list[str]:
    """Warnings about the location of an optimum x (d,) in the unit cube; an empty list if there are none.

    `sd`: the map's standard deviation at x; `asked`: the map's largest variance at a tested stimulus, above which x is
    an extrapolation (None: not checked).
    """
    edges, sentences = _edges(study, np.asarray(x)), []
    if edges.ends:
        sentences.append(f"The optimum is at {' and '.join(edges.ends)}: values beyond it were not tested.")
    if edges.natural:
        sentences.append(f"The optimum is at {' and '.join(edges.natural)}.")
    if edges.constraints:
        sentences.append(
            f"The optimum is on the study's constraint {' and '.join(edges.constraints)}: values beyond it were not"
            " tested."
        )
    sentences += [
        f"The optimum is on the boundary of {what}: {name} could not be {way} there."
        for name, way, (what, _) in edges.border
    ]
    if asked is not None and _extrapolates(sd, asked):
        sentences.append(
            f"The optimum is an extrapolation: the map's standard deviation there, {float(sd):.2g}, is larger than"
            f" at all tested stimuli ({math.sqrt(float(asked)):.2g} at most). Validate it before it is used."
        )
    return sentences


def location_notes(
    study: Study, x: Float[Array, " d"], sd: Float[Array, ""], asked: Float[Array, ""] | None
) -> list[str]:
    """The location of an optimum x (d,) in the unit cube in a few words per fact, for a table; an empty list if there
    is nothing to note.

    `sd`, `asked`: the map's standard deviation at x, and its largest variance at a tested stimulus (None: not checked).
    """
    edges = _edges(study, np.asarray(x))
    notes = [f"at {end}" for end in (*edges.ends, *edges.natural)]
    notes += [f"on the constraint {words}" for words in edges.constraints]
    notes += [f"{name} could not be {way} {by}" for name, way, (_, by) in edges.border]
    if asked is not None and _extrapolates(sd, asked):
        notes.append("an extrapolation: its standard deviation is larger than at all tested stimuli")
    return notes


def _extrapolates(sd: Float[Array, ""], asked: Float[Array, ""]) -> bool:
    """Whether `sd` exceeds the square root of the variance `asked`."""
    return float(sd) > (1.0 + _AT) * math.sqrt(float(asked))


def _edges(study: Study, x: Float[np.ndarray, " d"]) -> _Edges:
    """The limits within 1e-6 of the point x (d,) of the unit cube; parameters with unordered levels have none."""
    inner, edges = np.asarray(study.space.to_box(x)), _Edges([], [], _constraints(study, x), [])
    for i, parameter in enumerate(study.space.parameters):
        if parameter.categorical:
            continue
        unit = f" {parameter.unit}" if parameter.unit else ""
        for place, end, word, key in ((0.0, parameter.low, "lowest", "low"), (1.0, parameter.high, "highest", "high")):
            words = parameter.shown(end) if parameter.levels else f"{end:g}"
            if abs(x[i] - place) < _AT and key in parameter.natural_ends:
                edges.natural.append(f"the natural end of {parameter.name} ({words}{unit})")
            elif abs(x[i] - place) < _AT:
                edges.ends.append(f"the {word} {parameter.name} that was searched ({words}{unit})")
            elif abs(inner[i] - place) < _AT:
                beyond = x.copy()
                beyond[i] += 2 * _AT * (2 * place - 1)
                if (bound := study.space.broken(beyond)) in _BORDERS:
                    edges.border.append((parameter.name, "higher" if place else "lower", _BORDERS[bound]))
    return edges


def _constraints(study: Study, x: Float[np.ndarray, " d"]) -> list[str]:
    """Texts of the one-sided constraints that are active (within 1e-6) at the point x (d,) of the unit cube."""
    parameters, held = study.space.parameters, []
    low, high = (np.array([getattr(p, end) for p in parameters]) for end in ("low", "high"))
    shares = (np.asarray(study.space.to_physical(x)) - low) / (high - low)
    for constraint in (c for c in study.space.constraints if not c.equality):
        for one in (dataclasses.replace(constraint, least=None), dataclasses.replace(constraint, most=None)):
            walls = rows_of(parameters, [one])
            if np.any(np.abs(walls.normals @ shares - walls.offsets) < _AT):
                held.append(one.words)
    return held
