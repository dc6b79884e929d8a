"""Orders to the program or preparer that presents a study's renderings, and their messages; docs/guides/stimulus.md has
every key.

An order states the next presentation from now on, not a change, so that a lost message does no harm.
"""

from typing import Any, NamedTuple

from hilbo.app.rigs.rig import Showing
from hilbo.search.box import Parameter
from hilbo.session.log.header_check import study_of
from hilbo.session.log.presented import in_words
from hilbo.session.plan.set_codes import label_of
from hilbo.study.file.reading import StudyFile

__all__ = ["Order", "as_sent", "parameters_of"]


class Order(NamedTuple):
    """An order. `do`: "present", "neutral" or "stop"; `trial`: name of the trial that is presented; `showing`: the
    step."""

    number: int
    do: str
    showing: Showing | None = None
    trial: str = ""


def as_sent(order: Order, study: StudyFile, tag: str) -> dict[str, Any]:
    """The message of an order, as a dict for JSON; only the number and `do` where nothing is presented. `tag`: makes
    the labels of renderings those of this session."""
    assert study.stimulus is not None  # orders are for this program only
    showing = order.showing
    message: dict[str, Any] = {"order": order.number, "do": order.do}
    if showing is None:
        return message
    rendering = showing.values is not None
    return message | {
        "trial": order.trial,
        "step": showing.step,
        "show": "test" if rendering else showing.show,
        "side": showing.show if rendering else "",
        "values": in_words(study_of(study, showing.material), showing.values or {}),
        "label": label_of(showing.values, tag) if showing.values is not None else "",
        "within_s": study.stimulus.within,
    }


def parameters_of(study: StudyFile) -> list[dict[str, Any]]:
    """The parameters of orders, one dict each: levels, or range, unit and tolerance of a confirmation in that unit. On
    a logarithmic scale, where it grows with the value, the tolerance is that at the low end, and `share` is
    relative."""
    return [_parameter(study, p) for p in study.space.parameters]


def _parameter(study: StudyFile, p: Parameter) -> dict[str, Any]:
    """One parameter of `parameters_of`: `name` and `levels`, or `name`, `unit`, `low`, `high`, `tolerance` (at the low
    end, in the unit) and, on a logarithmic scale, `share` (the same as a fraction of the value)."""
    assert study.stimulus is not None
    if p.levels:
        return {"name": p.name, "levels": list(p.levels)}
    content = {
        "name": p.name,
        "unit": p.unit,
        "low": p.low,
        "high": p.high,
        "tolerance": study.stimulus.off_by(p, p.low),
    }
    return content | ({"share": study.stimulus.tolerance_of(p)} if p.scale == "log" else {})
