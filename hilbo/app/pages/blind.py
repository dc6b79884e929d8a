"""The view of an experimenter who must not know the parameters: progress, answers, and labels of renderings.

Only fields that cannot contain a parameter are copied from the full view: names of sets, choices, predictions,
confirmed values, reasons that state values and what a device sends unasked are left out. Each rendering has a label
(`set_codes.label_of`), the same that the preparer sees.
"""

from collections.abc import Mapping
from typing import Any

import msgspec

from hilbo.app.interface import HubInterface
from hilbo.app.pages import log_words
from hilbo.app.pages.session_views import View
from hilbo.session.log.records import Event, Trial
from hilbo.session.plan.set_codes import label_of

__all__ = ["experimenter"]

_SAME = (
    *("who", "what", "banners", "phase", "phase_words", "alert", "may", "means", "participant_here", "all_delays"),
    "fits_after_an_answer",
)
_WHOLE = ("study", "screen", "seq", "block", "pending", "paused", "aborted", "notes", "began", "last", "participant")
_TRIAL = ("id", "phase", "number", "status", "presentation", "step", "values", "answered")
_BANNER = "Blind: this page shows no parameter; stimuli are shown as labels"


def experimenter(hub: HubInterface, seen: Mapping[str, Any]) -> View:
    """The blind experimenter's view, as a dict for JSON. `seen`: the full view of `views.experimenter`, which is not
    changed."""
    state, trial = hub.state, hub.state.pending
    blocks = seen["trial"][: len(state.header.blocks)]
    labels = [[f"Rendering {side.upper()}", label] for side, label in _labels(hub, trial).items()]
    whole = {key: seen["whole"][key] for key in _WHOLE}
    whole["trials"] = [{key: one[key] for key in _TRIAL if key in one} for one in seen["whole"]["trials"]]
    return {key: seen[key] for key in _SAME} | {
        "banners": [*seen["banners"], _BANNER],
        "trial": [*blocks, *labels],
        "device": seen["device"] | {"rows": [row for row in seen["device"]["rows"] if row[0] != "Refused"]},
        "trust": [],
        "table": _table(hub, seen["table"]["rows"]),
        "log": [log_words.line(state, _unvalued(event)) for event in hub.recent if isinstance(event, Event)][:60],
        "map_version": "",
        "whole": whole,
    }


def _labels(hub: HubInterface, trial: Trial | None) -> dict[str, str]:
    """Side ("a", "b") -> label of its rendering in a trial; empty without a trial."""
    return {} if trial is None else {side: label_of(values, hub.tag) for side, values in trial.renderings.items()}


def _table(hub: HubInterface, rows: list[View]) -> View:
    """The table of trials, newest first, with a label for each rendering in the column after the remark. `rows`: those
    of the full view, in the same order. The remark on a trial voided by a rule is cut, because it may have values."""
    labelled = []
    for trial, row in zip(reversed(hub.state.trials), rows, strict=True):
        place, answer, remark = row["cells"][:3]
        remark = _first_words(remark) if trial.voided and trial.voided.get("by") == "rule" else remark
        labelled.append(row | {"cells": [place, answer, remark, " / ".join(_labels(hub, trial).values())]})
    return {"head": ["trial", "answer", "remark", "label"], "rows": labelled}


def _unvalued(event: Event) -> Event:
    """A copy of an event without values and names of sets."""
    data = {key: value for key, value in event.data.items() if key not in ("sets", "choice")}
    if event.kind == "missed":
        data["reason"] = str(data["reason"]).partition(":")[0]
    return msgspec.structs.replace(event, data=data)


def _first_words(remark: str) -> str:
    """The first three parts of a remark, which colons separate, such as `void: stimulus: off`; the later ones may state
    values."""
    return ":".join(remark.split(":")[:3])
