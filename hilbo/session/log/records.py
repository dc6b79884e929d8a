"""The records of a live session: its header, its events, its trials; and what is refused.

Times are seconds since the epoch, put into events by whoever has a clock.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import msgspec

from hilbo.errors import InputError
from hilbo.study.file.plan_file import Block

__all__ = ["PAUSE", "SCHEMA", "Event", "Header", "Need", "Pause", "RefusedError", "Status", "Trial", "WarmUp"]

SCHEMA = 3
"""Of a log's lines and header."""
PAUSE = 60.0  # s
"""The shortest time that counts as a pause."""
Status = Literal["pending", "answered", "undone", "void", "dropped", "left out"]


class RefusedError(InputError):
    """What cannot be done now; `code` says why, for a program: old-trial, voided, answered, unfelt, unconfirmed, off,
    bad-answer, paused, over, nothing."""

    def __init__(self, code: str, sentence: str) -> None:
        super().__init__(sentence)
        self.code = code


class Event(msgspec.Struct, frozen=True, kw_only=True):
    """Something that happened: its number in the log (from 1), its kind, when (s since the epoch), and the rest."""

    seq: int
    kind: str
    time: float
    data: dict[str, Any]


class Header(msgspec.Struct, frozen=True, kw_only=True):
    """All that decides a session in advance: the first line of its log.

    `unblinded`: what showed its participant the parameters, "try" for `hilbo try`; "" where nothing did.
    `shown_to`: the roles that were shown the parameters of what is presented, where no device of ours does.
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


class Need(msgspec.Struct, frozen=True):
    """What a proposal has to be found for: a planned trial, a repeated one, or, with neither, the chooser's next."""

    block: int
    planned: int | None = None
    repeats: int | None = None


@dataclass(frozen=True)
class Trial:
    """A proposal and what became of it. `number` is the row's trial in tables, counted within phase and material.

    `confirmed`: side -> the values that count of what a program presented, where one does; of this presentation alone.
    `telemetry`: counts of a device's samples while it was felt, up to the answer (`actions.answer`); None without such
    a record.
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
        """Side -> parameters in physical units."""
        return self.data["renderings"]

    @property
    def presented(self) -> dict[str, dict[str, float]]:
        """Side -> parameters in physical units, as they count: the confirmed ones where a program presents them."""
        return {side: {**values, **self.confirmed.get(side, {})} for side, values in self.renderings.items()}

    @property
    def unfinished(self) -> bool:
        """Whether it has begun and not all of it has been felt to its end: then it has to begin again."""
        return self.step is not None and (self.on in self.renderings or self.felt != frozenset(self.renderings))

    @property
    def sets(self) -> dict[str, str]:
        """Side -> name of its set, for planned trials."""
        return self.data.get("sets", {})

    @property
    def first(self) -> str:
        """The side that is felt first."""
        return self.data.get("first", "a")


class Pause(NamedTuple):
    """A time of `seconds`, at least `PAUSE`, in which nothing was presented or answered, whatever its cause: a break, a
    rest, a server that did not run. Event `seq`, of trial `trial`, ended it."""

    seq: int
    trial: int
    seconds: float


class WarmUp(NamedTuple):
    """A warm-up that comes again: its block, the block that follows it, the number of trials before it, and its time
    (s)."""

    block: int
    following: int | None
    trials: int
    time: float
