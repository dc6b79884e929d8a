"""Actions in a live session: each function checks one in the current state, and returns the event to be logged.

    state = LiveSession.start(study, header)
    event = propose(state, chooser, at)        # or answer, undo, void, ...; or RefusedError
    state = state.after(event)                 # once it is on disk

The functions change nothing; `at` is the time in s since the epoch. All raise `RefusedError` for an action that is not
possible in the state, and for a time that is not finite. `hilbo.session.log.transitions` applies the events.
"""

import math
from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

from hilbo.errors import InputError
from hilbo.session.log.header_check import protocol_of, study_of
from hilbo.session.log.presented import check_confirmed
from hilbo.session.log.records import Event, Need, RefusedError, Trial
from hilbo.session.log.state import LiveSession
from hilbo.study.file.trial_flags import FLAGS, SAMPLES
from hilbo.study.formats.cell_text import runs_in_a_spreadsheet

__all__ = [
    "abort",
    "answer",
    "device",
    "go_on",
    "missed",
    "more",
    "note",
    "pause",
    "present",
    "propose",
    "repeat",
    "restorable",
    "restore",
    "resume",
    "sent",
    "skip",
    "undo",
    "void",
    "warm_up",
]


@runtime_checkable
class Chooser(Protocol):
    """Selects renderings: see `hilbo.session.choose.look_ahead.LiveChooser`."""

    def choose(self, state: "LiveSession", need: Need) -> dict[str, Any]:
        """Return part of a proposal's data: `renderings`, and where they apply `sets`, `first` and `choice` (the
        explanation)."""
        ...


# Actions: each returns its event, or raises RefusedError.


def propose(state: LiveSession, chooser: Chooser, at: float) -> Event:
    """Event for the next trial, with the renderings that `chooser` selects. Raises RefusedError if nothing is to be
    proposed, InputError for a rendering that is not finite."""
    if state.need is None:
        raise RefusedError("nothing", f"nothing is to be proposed now: the screen shows {state.screen}.")
    need = state.need
    block = state.header.blocks[need.block]
    phase = "repeat" if need.repeats is not None else block.phase
    data = {
        "id": len(state.trials) + 1,
        "block": need.block,
        "phase": phase,
        "material": block.material,
        "trial": _number(state, phase, block.material),
        "planned": need.planned,
        "repeats": need.repeats,
    }
    choice = chooser.choose(state, need)
    for name, value in ((n, v) for values in choice["renderings"].values() for n, v in values.items()):
        if not math.isfinite(value):
            raise InputError(f"the next rendering is no number ({name} is {value}); undo or void the last answer.")
    return _event(state, "propose", at, **data, **choice)


def sent(state: LiveSession, trial: int, side: str, at: float, **facts) -> Event:
    """Event: a stimulus is active. `facts`: what a device reports (CRC, values read back, times), or `values`, those
    that a stimulus program confirms. Raises RefusedError for a trial that is not pending or lacks the side, and for
    values beyond the tolerance."""
    pending = _pending_trial(state, trial)
    if side not in pending.renderings:
        raise RefusedError("bad-answer", f'trial {trial} has no side "{side}".')
    if state.study.stimulus is not None:
        here = study_of(state.study, state.header.blocks[pending.block].material)
        check_confirmed(here, pending.renderings[side], facts.get("values"))
    return _event(state, "sent", at, id=trial, side=side, **facts)


def present(state: LiveSession, trial: int, step: int, on: bool, at: float) -> Event:
    """Event: step `step` (from 0) of a pending trial begins (`on`) or ends. Raises `RefusedError` if the trial is not
    pending or has no such step; and for a beginning, during a break, after the end, or with a rendering that is not
    confirmed."""
    pending = _pending_trial(state, trial)
    if on and state.screen != "trial":
        raise RefusedError("paused", f"no step of trial {trial} begins now: the screen shows {state.screen}.")
    steps = state.steps_of(pending)
    if not 0 <= step < len(steps):
        raise RefusedError("bad-answer", f"trial {trial} has {len(steps)} steps, none with the number {step}.")
    show = steps[step][0]
    if on and state.study.stimulus is not None and show in pending.renderings and show not in pending.confirmed:
        raise RefusedError("unconfirmed", f'it is not confirmed that side "{show}" of trial {trial} is presented.')
    return _event(state, "stimulus", at, id=trial, step=step, show=show, on=bool(on))


