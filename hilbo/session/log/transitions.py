"""The effect of each event on the state of a live session: functions that take a `LiveSession` and return the next one.

`APPLY` has the function for each kind of event, called with state and event; an event's `data["id"]` is a trial.

A trial with a hold, stop or loss of the device after its begin is voided and repeated; so is one that a stimulus
program did not present as requested (`missed`), which counts as a stop. A repeated, voided, undone, interrupted or
paused presentation starts again from its first step. Whatever changes the answers drops a pending proposal that was
made from the old ones. A repetition that was stopped twice is not asked again.
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
    """Add the proposed trial; a repetition is removed from `wanted`."""
    data = event.data
    trial = Trial(
        data["id"], data["block"], data["trial"], data, event.time, planned=data["planned"], repeats=data["repeats"]
    )
    return replace(state, trials=(*state.trials, trial), wanted=_without(state.wanted, data["repeats"]))


def _sent(state, event):
    """Record that a side's stimulus is active; with a stimulus program, also the values that it confirmed."""
    trial = state.trial(event.data["id"])
    side = event.data["side"]
    state = state.with_trial(trial.id, sent={**trial.sent, side: event.data})
    if state.study.stimulus is None:
        return state
    study = study_of(state.study, state.header.blocks[trial.block].material)
    values = counted(study, trial.renderings[side], event.data["values"])
    return state.with_trial(trial.id, confirmed={**trial.confirmed, side: values})


def _stimulus(state, event):
    """Record that a step of the presentation begins or ends. A rendering counts as presented from the beginning of its
    step; step 0 first resets which sides were presented."""
    trial, show = state.trial(event.data["id"]), event.data["show"]
    if not event.data["on"]:
        return state.with_trial(trial.id, on=None)
    before = trial.felt if event.data["step"] > 0 else frozenset()  # the first step resets the presentation
    felt = before | ({show} & set(trial.renderings))
    return state.with_trial(trial.id, step=event.data["step"], on=show, felt=felt)


def _answered(state, event):
    """Set the trial to "answered", with its values, client, times and telemetry."""
    data = event.data
    facts = {"seq": event.seq, "time": event.time, "browser": data["browser"]}
    given = {"values": data["values"], "client": data["client"], "telemetry": data.get("telemetry")}
    return state.with_trial(data["id"], status="answered", answered=facts, on=None, **given)


def _without(wanted: tuple[int, ...], id: int | None) -> tuple[int, ...]:
    """Copy of `wanted` without the first occurrence of `id`; unchanged if there is none."""
    place = wanted.index(id) if id in wanted else len(wanted)
    return wanted[:place] + wanted[place + 1 :]


def _taken_out(state, trial, **changes):
    """Change a trial so that it no longer counts (`changes` of its fields). If it was answered, and is no repetition,
    also drop the pending proposal, and pending or wanted repetitions of it."""
    state = state.with_trial(trial.id, on=None, **changes)
    if trial.status != "answered" or trial.repeats:
        return state
    state = replace(state.dropped(), wanted=tuple(id for id in state.wanted if id != trial.id))
    return _without_pending_repeat(state, trial.id)


def _without_pending_repeat(state, id: int):
    """Drop the pending trial if it is a repetition of trial `id`."""
    pending = state.pending
    if pending is None or pending.repeats != id:
        return state
    return state.with_trial(pending.id, status="dropped", on=None)


def _counts(state, id: int) -> bool:
    """Whether trial `id` has an answer that counts."""
    return state.trial(id).status == "answered"


def _undone(state, event):
    """Set the trial to "undone"; an undone repetition is wanted again, first, if the answer that it repeats counts."""
    trial = state.trial(event.data["id"])
    state = _taken_out(state, trial, status="undone")
    again = trial.repeats and _counts(state, trial.repeats)
    return replace(state, wanted=(trial.repeats, *state.wanted)) if again else state


def _again(trial) -> dict[str, Any]:
    """Changes of a trial's fields that restart its presentation from the first step."""
    return {"presentation": trial.presentation + 1, "step": None, "on": None, "felt": frozenset(), "confirmed": {}}


def _repeated(state, event):
    """Restart the trial if it is pending; else append it to `wanted`, the trials to be presented once more."""
    trial = state.trial(event.data["id"])
    if trial.status == "pending":
        return state.with_trial(trial.id, **_again(trial))
    return replace(state, wanted=(*state.wanted, trial.id))


def stop_key(trial: Trial, side: str) -> Any:
    """Key under which `LiveSession.stops` counts a stop: a planned trial's index, else the items of the side's
    rendering."""
    return tuple(trial.renderings[side].items()) if trial.planned is None else trial.planned


def _made_void(state, trial, by, reason, sides=()):
    """Set the trial to "void" by "rule" or "experimenter". A repetition is wanted again if the answer that it repeats
    counts, unless it was stopped twice.

    `sides`: those that were on when the device stopped. Stored in `voided` with: `asked_again`, whether a repetition is
    wanted again, and `beside`, the other answers to the same renderings that count now; a later one replaces this
    trial.
    """
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
    """Void the trial, as the experimenter requested."""
    return _made_void(state, state.trial(event.data["id"]), "experimenter", event.data["reason"])


def _skipped(state, event):
    """Set the trial to "left out"."""
    voided = {"by": "experimenter", "reason": event.data["reason"], "sides": []}
    return state.with_trial(event.data["id"], status="left out", on=None, voided=voided)


def _restored(state, event):
    """Set a voided trial to "answered" again. For a repetition, its replacement is no longer wanted, or is dropped if
    pending; for any other trial the pending proposal is dropped."""
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
    """Begin a break; a presentation that is not complete will restart from its first step."""
    trial = state.pending
    if trial is not None and trial.unfinished:
        state = state.with_trial(trial.id, **_again(trial))
    return replace(state, paused=event.data["by"])


def _device(state, event):
    """Store the device's condition. With hold, estop or lost, void the trial (None: the pending one) if it had
    begun."""
    data = event.data
    trial = state.pending if data["trial"] is None else state.trial(data["trial"])
    begun = trial is not None and trial.step is not None and trial.status in ("pending", "answered")
    if data["condition"] in _STOPPED and trial is not None and begun:
        reason = f"device: {data['condition']}" + (f" ({data['reason']})" if data.get("reason") else "")
        state = _made_void(state, trial, "rule", reason, {trial.on} & set(trial.renderings))
    return replace(state, machine=data)


def _missed(state, event):
    """Void the trial, by rule; counts as a stop of the side that was not presented."""
    trial = state.trial(event.data["id"])
    reason = f"stimulus: {event.data['reason']}"
    return _made_void(state, trial, "rule", reason, {event.data["show"]} & set(trial.renderings))


def _warm_up_again(state, event):
    """Repeat the warm-up. The pending trial is dropped and will be proposed again after it; so will a repetition."""
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
