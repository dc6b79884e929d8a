"""What each event does to the state of a live session (`hilbo.session.log.state`).

A trial in which the device holds, stops or is lost after it began is void, and is asked again; so is one in which a
program that presents did not present what it was asked for, which counts as a stop (`missed`). A repeated, voided,
undone or interrupted presentation starts from its first step, and so does one that a pause cut off. Whatever changes
the answers drops a proposal that was made from the old ones. A repetition that was stopped twice is not asked again.
"""

from dataclasses import replace
from typing import Any

from hilbo.session.log.header_check import study_of
from hilbo.session.log.presented import counted
from hilbo.session.log.records import Trial, WarmUp

__all__ = ["APPLY", "STOPS", "stop_key"]

_STOPPED = ("hold", "estop", "lost")


STOPS = 2
"""So often may the device stop in a rendering before it is not proposed again, or its planned trial put off."""


def _proposed(state, event):
    data = event.data
    trial = Trial(
        data["id"], data["block"], data["trial"], data, event.time, planned=data["planned"], repeats=data["repeats"]
    )
    return replace(state, trials=(*state.trials, trial), wanted=_without(state.wanted, data["repeats"]))


def _sent(state, event):
    trial = state.trial(event.data["id"])
    side = event.data["side"]
    state = state.with_trial(trial.id, sent={**trial.sent, side: event.data})
    if state.study.stimulus is None:
        return state
    values = counted(study_of(state.study, state.header.blocks[trial.block].material), event.data["values"])
    return state.with_trial(trial.id, confirmed={**trial.confirmed, side: values})


def _stimulus(state, event):
    """A step of the presentation begins or ends; a rendering counts as felt from then on, and step 0 starts anew."""
    trial, show = state.trial(event.data["id"]), event.data["show"]
    if not event.data["on"]:
        return state.with_trial(trial.id, on=None)
    before = trial.felt if event.data["step"] > 0 else frozenset()  # the first step begins everything anew
    felt = before | ({show} & set(trial.renderings))
    return state.with_trial(trial.id, step=event.data["step"], on=show, felt=felt)


def _answered(state, event):
    data = event.data
    facts = {"seq": event.seq, "time": event.time, "browser": data["browser"]}
    given = {"values": data["values"], "client": data["client"], "telemetry": data.get("telemetry")}
    return state.with_trial(data["id"], status="answered", answered=facts, on=None, **given)


def _without(wanted: tuple[int, ...], id: int | None) -> tuple[int, ...]:
    """The trials to be felt once more without the first mention of one."""
    place = wanted.index(id) if id in wanted else len(wanted)
    return wanted[:place] + wanted[place + 1 :]


def _taken_out(state, trial, **changes):
    """An answer, or a proposal, does not count any more: what was made from it goes, and it is not repeated."""
    state = state.with_trial(trial.id, on=None, **changes)
    if trial.status != "answered" or trial.repeats:
        return state
    state = replace(state.dropped(), wanted=tuple(id for id in state.wanted if id != trial.id))
    return _without_pending_repeat(state, trial.id)


def _without_pending_repeat(state, id: int):
    """The repetition of a trial that is being felt goes."""
    pending = state.pending
    if pending is None or pending.repeats != id:
        return state
    return state.with_trial(pending.id, status="dropped", on=None)


def _counts(state, id: int) -> bool:
    """Whether the answer to this trial counts."""
    return state.trial(id).status == "answered"


def _undone(state, event):
    trial = state.trial(event.data["id"])
    state = _taken_out(state, trial, status="undone")
    again = trial.repeats and _counts(state, trial.repeats)
    return replace(state, wanted=(trial.repeats, *state.wanted)) if again else state


def _again(trial) -> dict[str, Any]:
    return {"presentation": trial.presentation + 1, "step": None, "on": None, "felt": frozenset(), "confirmed": {}}


def _repeated(state, event):
    trial = state.trial(event.data["id"])
    if trial.status == "pending":
        return state.with_trial(trial.id, **_again(trial))
    return replace(state, wanted=(*state.wanted, trial.id))


