"""What a program confirms that it has presented, held against what it was asked for; pure.

The study says how far each value may be off (`hilbo.study.file.stimuli`). Within that, the confirmed value is what
counts: fits, tables and maps have it, the proposal stays in the log. A value beyond an end of the parameter's range
counts as that end: a 32-bit number of the end itself may lie beyond it, and no table holds what is outside. Of a
parameter with steps the nearest one counts.
"""

import math
from collections.abc import Mapping

from hilbo.session.log.records import RefusedError
from hilbo.study.file.reading import StudyFile

__all__ = ["check_confirmed", "counted", "in_numbers", "in_words"]


def check_confirmed(study: StudyFile, asked: Mapping[str, float], values: Mapping[str, float] | None) -> None:
    """Refuse what is no confirmation of the values asked for (physical units, by name). Raises RefusedError with the
    code "bad-answer" for what lacks a number, "off" for one that is too far off.
    """
    names = study.space.names
    if values is None or set(values) != set(names):
        raise RefusedError("bad-answer", f"a confirmation has a value for {', '.join(names)}, and for nothing else.")
    assert study.stimulus is not None  # whoever asks has looked
    for parameter in study.space.parameters:
        value, wanted = values[parameter.name], asked[parameter.name]
        most = study.stimulus.off_by(parameter, wanted)
        if not math.isfinite(value):
            raise RefusedError("bad-answer", f"{parameter.name} is confirmed as {value}, which is no number.")
        if parameter.levels and value != wanted:
            shown, other = parameter.shown(value), parameter.shown(wanted)
            raise RefusedError("off", f"{parameter.name} is confirmed as {shown}, and {other} was asked for.")
        if abs(value - wanted) > most:
            raise RefusedError(
                "off",
                f"{parameter.name} is confirmed as {value:g}, {wanted:g} was asked for, and it may be off by {most:g}"
                f" {parameter.unit}".rstrip()
                + "; round less, or raise the study's tolerance.",
            )


def in_words(study: StudyFile, values: Mapping[str, float]) -> dict[str, float | str]:
    """Values as whoever presents is told them: levels by their names. What is no parameter, such as K0, stays."""
    parameters = {p.name: p for p in study.space.parameters}
    return {n: parameters[n].shown(v) if n in parameters and parameters[n].levels else v for n, v in values.items()}


def in_numbers(study: StudyFile, values: Mapping[str, float | str] | None) -> dict[str, float] | None:
    """Confirmed values as the log holds them: of a level its place in the study's list. Raises RefusedError with the
    code "bad-answer" for a text that is none of the levels."""
    if values is None:
        return None
    return {name: _number(study, name, value) for name, value in values.items()}


def _number(study: StudyFile, name: str, value: float | str) -> float:
    p = next((p for p in study.space.parameters if p.name == name), None)
    if p is None or not (p.levels or isinstance(value, str)):
        return math.nan if isinstance(value, str) else value
    number = p.number(value)
    if math.isnan(number):
        raise RefusedError("bad-answer", f"{name} is confirmed as {value}; it must be {p.range_words}.")
    return number


def counted(study: StudyFile, values: Mapping[str, float]) -> dict[str, float]:
    """The values that count for a confirmation that was accepted."""
    inside = {p.name: min(max(float(values[p.name]), p.low), p.high) for p in study.space.parameters}
    return {p.name: float(round(inside[p.name])) if p.discrete else inside[p.name] for p in study.space.parameters}
