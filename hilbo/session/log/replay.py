"""Checks of a log's events: the types of their data, and whether `hilbo.session.log.actions` could have written them.

Each event is created again by the action of its kind in the state before it, and must come out the same. So a log is
refused whose lines are intact but whose content is impossible: an answer to a trial that was not proposed, a rendering
outside of the study's ranges. Whether an answer was changed cannot be checked: the digests have no secret. Rules for
free texts (such as reasons) apply only when they are entered, not here.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Annotated, Any, Literal

import msgspec

from hilbo.errors import InputError
from hilbo.session.log import actions
from hilbo.session.log.header_check import check_header, study_of
from hilbo.session.log.records import Event, Header, Need
from hilbo.session.log.state import LiveSession
from hilbo.study.file.protocols import Ask, Show
from hilbo.study.file.reading import StudyFile
from hilbo.study.formats.json_file import check_values, converted

__all__ = ["check_event", "check_types", "replayed"]

_Whole = Annotated[int, msgspec.Meta(ge=0, le=10**9)]
_Time = Annotated[float, msgspec.Meta(ge=-6e10, le=1e11)]  # years 69 to 5138, which have a calendar date
_Side = Literal["a", "b"]
_WHAT = "is not what this hilbo writes"


class _Propose(msgspec.Struct):
    id: _Whole
    block: _Whole
    phase: str
    material: str | None
    trial: _Whole
    planned: _Whole | None
    repeats: _Whole | None
    renderings: dict[_Side, dict[str, float]]
    sets: dict[_Side, str] | None = None
    first: _Side = "a"
    choice: dict[str, Any] | None = None


class _Sent(msgspec.Struct):
    id: _Whole
    side: _Side
    values: dict[str, float] | None = None


class _Stimulus(msgspec.Struct):
    id: _Whole
    step: _Whole
    show: Show
    on: bool


class _Missed(msgspec.Struct):
    id: _Whole
    show: Show
    reason: str


class _Answer(msgspec.Struct):
    id: _Whole
    client: Annotated[str, msgspec.Meta(min_length=1)]
    values: dict[Ask, str]
    browser: dict[str, float]
    telemetry: dict[str, _Whole] | None = None


class _Trial(msgspec.Struct):
    id: _Whole
    reason: str = ""


class _Words(msgspec.Struct):
    by: Literal["participant", "experimenter"] = "experimenter"
    reason: str = ""
    text: str = ""


class _WarmUp(msgspec.Struct):
    block: _Whole
    pause_s: float


class _Device(msgspec.Struct):
    condition: Literal["ready", "running", "stopped", "hold", "estop", "lost"]
    trial: _Whole | None
    reason: str | None = None


class _Given:
    """A chooser that returns the proposal recorded in a log."""

    def __init__(self, proposal: Mapping[str, Any]) -> None:
        self.proposal = proposal

    def choose(self, state: LiveSession, need: Need) -> dict[str, Any]:
        """Return a copy of the recorded proposal, after `_check_proposal`. Raises InputError."""
        _check_proposal(state, need, self.proposal)
        return dict(self.proposal)


def _worded(event: Event, **words: str) -> Event:
    """Copy of an event with texts of its data replaced by `words`: texts in a log are accepted even if they break a
    rule."""
    return msgspec.structs.replace(event, data=event.data | words)


_FIXED = ("id", "block", "phase", "material", "trial", "planned", "repeats")
_Again = Callable[[LiveSession, Any, dict[str, Any], float], Event | None]
_KINDS: dict[str, tuple[type, _Again]] = {
    "propose": (_Propose, lambda s, d, raw, at: actions.propose(s, _Given(_without(raw, *_FIXED)), at)),
    "sent": (_Sent, lambda s, d, raw, at: actions.sent(s, d.id, d.side, at, **_without(raw, "id", "side"))),
    "stimulus": (_Stimulus, lambda s, d, raw, at: actions.present(s, d.id, d.step, d.on, at)),
    "missed": (_Missed, lambda s, d, raw, at: actions.missed(s, d.id, d.show, d.reason, at)),
    "answer": (
        _Answer,
        lambda s, d, raw, at: actions.answer(
            s, d.id, d.client, d.values, at, browser=d.browser, telemetry=d.telemetry, felt=False
        ),
    ),
    "undo": (_Trial, lambda s, d, raw, at: _worded(actions.undo(s, at), reason=d.reason)),
    "repeat": (_Trial, lambda s, d, raw, at: actions.repeat(s, at, d.id)),
    "void": (_Trial, lambda s, d, raw, at: _worded(actions.void(s, d.id, "", at), reason=d.reason)),
    "skip": (_Trial, lambda s, d, raw, at: _worded(actions.skip(s, "", at, d.id), reason=d.reason)),
    "restore": (_Trial, lambda s, d, raw, at: actions.restore(s, d.id, at)),
    "pause": (_Words, lambda s, d, raw, at: actions.pause(s, d.by, at)),
    "resume": (_Words, lambda s, d, raw, at: actions.resume(s, at)),
    "abort": (_Words, lambda s, d, raw, at: _worded(actions.abort(s, "", at), reason=d.reason)),
    "note": (_Words, lambda s, d, raw, at: _worded(actions.note(s, "", at), text=d.text)),
    "more": (_Words, lambda s, d, raw, at: actions.more(s, at)),
    "go_on": (_Words, lambda s, d, raw, at: actions.go_on(s, at)),
    "warm_up": (_WarmUp, lambda s, d, raw, at: actions.warm_up(s, at)),
    "device": (
        _Device,
        lambda s, d, raw, at: actions.device(s, d.condition, at, trial=d.trial, **_without(raw, "condition", "trial")),
    ),
}


def replayed(study: StudyFile, header: Header, events: Iterable[Event]) -> LiveSession:
    """Return the state after a log's events, each of them checked. Raises InputError, with the event's number."""
    check_header(study, header)
    state = LiveSession.start(study, header)
    for event in events:
        check_event(state, event)
        state = state.after(event)
    return state


def check_event(state: LiveSession, event: Event) -> None:
    """Raise InputError for an event that could not have been written in this state. Its data are type-checked first."""
    data = check_types(event)
    place = f"event {event.seq}"
    try:
        made = _KINDS[event.kind][1](state, data, event.data, event.time)
    except (InputError, TypeError) as error:  # TypeError: a fact of the device called as an argument is
        raise InputError(f"{place} ({event.kind}) cannot have been written there: {error}") from error
    if made != event:
        raise InputError(f"{place} ({event.kind}) {_WHAT} there; restore the log from a copy.")


def check_types(event: Event) -> object:
    """Return the data of an event as the record of its kind. Raises InputError for an unknown kind, a time out of
    range, or data of other types."""
    place = f"event {event.seq}"
    if event.kind not in _KINDS:
        raise InputError(f'{place} is of the kind "{event.kind}", which this hilbo does not know.')
    converted(event.time, _Time, place, f"has no time of this hilbo; check the date of this computer, {event.time:g} s")
    return converted(event.data, _KINDS[event.kind][0], place, _WHAT)


def _without(raw: Mapping[str, Any], *names: str) -> dict[str, Any]:
    """Copy of `raw` without the keys `names`."""
    return {key: value for key, value in raw.items() if key not in names}


def _check_proposal(state: LiveSession, need: Need, proposal: Mapping[str, Any]) -> None:
    """Raise InputError for renderings that differ from the plan or the repeated trial, or, if chosen, are outside of
    the study's ranges. `proposal`: data of a "propose" event."""
    block, sets = state.header.blocks[need.block], proposal.get("sets")
    renderings: Mapping[str, Mapping[str, float]] = proposal["renderings"]
    study = study_of(state.study, block.material)
    for side, values in renderings.items():
        check_values(values, study.space.parameters, f"side {side}", "the rendering")
    if need.repeats is not None:
        data = state.trial(need.repeats).data
        if any(proposal.get(key) != data.get(key) for key in ("renderings", "sets", "first")):
            raise InputError("the repetition is not of the trial that it repeats.")
    elif need.planned is not None:
        planned = block.trials[need.planned]
        wanted = {"a": planned.a} | ({} if planned.b is None else {"b": planned.b})
        same = sets == wanted and set(renderings) == set(wanted) and proposal.get("first", "a") == planned.first
        places = [(side, name) for side in wanted for name in study.space.names]
        if not same or any(renderings[side][name] != state.header.sets[wanted[side]][name] for side, name in places):
            raise InputError("the renderings are not those of the plan.")
    elif set(renderings) != {"a"} or sets is not None:
        raise InputError("a rendering that was chosen has one side, a, and no set.")
