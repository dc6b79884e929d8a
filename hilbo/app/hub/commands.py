"""What an experimenter may command: each command as the event that it makes, or as a word to the rig."""

from collections.abc import Callable
from typing import Any

from hilbo.app.interface import HubInterface
from hilbo.app.pages import views
from hilbo.app.rigs.rig import Rig
from hilbo.app.wire.messages import Command
from hilbo.errors import InputError
from hilbo.session.log import actions
from hilbo.session.log.records import Event, RefusedError
from hilbo.session.log.state import LiveSession

__all__ = ["COMMANDS", "NotNowError", "carry_out", "others_present"]

COMMANDS = (
    *("pause", "resume", "repeat", "undo", "void", "restore", "skip", "abort", "note", "estop", "clear", "invite"),
)


class NotNowError(InputError):
    """What cannot be done now; the view says what can."""


def others_present(title: str) -> str:
    """Why somebody is not who presents, by the title of the rig that does."""
    who = {"Stimulus": "a program presents, and no person", "Preparer": "a person presents, and no program"}
    return f"In this session {who.get(title, 'a device renders, and no program presents')}."


async def carry_out(hub: HubInterface, what: str, message: Command) -> dict[str, Any]:
    """One of `COMMANDS`, in the session of a `Hub`. Raises `NotNowError`, and `InputError` for a message that lacks
    what the command needs."""
    if what == "estop":
        return await _estop(hub.rig)
    if what == "clear":
        return await _clear(hub.rig)
    if what == "invite":
        return _invitation(hub, message)
    try:
        await hub.commit(_goes_on(hub) if what == "resume" else _event_of(what, message))
    except RefusedError as error:
        raise NotNowError(str(error)) from None
    return {"done": what}


def _event_of(what: str, message: Command) -> Callable[[LiveSession, float], Event]:
    """What makes the event of a command."""
    if what == "note":
        if not message.text.strip():
            raise InputError("The note is empty; write something.")
        return lambda state, at: actions.note(state, message.text.strip(), at)
    if what == "restore":
        trial = message.trial
        if trial is None:
            raise InputError("An answer is restored by the id of its trial.")
        return lambda state, at: actions.restore(state, trial, at)
    if what == "skip":
        return lambda state, at: actions.skip(state, message.reason, at, message.trial)
    if what in ("void", "undo"):
        return lambda state, at: _taken(state, what, message, at)
    if what == "abort":
        return lambda state, at: actions.abort(state, message.reason, at)
    if what == "pause":
        return lambda state, at: actions.pause(state, "experimenter", at)
    return actions.repeat


def _goes_on(hub: HubInterface) -> Callable[[LiveSession, float], Event]:
    """From a break, or from the end of a block, as whoever is there by then."""

    def make(state, at):
        event = (actions.resume if state.paused is not None else actions.go_on)(state, at)
        hub.begun = hub.watchers.participant_here  # who comes later presses Begin
        return event

    return make


def _taken(state: LiveSession, what: str, message: Command, at: float) -> Event:
    """A trial made void, or an answer taken back: that of the trial which the sender saw, or none."""
    trial = state.voidable if what == "void" else state.last_answered
    if trial is None:
        raise RefusedError("nothing", f"There is no trial to {what} yet.")
    if message.trial not in (None, trial.id):
        raise RefusedError("old-trial", f"Meanwhile {views.place_of(trial)} has come; look again.")
    if what == "void":
        return actions.void(state, trial.id, message.reason, at)
    return actions.undo(state, at, message.reason)


def _invitation(hub: HubInterface, message: Command) -> dict[str, str]:
    """A new link for a role that this session has."""
    if hub.invite is None:
        raise NotNowError("This session gives no links.")
    stimulus = hub.state.study.stimulus
    if message.role not in ("participant", None if stimulus is None else stimulus.role):
        raise NotNowError(others_present(hub.rig.title))
    return hub.invite(message.role)


async def _estop(rig: Rig) -> dict[str, str]:
    try:
        await rig.estop()
    except (RuntimeError, ValueError) as error:
        raise NotNowError(f"The {rig.title.lower()} could not be told: {error}") from None
    return {"done": "estop"}


async def _clear(rig: Rig) -> dict[str, str]:
    try:
        await rig.clear()
    except (RuntimeError, ValueError) as error:
        raise NotNowError(str(error)) from None
    return {"done": "clear"}
