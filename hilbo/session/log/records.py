"""Records of a live session: header, events, trials, and the error for a refused action.

Times are seconds since the epoch, and are given by the caller that creates an event.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import msgspec

from hilbo.errors import InputError
from hilbo.study.file.plan_file import Block
from hilbo.study.formats.json_file import Content

__all__ = ["PAUSE", "SCHEMA", "Event", "Header", "Need", "Pause", "RefusedError", "Status", "Trial", "WarmUp"]

SCHEMA = 3
"""Of a log's lines and header."""
PAUSE = 60.0  # s
"""The shortest time that counts as a pause."""
Status = Literal["pending", "answered", "undone", "void", "dropped", "left out"]


class RefusedError(InputError):
    """An action that is not possible now. `code` is the reason as a word for programs: old-trial, voided, answered,
    unfelt, unconfirmed, off, bad-answer, paused, over, nothing."""

    def __init__(self, code: str, sentence: str) -> None:
        super().__init__(sentence)
        self.code = code


class Event(msgspec.Struct, frozen=True, kw_only=True):
    """An entry of the log: `seq` is its number (from 1), `kind` one of those in `replay`, `time` in s since the
    epoch."""

    seq: int
    kind: str
    time: float
    data: dict[str, Any]


class Header(msgspec.Struct, frozen=True, kw_only=True):
    """The first line of a log: all that is fixed before a session begins.

    `study`: hash of the study file; `study_tables`: its content, which is stored when the log is created.
    `unblinded`: what showed the participant the parameters, "try" for `hilbo try`; "" if nothing did. `shown_to`: roles
    to which the parameters of the stimuli were shown, where a stimulus program presents them.
    """

    schema: int = SCHEMA
    study: str
    participant: str
    session: str
    seed: int
    blocks: tuple[Block, ...]
    sets: dict[str, dict[str, float]] = {}
    plan: str | None = None
    warm_start: str | None = None
    consent: str | None = None
    protocol_number: str = ""
    versions: dict[str, str] = {}
    dry_run: bool = False
    language: str = "en"
    unblinded: str = ""
    shown_to: tuple[str, ...] = ()
    study_tables: Content = {}


class Need(msgspec.Struct, frozen=True):
    """The next proposal: trial `planned` of a block's plan, or a repetition of trial `repeats`; if both are
    None, a rendering that the chooser selects."""

    block: int
    planned: int | None = None
    repeats: int | None = None


@dataclass(frozen=True)
class Trial:
    """A proposed trial and its state. `number`: its value in the column `trial` of tables, counted within phase and
    material.

    `confirmed`: side -> the values that count of what a stimulus program presented, if there is one; of this
    presentation only. `telemetry`: counts of a device's samples while it was presented, up to the answer
    (`actions.answer`); None without such a record.
    """

    id: int
    block: int
    number: int
    data: Mapping[str, Any] = field(repr=False)
    proposed: float
    planned: int | None = None
    repeats: int | None = None
    status: Status = "pending"
    presentation: int = 1
    step: int | None = None
    felt: frozenset[str] = frozenset()
    on: str | None = None
    sent: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    confirmed: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    values: Mapping[str, str] | None = None
    client: str | None = None
    answered: Mapping[str, Any] | None = field(default=None, repr=False)
    telemetry: Mapping[str, int] | None = None
    voided: Mapping[str, Any] | None = None

    @property
    def renderings(self) -> dict[str, dict[str, float]]:
        """Side ("a", "b") -> proposed parameters in physical units."""
        return self.data["renderings"]

    @property
    def presented(self) -> dict[str, dict[str, float]]:
        """Side -> parameters in physical units that count: the proposed ones, replaced by those that a stimulus program
        confirmed."""
        return {side: {**values, **self.confirmed.get(side, {})} for side, values in self.renderings.items()}

    @property
    def unfinished(self) -> bool:
        """Whether its presentation has begun and is not complete: a rendering is on, or a side has not been presented.
        It then has to start again."""
        return self.step is not None and (self.on in self.renderings or self.felt != frozenset(self.renderings))

    @property
    def sets(self) -> dict[str, str]:
        """Side -> name of its set, for planned trials; empty for others."""
        return self.data.get("sets", {})

    @property
    def first(self) -> str:
        """The side that is presented first."""
        return self.data.get("first", "a")


class Pause(NamedTuple):
    """A pause of `seconds`, at least `PAUSE`, without any presentation or answer, for any cause: a break, a rest,
    or a server that did not run. Event `seq`, of trial `trial`, ended it."""

    seq: int
    trial: int
    seconds: float


class WarmUp(NamedTuple):
    """A repetition of the warm-up: its block, the block that follows it, the number of trials before it, and its time
    (s)."""

    block: int
    following: int | None
    trials: int
    time: float