def missed(state: LiveSession, trial: int, show: str, reason: str, at: float) -> Event:
    """Event: a stimulus program did not present `show` as requested (too late, too far off, or it failed); voids the
    trial.

    Raises `RefusedError` if that trial is not pending.
    """
    _pending_trial(state, trial)
    return _event(state, "missed", at, id=trial, show=show, reason=reason)


def answer(
    state: LiveSession,
    trial: Any,
    client: Any,
    values: Any,
    at: float,
    *,
    browser: Any = None,
    telemetry: Mapping[str, int] | None = None,
    felt: bool = True,
) -> Event | None:
    """Event for a participant's answer; None if this very answer (trial, client id and values) is accepted already.

    `values`: class_a, class_b (responses of the study), preferred ("a" or "b"), as the phase asks. `browser`: its time
    and the response time, s; numbers by name. `telemetry`: counts of the device's samples during the trial, in total
    (`samples`) and with each flag; None if none were recorded. `felt`: refuse an answer before all sides were
    presented. Raises RefusedError, also for another answer to an answered trial, and for a trial that is over.
    """
    if not isinstance(trial, int) or isinstance(trial, bool) or not isinstance(client, str) or not client:
        raise RefusedError("bad-answer", "an answer needs the number of its trial and the id of its client.")
    asked = state.trial(trial)
    if asked.values is not None:
        if asked.client == client and asked.values == values:
            return None
        if asked.client == client:
            raise RefusedError("answered", f"trial {trial} is answered otherwise already; the first answer counts.")
        raise RefusedError("answered", f"trial {trial} is answered already, from another page.")
    if asked.status != "pending":
        code = "voided" if asked.status == "void" else "old-trial"
        raise RefusedError(code, f"trial {trial} is over ({asked.status}); the next one will be shown.")
    if state.aborted is not None:
        raise RefusedError("over", "the session has ended.")
    if felt and asked.felt != frozenset(asked.renderings):
        raise RefusedError("unfelt", f"trial {trial} has not been felt yet.")
    _check_values(state, asked, values)
    counts = {} if telemetry is None else {"telemetry": _counts(telemetry)}
    return _event(state, "answer", at, id=trial, client=client, values=dict(values), browser=_times(browser), **counts)


def undo(state: LiveSession, at: float, reason: str = "") -> Event:
    """Event that takes back the last answer; its trial is asked again. Raises `RefusedError` if there is none, and
    after an abort."""
    _running(state)
    last = state.last_answered
    if last is None:
        raise RefusedError("nothing", "there is no answer to undo.")
    return _event(state, "undo", at, id=last.id, reason=_text(reason))


def repeat(state: LiveSession, at: float, trial: int | None = None) -> Event:
    """Event that restarts the pending trial (`trial` None, or its id), or presents an answered one again later, as a
    check of consistency. The answer to such a repetition has the phase "repeat" and is never fitted.

    Raises `RefusedError` if there is no such trial, or it is an answered repetition itself, and after an abort.
    """
    _running(state)
    repeated = state.pending if trial is None else state.trial(trial)
    if repeated is None or repeated.status not in ("pending", "answered"):
        raise RefusedError("nothing", "there is no trial to repeat.")
    if repeated.repeats is not None and repeated.status == "answered":
        raise RefusedError("nothing", f"trial {repeated.id} is a repetition itself; repeat trial {repeated.repeats}.")
    return _event(state, "repeat", at, id=repeated.id)


def void(state: LiveSession, trial: int, reason: str, at: float) -> Event:
    """Event: a pending or answered trial shall not count; it is asked again. Unlike stops of the device, voiding a
    rendering never excludes it. Raises `RefusedError` if the trial does not count already, and after an abort."""
    _running(state)
    voided = state.trial(trial)
    if voided.status not in ("pending", "answered"):
        raise RefusedError("nothing", f"trial {trial} is {voided.status} already.")
    return _event(state, "void", at, id=trial, reason=_text(reason))


