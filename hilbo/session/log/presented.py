"""Comparison of the values that a stimulus program confirms with those requested; pure functions.

The study defines the tolerance of each value (`hilbo.study.file.stimuli`). Within it the confirmed value counts: fits,
tables and maps have it, and the proposal stays in the log. A value beyond an end of the parameter's range counts as
that end: a 32-bit number of the end itself may be beyond it. For a parameter with steps the nearest step counts.
"""

import math
from collections.abc import Mapping

from hilbo.session.log.records import RefusedError
from hilbo.study.file.reading import StudyFile

__all__ = ["check_confirmed", "counted", "in_numbers", "in_words"]

_EXACT = 1e-6  # relative error of K0; a 32-bit number keeps more


def check_confirmed(study: StudyFile, asked: Mapping[str, float], values: Mapping[str, float] | None) -> None:
    """Raise RefusedError if `values` do not confirm the values `asked` (physical units, by name): with the code
    "bad-answer" if a number is missing or not finite, "off" if one is beyond the study's tolerance. Of a study with
    [renderer] K0 need not be confirmed."""
    names = study.space.names
    if values is None or set(values) - _derived(study) != set(names):
        raise RefusedError("bad-answer", f"a confirmation has a value for {', '.join(names)}, and for nothing else.")
    assert study.stimulus is not None  # checked by the caller
    for name in _derived(study) & set(values):
        wanted = asked.get(name, math.nan)
        if not abs(values[name] - wanted) <= _EXACT * abs(wanted):
            raise RefusedError("off", f"{name} is confirmed as {values[name]:g}, and {wanted:g} was requested.")
    for parameter in study.space.parameters:
        value, wanted = values[parameter.name], asked[parameter.name]
        most = study.stimulus.off_by(parameter, wanted)
        if not math.isfinite(value):
            raise RefusedError("bad-answer", f"{parameter.name} is confirmed as {value}, which is no number.")
        if parameter.levels and value != wanted:
            shown, other = parameter.shown(value), parameter.shown(wanted)
            raise RefusedError("off", f"{parameter.name} is confirmed as {shown}, and {other} was requested.")
        if abs(value - wanted) > most:
            raise RefusedError(
                "off",
                f"{parameter.name} is confirmed as {value:g}, {wanted:g} was requested, and the tolerance is {most:g}"
                f" {parameter.unit}".rstrip()
                + "; round less, or raise the study's tolerance.",
            )


def in_words(study: StudyFile, values: Mapping[str, float]) -> dict[str, float | str]:
    """Values by name as they are shown to people and programs: levels by their names, all else unchanged."""
    parameters = {p.name: p for p in study.space.parameters}
    return {n: parameters[n].shown(v) if n in parameters and parameters[n].levels else v for n, v in values.items()}


def in_numbers(study: StudyFile, values: Mapping[str, float | str] | None) -> dict[str, float] | None:
    """Confirmed values as the log has them: levels as their index in the study's list; None stays None.

    Raises RefusedError with the code "bad-answer" for a text that is no level of its parameter. A text under a name
    that is no parameter becomes NaN, which `check_confirmed` refuses.
    """
    if values is None:
        return None
    return {name: _number(study, name, value) for name, value in values.items()}


def _number(study: StudyFile, name: str, value: float | str) -> float:
    """One confirmed value as a number, a level as its index; NaN for a text under a name that is no parameter. Raises
    RefusedError for a text that is no level of its parameter."""
    p = next((p for p in study.space.parameters if p.name == name), None)
    if p is None or not (p.levels or isinstance(value, str)):
        return math.nan if isinstance(value, str) else value
    number = p.number(value)
    if math.isnan(number):
        raise RefusedError("bad-answer", f"{name} is confirmed as {value}; it must be {p.range_words}.")
    return number


def counted(study: StudyFile, asked: Mapping[str, float], values: Mapping[str, float]) -> dict[str, float]:
    """The values that count for an accepted confirmation of the values `asked`: limited to the parameters' ranges, and
    rounded for discrete ones; K0 as asked."""
    inside = {p.name: min(max(float(values[p.name]), p.low), p.high) for p in study.space.parameters}
    counts = {p.name: float(round(inside[p.name])) if p.discrete else inside[p.name] for p in study.space.parameters}
    return {name: asked[name] for name in _derived(study)} | counts


def _derived(study: StudyFile) -> set[str]:
    """Names of the values that the mechanics of a renderer derive from the parameters."""
    return set() if study.space.mechanics is None else {"K0"}
