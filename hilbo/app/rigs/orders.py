"""Orders to whoever presents a study's renderings, and how they are sent; docs/guides/stimulus.md has every key.

An order says what shall be the case from now on, not what shall change, so that nothing is lost with a message.
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
    """What shall be the case. `do`: present, neutral or stop; `trial`: a name for the trial that is presented."""

    number: int
    do: str
    showing: Showing | None = None
    trial: str = ""


def as_sent(order: Order, study: StudyFile, tag: str) -> dict[str, Any]:
    """The message that gives an order; `tag` is what trials of the session are known by."""
    assert study.stimulus is not None  # nobody else is given orders
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
    """What the parameters of orders may be, and how far off a confirmation may be, in their units. On a logarithmic
    scale, where that grows with the value, it is told for the low end, and as a share."""
    return [_parameter(study, p) for p in study.space.parameters]


def _parameter(study: StudyFile, p: Parameter) -> dict[str, Any]:
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