def restore(state: LiveSession, trial: int, at: float) -> Event:
    """Event: a voided answer shall count after all. Raises RefusedError if it is none, if another answer has its
    place, and after an abort."""
    _running(state)
    voided = state.trial(trial)
    if voided.status != "void" or voided.values is None:
        raise RefusedError("nothing", f"trial {trial} has no voided answer.")
    if _filled(state, voided):
        raise RefusedError("nothing", f"the place of trial {trial} has been filled by another one.")
    return _event(state, "restore", at, id=trial)


def skip(state: LiveSession, reason: str, at: float, trial: int | None = None) -> Event:
    """Event: the pending planned trial, which the device has stopped twice, is left out for good; `trial` is its id, or
    None.

    Raises RefusedError if there is no such trial, and after an abort.
    """
    _running(state)
    skipped = state.skippable
    if skipped is None or trial not in (None, skipped.id):
        raise RefusedError("nothing", "only a planned trial that the device has stopped twice can be left out.")
    return _event(state, "skip", at, id=skipped.id, reason=_text(reason))


def _filled(state: LiveSession, trial: Trial) -> bool:
    """Whether the place of a voided trial is taken: by another answer, since its block has all its answers, or for a
    voided repetition, since it is no longer wanted or pending."""
    if trial.repeats is not None:
        pending = state.pending
        waits = trial.repeats in state.wanted or (pending is not None and pending.repeats == trial.repeats)
        return bool(trial.voided and trial.voided.get("asked_again")) and not waits
    others = state.counted(trial.block)
    if trial.planned is None:
        beside = trial.voided["beside"] if trial.voided else ()  # a level may have been answered before, for itself
        same = any(other.id not in beside and other.renderings == trial.renderings for other in others)
    else:
        same = any(other.planned == trial.planned for other in others)
    return same or len(others) >= state.quota(trial.block)


def restorable(state: LiveSession, trial: int) -> bool:
    """Whether `restore` would be accepted for this trial."""
    try:
        restore(state, trial, 0.0)
    except RefusedError:
        return False
    return True


def pause(state: LiveSession, by: str, at: float) -> Event:
    """Event that begins a break, requested by "participant" or "experimenter". Raises `RefusedError` during a break and
    after the session was aborted."""
    _running(state)
    if state.paused is not None:
        raise RefusedError("paused", "the session is paused already.")
    return _event(state, "pause", at, by=by)


def resume(state: LiveSession, at: float) -> Event:
    """Event that ends a break. Raises `RefusedError` if there is none, and after an abort."""
    _running(state)
    if state.paused is None:
        raise RefusedError("nothing", "the session is not paused.")
    return _event(state, "resume", at)


def abort(state: LiveSession, reason: str, at: float) -> Event:
    """Event that ends the session early. Raises `RefusedError` if it is aborted already, and for a reason that a
    spreadsheet would run as a formula."""
    _running(state)
    return _event(state, "abort", at, reason=_text(reason))


def note(state: LiveSession, text: str, at: float) -> Event:
    """Event with a note of the experimenter. Raises `RefusedError` for text that a spreadsheet would run as a
    formula."""
    return _event(state, "note", at, text=_text(text))


def more(state: LiveSession, at: float) -> Event:
    """Event that adds one trial to a warm-up that has ended.

    Raises `RefusedError` elsewhere, and if all renderings of the warm-up are used.
    """
    before = None if state.block is None else state.warm_up(state.block)
    if state.screen != "ready" or before is None:
        raise RefusedError("nothing", "another rendering can be had at the end of the warm-up only.")
    if state.quota(before) >= len(state.header.blocks[before].trials):
        raise RefusedError("nothing", "all renderings of the warm-up have been felt.")
    return _event(state, "more", at, block=before)


def go_on(state: LiveSession, at: float) -> Event:
    """Event that begins the next block after a warm-up or a rest. Raises `RefusedError` on any other screen."""
    if state.screen not in ("ready", "rest"):
        raise RefusedError("nothing", "there is nothing to go on to: no warm-up or rest has come to its end.")
    return _event(state, "go_on", at, block=state.block)


