"""The log's events as sentences, and the trials as rows of a table, for the experimenter's page."""

import math
from collections.abc import Callable, Mapping
from datetime import datetime
from typing import Any

from hilbo.app.pages.pace import duration
from hilbo.app.rigs.rig import Notice
from hilbo.session.log.actions import restorable
from hilbo.session.log.records import Event, Trial
from hilbo.session.log.state import LiveSession
from hilbo.study.file.trial_flags import FLAGS, SAMPLES

__all__ = ["line", "meant", "place_of", "sentence", "table"]

_QUICK = 0.5  # s
_Data = Mapping[str, Any]  # of an event
_SHOWN = {"reference": "the reference", "a": "stimulus A", "b": "stimulus B", "neutral": "nothing"}
_WHO = {"stimulus": "The program that presents", "preparer": "The preparer"}
_DEVICE = {
    "ready": "is ready",
    "running": "renders",
    "stopped": "is stopped",
    "hold": "is in hold",
    "estop": "was stopped",
}


def place_of(trial: Trial) -> str:
    """The name of a trial on the experimenter's page: the first letter of its phase and its number in it, such as
    "O12"."""
    return trial.data["phase"][0].upper() + str(trial.number)


def meant(trial: Trial | None) -> dict[str, Any] | None:
    """The id and the name of a trial, {"trial": 14, "name": "O12"}, for the page's commands; None without a trial."""
    return None if trial is None else {"trial": trial.id, "name": place_of(trial)}


def line(state: LiveSession, event: Event | Notice) -> list[str]:
    """An event's sequence number ("" for a device's notice), local time of day, and sentence, as three texts."""
    at = datetime.fromtimestamp(event.time).strftime("%H:%M:%S")
    if isinstance(event, Notice):
        return ["", at, f"The device, {event.text}."]
    return [str(event.seq), at, sentence(state, event)]


def sentence(state: LiveSession, event: Event) -> str:
    """What an event did, as a sentence. `state`: any state of the session after the event."""
    data = event.data
    trial = data.get("id", data.get("trial") if event.kind == "device" else None)
    name = "" if trial is None else place_of(state.trial(trial))
    if event.kind == "repeat":
        return _repeated(state.trial(data["id"]), name, event.seq)
    pause = next((f"A pause of {duration(p.seconds)}. " for p in state.pauses if p.seq == event.seq), "")
    return pause + _SENTENCES[event.kind](state, name, data)


def _because(data: _Data) -> str:
    """The end of a sentence: ": reason." where the data have a reason, else "."."""
    reason = str(data.get("reason", "")).strip().rstrip(".")
    return f": {reason}." if reason else "."


def _proposed(_state: LiveSession, name: str, data: _Data) -> str:
    """Which trial (`name`) comes next, and why: a repetition, planned sets, or how it was chosen."""
    sets = " and ".join(data.get("sets", {}).values())
    if data["repeats"] is not None:
        return f"{name} comes next: a repetition, as a check of consistency."
    by = data.get("choice", {}).get("by")
    why = f": {sets}, as planned" if sets else f", chosen by {'UCB' if by == 'ucb' else by}" if by else ""
    return f"{name} comes next{why}."


def _presented(_state: LiveSession, name: str, data: _Data) -> str:
    """Which step of a trial (`name`) begins or ends."""
    shown = _SHOWN[data["show"]]
    if data["show"] == "neutral":
        return f"{name}: a neutral interval {'begins' if data['on'] else 'ends'}."
    return f"{name}: {shown} {'is presented' if data['on'] else 'ends'}."


def _answered(_state: LiveSession, name: str, data: _Data) -> str:
    """The answer to a trial (`name`) and its response time; a remark on one that was given too quickly, and the flags
    of the device's samples."""
    values, took = data["values"], data["browser"].get("response_s")
    classes = {side: values[f"class_{side}"] for side in "ab" if f"class_{side}" in values}
    words = list(classes.values()) if len(values) == 1 else [f"{s.upper()} {c}" for s, c in classes.items()]
    words += [f"{values['preferred'].upper()} preferred"] if "preferred" in values else []
    after = "" if took is None else f" after {took:.1f} s"
    quick = _quick(data["browser"])
    return f"{name} is answered{after}: {', '.join(words)}.{f' {quick.capitalize()}.' if quick else ''}" + _flags(
        data.get("telemetry")
    )


def _quick(browser: Mapping[str, float]) -> str:
    """A remark, without a full stop, if one of several questions was answered in less than `_QUICK` s, faster than it
    can be read; else empty."""
    shortest = browser.get("shortest_s", math.inf)
    return f"one question answered after only {shortest:.2f} s" if shortest < _QUICK else ""


def _flags(telemetry: Mapping[str, int] | None) -> str:
    """How many samples of a trial have each of the device's flags, as a sentence after a space; empty without telemetry
    or flags."""
    if telemetry is None or set(telemetry) == {SAMPLES}:
        return ""
    words = ", ".join(f"{name.replace('_', ' ')} {telemetry[name]}" for name in FLAGS if name in telemetry)
    return f" Flagged of {telemetry[SAMPLES]} samples: {words}."


