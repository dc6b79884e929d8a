"""The messages that pages and programs may send: JSON, every key known, every value of its type and size.

docs/guides/live.md describes them. A message that does not fit is refused with one sentence, and changes nothing.
"""

from typing import Annotated, Any, Literal

import msgspec

from hilbo.app.wire.lines import fields_of, number_or_name
from hilbo.errors import InputError
from hilbo.study.formats.parsing import UNREADABLE

__all__ = ["LARGEST", "Answer", "Command", "Hello", "Join", "Press", "Report", "TooLargeError", "read"]

LARGEST = 16_384  # bytes of a message

_Id = Annotated[str, msgspec.Meta(min_length=1, max_length=200)]
_Level = Annotated[str, msgspec.Meta(max_length=200)]
_Text = Annotated[str, msgspec.Meta(max_length=2000)]
_Number = Annotated[int, msgspec.Meta(ge=1, le=2**31)]
_Milliseconds = Annotated[float, msgspec.Meta(ge=0, le=1e9)]


class TooLargeError(InputError):
    """A message of more than `LARGEST` bytes."""


class _Message(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base class of the messages."""


class Join(_Message, frozen=True):
    """A one-time token to be traded for the key of its role; `bearer`: a program asks, not a page."""

    token: _Id
    bearer: bool = False


class Answer(_Message, frozen=True):
    """All answers of one trial, question -> label. `clicked`: the browser's time, ISO 8601. `response_ms`: since the
    questions could be answered; `shortest_ms`: of several questions the shortest time from one to its answer."""

    trial: _Id
    client: Annotated[str, msgspec.Meta(min_length=1, max_length=64, pattern=r"^[A-Za-z0-9_.:-]+$")]
    answers: Annotated[dict[_Id, _Id], msgspec.Meta(min_length=1, max_length=8)]
    clicked: Annotated[str, msgspec.Meta(max_length=40)] = ""
    response_ms: _Milliseconds | None = None
    shortest_ms: _Milliseconds | None = None


class Press(_Message, frozen=True):
    """A participant's button (begin, break, more) or sign of life; `trial` is the one that was on the page."""

    trial: _Id | None = None


class Command(_Message, frozen=True):
    """An experimenter's command. `trial`: the one that it is about, so that it never acts on another (void, undo,
    restore, skip). `role`: whose link is wanted (invite)."""

    reason: _Text = ""
    text: _Text = ""
    trial: _Number | None = None
    role: Literal["participant", "stimulus", "preparer"] = "participant"


class Hello(_Message, frozen=True):
    """What a program or preparer's page says when it joins. `force`: it moves something that people touch.
    `neutral_within_s`: the time (s) in which it presents nothing and exerts no force after it was told, or was told
    nothing any more. `run`: the one that it had, if it begins again."""

    name: Annotated[str, msgspec.Meta(min_length=1, max_length=100)]
    version: Annotated[str, msgspec.Meta(max_length=100)]
    force: bool
    neutral_within_s: Annotated[float, msgspec.Meta(gt=0, le=10)]
    run: Annotated[str, msgspec.Meta(max_length=200)] = ""


class Report(_Message, frozen=True):
    """The state of a program that presents: which order it knows, and what it has done about it.

    `values`: the values really presented, numbers and names of levels, if the state is "presented" and the order had
    any. `wait_s`: how long it would wait for another order.
    """

    run: _Id
    order: Annotated[int, msgspec.Meta(ge=0, le=2**53)]
    state: Literal["busy", "presented", "neutral", "failed"]
    trial: _Id | None = None
    values: Annotated[dict[_Id, float | _Level], msgspec.Meta(max_length=32)] | None = None
    contact: bool = False
    why: Annotated[str, msgspec.Meta(max_length=500)] = ""
    wait_s: Annotated[float, msgspec.Meta(ge=0, le=3600)] = 0.0


def read(kind: type, body: bytes, form: bool = False) -> Any:
    """The message of the class `kind` in a request's body, JSON or a form (`lines`); an empty body is an empty message.
    Raises `TooLargeError`, and `InputError` with the error."""
    if len(body) > LARGEST:
        raise TooLargeError(f"The message has more than {LARGEST} bytes, which are the most.")
    fields = fields_of(body) if form else {}
    if "values" in fields:
        fields["values"] = {name: number_or_name(text) for name, text in fields["values"].items()}
    try:
        if form:
            return msgspec.convert(fields, kind, strict=False)
        return msgspec.json.decode(body or b"{}", type=kind)
    except UNREADABLE as error:
        raise InputError(f"The message is not understood: {error}.") from None