def warm_up(state: LiveSession, at: float) -> Event:
    """Event that repeats the warm-up after a pause as long as the study specifies. Raises `RefusedError` if none is
    due."""
    if not state.warms_up_again(at) or state.block is None or state.active is None:
        raise RefusedError("nothing", "the warm-up does not come again now.")
    return _event(state, "warm_up", at, block=state.warm_up(state.block), pause_s=at - state.active)


def device(state: LiveSession, condition: str, at: float, *, trial: int | None = None, **facts) -> Event:
    """Event for a device's condition: "ready", "running", "stopped", "hold", "estop" or "lost"; `facts`: counters and
    reason.

    With hold, estop or lost, the trial (None: the pending one) is voided if it had begun. Raises `RefusedError` for a
    `trial` that does not exist.
    """
    if trial is not None:
        state.trial(trial)
    return _event(state, "device", at, condition=condition, trial=trial, **facts)


def _number(state: LiveSession, phase: str, material: str | None) -> int:
    """Number (from 1) of the next trial within its phase and material."""
    same = (t for t in state.trials if t.data["phase"] == phase and t.data["material"] == material)
    return 1 + sum(1 for _ in same)


def _event(state: LiveSession, kind: str, at: float, **data: Any) -> Event:
    """Event of this kind with the next sequence number and `data`. Raises RefusedError for a time that is not
    finite."""
    if not math.isfinite(at):
        raise RefusedError("bad-answer", f"the time {at} is no time.")
    return Event(seq=state.seq + 1, kind=kind, time=float(at), data=data)


def _text(text: str) -> str:
    """Return a text unchanged. Raises RefusedError for one that a spreadsheet would run as a formula."""
    if runs_in_a_spreadsheet(text):
        raise RefusedError("bad-answer", f'the text "{text[:40]}" contains a formula for spreadsheets; change it.')
    return text


def _running(state: LiveSession) -> None:
    """Raise RefusedError if the session was aborted."""
    if state.aborted is not None:
        raise RefusedError("over", "the session has ended.")


def _pending_trial(state: LiveSession, id: int) -> Trial:
    """Return the trial with this id. Raises RefusedError if it does not exist or is not pending."""
    trial = state.trial(id)
    if trial.status != "pending":
        raise RefusedError("old-trial", f"trial {id} is {trial.status}.")
    return trial


def _times(browser: Any) -> dict[str, float]:
    """Copy of the browser's times as floats; {} for None. Raises RefusedError for anything but up to 8 finite numbers
    by name."""
    if browser is None:
        return {}
    good = isinstance(browser, Mapping) and len(browser) <= 8
    if not good or not all(
        isinstance(name, str) and isinstance(value, int | float) and math.isfinite(value)
        for name, value in browser.items()
    ):
        raise RefusedError("bad-answer", "the browser's times must be numbers of seconds.")
    return {name: float(value) for name, value in browser.items()}


def _counts(telemetry: Mapping[str, int]) -> dict[str, int]:
    """Copy of telemetry counts. Raises RefusedError for unknown names, or counts outside of 0 to the number of
    samples."""
    names, every = set(telemetry), telemetry.get(SAMPLES, -1)
    if (
        SAMPLES not in names
        or not names <= {SAMPLES, *FLAGS}
        or not all(0 <= count <= every for count in telemetry.values())
    ):
        raise RefusedError("bad-answer", f"the telemetry of a trial has {SAMPLES}, and of these those with a flag.")
    return dict(telemetry)


def _check_values(state: LiveSession, trial: Trial, values: Any) -> None:
    """Raise RefusedError if `values` are not exactly the answers that the trial's phase asks for, each an allowed
    one."""
    asks = protocol_of(state.study, state.header.blocks[trial.block]).asks
    if not isinstance(values, Mapping) or set(values) != set(asks):
        raise RefusedError("bad-answer", f"an answer to trial {trial.id} has {', '.join(asks)}, and nothing else.")
    for ask in asks:
        allowed = ("a", "b") if ask == "preferred" else state.study.responses
        if not isinstance(values[ask], str) or values[ask] not in allowed:
            raise RefusedError("bad-answer", f"{ask} must be one of {', '.join(allowed)}.")