def _repeated(trial: Trial, name: str, seq: int) -> str:
    """Whether a trial will be repeated later (if it was answered before event number `seq`) or begins again now."""
    answered = trial.answered is not None and trial.answered["seq"] < seq
    return f"{name} will be repeated later." if answered else f"{name} begins again from its first step."


def _device(state: LiveSession, name: str, data: _Data) -> str:
    """The new condition of the device, program or preparer, with its reason, and whether it made the trial (`name`)
    void."""
    stimulus = state.study.stimulus
    who = "The device" if stimulus is None else _WHO[stimulus.role]
    condition = data["condition"]
    reason = str(data.get("reason", ""))
    if condition == "lost":
        return f"{who} is lost{_because(data)}"
    words = f"{who} {_DEVICE[condition]}{_because({'reason': reason})}"
    voided = state.trial(data["trial"]).voided if condition in ("hold", "estop") and name else None
    return f"{words} {name} is void." if voided and voided["by"] == "rule" else words


_SENTENCES: dict[str, Callable[[LiveSession, str, _Data], str]] = {
    "propose": _proposed,
    "sent": lambda _, name, data: f"{name}: {_SHOWN[data['side']]} is active.",
    "stimulus": _presented,
    "missed": lambda _, name, data: f"{name} is void, {_SHOWN[data['show']]} was not presented{_because(data)}",
    "answer": _answered,
    "undo": lambda _, name, data: f"The answer to {name} is taken back{_because(data)}",
    "void": lambda _, name, data: f"{name} is made void{_because(data)}",
    "restore": lambda _, name, data: f"The answer to {name} counts again.",
    "skip": lambda _, name, data: f"{name} is left out{_because(data)}",
    "pause": lambda _, name, data: f"A break, requested by the {data['by']}.",
    "resume": lambda _, name, data: "The break is over.",
    "abort": lambda _, name, data: f"The session is ended early{_because(data)}",
    "note": lambda _, name, data: f"Note: {data['text']}",
    "more": lambda _, name, data: "The participant wants another rendering of the warm-up.",
    "go_on": lambda _, name, data: "The next part begins.",
    "warm_up": lambda _, name, data: f"The warm-up comes again after {duration(data['pause_s'])}.",
    "device": _device,
}


def table(state: LiveSession) -> dict[str, Any]:
    """Head and rows of the table of trials, newest first: name, response, remark, and the stimuli: the names of
    the sets if all trials were planned, else the value of each parameter."""
    parameters = state.study.space.parameters
    chosen = any(not trial.sets for trial in state.trials)
    heads = [f"{p.name} ({p.unit})" if p.unit else p.name for p in parameters] if chosen else ["sets"]
    return {
        "head": ["trial", "answer", "remark", *heads],
        "rows": [_row(state, trial, chosen) for trial in reversed(state.trials)],
    }


def _row(state: LiveSession, trial: Trial, chosen: bool) -> dict[str, Any]:
    """A row of the table: its cells; `kind`, "now", "voided" (answer or trial does not count), "repeated" (it has a
    remark) or ""; and for a voided answer that can be restored its trial. `chosen`: the table has parameters, not
    sets."""
    shown = _values(state, trial) if chosen else [" / ".join(trial.sets.values())]
    answer, remark = " ".join((trial.values or {}).values()), _remark(state, trial)
    discarded = trial.status not in ("pending", "answered")
    kind = "voided" if discarded else "now" if trial.status == "pending" else "repeated" if remark else ""
    flags = [name.replace("_", " ") for name in FLAGS if name in (trial.telemetry or {})]
    quick = _quick((trial.answered or {}).get("browser", {}))
    remarks = "; ".join([text for text in (remark, quick) if text] + flags)
    row = {"kind": kind, "cells": [place_of(trial), answer, remarks, *shown]}
    voided = trial.status == "void" and trial.values is not None
    return row | ({"restore": meant(trial)} if voided and restorable(state, trial.id) else {})


def _values(state: LiveSession, trial: Trial) -> list[Any]:
    """The values that were presented, one for each parameter; those of a pair are both in one text."""
    parameters, both = state.study.space.parameters, list(trial.presented.values())
    if len(both) > 1:
        return [" / ".join(p.words(values[p.name]) for values in both) for p in parameters]
    return [p.shown(both[0][p.name]) if p.levels else both[0][p.name] for p in parameters]


def _remark(state: LiveSession, trial: Trial) -> str:
    """What there is to say about a trial, separated by "; ", empty for an answered trial to which nothing applies:
    "now" for the pending trial, or why a trial does not count; which trial it repeats; how often it was presented, if
    more than once; whether it will be repeated."""
    reason = str((trial.voided or {}).get("reason", ""))
    status = {
        "void": "void",
        "left out": "left out",
        "undone": "answer taken back",
        "dropped": "not presented: an earlier response changed, or the warm-up was repeated",
        "pending": "now",
    }.get(trial.status)
    words = [f"{status}: {reason}" if status and reason else status] if status else []
    words += [f"repeats {place_of(state.trial(trial.repeats))}"] if trial.repeats is not None else []
    words += [f"presented {trial.presentation} times"] if trial.presentation > 1 else []
    words += ["to be repeated"] if trial.id in state.wanted else []
    return "; ".join(words)