def stop_key(trial: Trial, side: str) -> Any:
    """What a stop counts for."""
    return tuple(trial.renderings[side].items()) if trial.planned is None else trial.planned


def _made_void(state, trial, by, reason, sides=()):
    """`sides`: the one that was on when the device stopped. `asked_again`: whether a repetition is. `beside`: the
    answers to the same renderings that counted at that time; any other takes the place of this one."""
    beside = [t.id for t in state.answers(trial.block) if t.id != trial.id and t.renderings == trial.renderings]
    voided = {"by": by, "reason": reason, "sides": list(sides), "beside": beside}
    state = _taken_out(state, trial, status="void", voided=voided)
    if not trial.repeats:
        return state
    stops = state.stops(trial.block)
    stopped_twice = any(stops[stop_key(trial, side)] >= STOPS for side in trial.renderings)
    again = not stopped_twice and _counts(state, trial.repeats)
    state = state.with_trial(trial.id, voided=voided | {"asked_again": again})
    return replace(state, wanted=(trial.repeats, *state.wanted)) if again else state


def _voided(state, event):
    return _made_void(state, state.trial(event.data["id"]), "experimenter", event.data["reason"])


def _skipped(state, event):
    voided = {"by": "experimenter", "reason": event.data["reason"], "sides": []}
    return state.with_trial(event.data["id"], status="left out", on=None, voided=voided)


def _restored(state, event):
    trial = state.trial(event.data["id"])
    again, state = trial.voided, state.with_trial(trial.id, status="answered", voided=None)
    if not trial.repeats:
        return state.dropped()
    if not again.get("asked_again"):
        return state
    if trial.repeats in state.wanted:
        return replace(state, wanted=_without(state.wanted, trial.repeats))
    return _without_pending_repeat(state, trial.repeats)


def _paused(state, event):
    trial = state.pending
    if trial is not None and trial.unfinished:
        state = state.with_trial(trial.id, **_again(trial))
    return replace(state, paused=event.data["by"])


def _device(state, event):
    data = event.data
    trial = state.pending if data["trial"] is None else state.trial(data["trial"])
    begun = trial is not None and trial.step is not None and trial.status in ("pending", "answered")
    if data["condition"] in _STOPPED and trial is not None and begun:
        reason = f"device: {data['condition']}" + (f" ({data['reason']})" if data.get("reason") else "")
        state = _made_void(state, trial, "rule", reason, {trial.on} & set(trial.renderings))
    return replace(state, machine=data)


def _missed(state, event):
    trial = state.trial(event.data["id"])
    reason = f"stimulus: {event.data['reason']}"
    return _made_void(state, trial, "rule", reason, {event.data["show"]} & set(trial.renderings))


def _warm_up_again(state, event):
    """The pending proposal is made again after the warm-up, and so is a repetition."""
    trial, block = state.pending, event.data["block"]
    if trial is not None:
        state = state.with_trial(trial.id, status="dropped", on=None)
    if trial is not None and trial.repeats:
        state = replace(state, wanted=(trial.repeats, *state.wanted))
    following = state.block if state.block != block else block + 1
    again = WarmUp(block, following, len(state.trials), event.time)
    return replace(state, again=again, extra={**state.extra, block: 0}, passed=state.passed - {following})


APPLY = {
    "propose": _proposed,
    "sent": _sent,
    "stimulus": _stimulus,
    "missed": _missed,
    "answer": _answered,
    "undo": _undone,
    "repeat": _repeated,
    "void": _voided,
    "skip": _skipped,
    "restore": _restored,
    "pause": _paused,
    "resume": lambda state, event: replace(state, paused=None),
    "abort": lambda state, event: replace(state, aborted=event.data["reason"]),
    "note": lambda state, event: replace(state, notes=(*state.notes, (event.time, event.data["text"]))),
    "more": lambda state, event: replace(
        state, extra={**state.extra, event.data["block"]: state.extra.get(event.data["block"], 0) + 1}
    ),
    "go_on": lambda state, event: replace(state, passed=state.passed | {event.data["block"]}),
    "warm_up": _warm_up_again,
    "device": _device,
}
