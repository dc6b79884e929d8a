"""The experimenter's commands: most become an event of the log; estop, clear and invite do not."""

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
    """A request that the state of the session does not allow now; the server answers it with the current view."""


def others_present(title: str) -> str:
    """An error sentence for a program or person that this session does not use to present renderings. It names what
    presents instead, by the title of the session's rig: "Stimulus" is a program, "Preparer" a person, any other a
    device."""
    who = {"Stimulus": "a program presents, and no person", "Preparer": "a person presents, and no program"}
    return f"In this session {who.get(title, 'a device renders, and no program presents')}."


async def carry_out(hub: HubInterface, what: str, message: Command) -> dict[str, Any]:
    """Carry out the command `what`, one of `COMMANDS`, and return the response: the new link for invite, {"done": what}
    for all others. Estop and clear act on the rig; the others but invite commit an event. Raises `NotNowError` if the
    session does not allow it or the rig fails, `InputError` for a message that lacks what the command needs, and
    `LogError`."""
    if what == "estop":
        return await _estop(hub.rig)
    if what == "clear":
        return await _clear(hub.rig)
    if what == "invite":
        return _invitation(hub, message)
    try:
        await hub.commit(_resume_event(hub) if what == "resume" else _event_of(what, message))
    except RefusedError as error:
        raise NotNowError(str(error)) from None
    return {"done": what}


def _event_of(what: str, message: Command) -> Callable[[LiveSession, float], Event]:
    """A function of (state, time) that makes the event of the command `what` (none of resume, estop, clear, invite), or
    raises `RefusedError`. Raises `InputError` for an empty note, and for a restore without a trial."""
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
        return lambda state, at: _void_or_undo(state, what, message, at)
    if what == "abort":
        return lambda state, at: actions.abort(state, message.reason, at)
    if what == "pause":
        return lambda state, at: actions.pause(state, "experimenter", at)
    return actions.repeat


def _resume_event(hub: HubInterface) -> Callable[[LiveSession, float], Event]:
    """Function of (state, time) that makes the event of the command resume: the end of the break or, without a break,
    the start of the next block. It raises `RefusedError` if there is neither. When called, it then also sets
    `hub.begun` to whether the participant's page is open; if it is not, they must press Begin."""

    def make(state, at):
        event = (actions.resume if state.paused is not None else actions.go_on)(state, at)
        hub.begun = hub.watchers.participant_here  # who comes later presses Begin
        return event

    return make


def _void_or_undo(state: LiveSession, what: str, message: Command, at: float) -> Event:
    """The event that voids the trial presented now or answered last (`what` is "void"), or takes the last answer back
    ("undo"). Raises `RefusedError` if there is no such trial, or if the message names another one."""
    trial = state.voidable if what == "void" else state.last_answered
    if trial is None:
        raise RefusedError("nothing", f"There is no trial to {what} yet.")
    if message.trial not in (None, trial.id):
        raise RefusedError("old-trial", f"Meanwhile {views.place_of(trial)} has come; look again.")
    if what == "void":
        return actions.void(state, trial.id, message.reason, at)
    return actions.undo(state, at, message.reason)


def _invitation(hub: HubInterface, message: Command) -> dict[str, str]:
    """A new link for the message's role, as `hub.invite` returns it. Earlier unused links of the role become void.
    Raises `NotNowError` if the hub gives no links, or the session does not have this role."""
    if hub.invite is None:
        raise NotNowError("This session gives no links.")
    stimulus = hub.state.study.stimulus
    if message.role not in ("participant", None if stimulus is None else stimulus.role):
        raise NotNowError(others_present(hub.rig.title))
    return hub.invite(message.role)


async def _estop(rig: Rig) -> dict[str, str]:
    """Stop the rig at once, and return {"done": "estop"}. Raises `NotNowError` if the rig fails or does not
    acknowledge."""
    try:
        await rig.estop()
    except (RuntimeError, ValueError) as error:
        raise NotNowError(f"The {rig.title.lower()} could not be sent the order: {error}") from None
    return {"done": "estop"}


async def _clear(rig: Rig) -> dict[str, str]:
    """Have the rig leave HOLD or ESTOP, and return {"done": "clear"}. Raises `NotNowError` if it cannot."""
    try:
        await rig.clear()
    except (RuntimeError, ValueError) as error:
        raise NotNowError(str(error)) from None
    return {"done": "clear"}
