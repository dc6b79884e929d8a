"""plan.json, the plan of a study's sessions: its record, reading with checks, and its text.

A plan's hash is the first 16 hex digits of the SHA-256 of its other content, as JSON with sorted keys and no blanks.
Session logs contain it, and a file whose hash does not match has been changed.
"""

import json
import os
from typing import Annotated, Any, Literal

import msgspec
from msgspec.structs import replace

from hilbo.errors import InputError
from hilbo.study.file.protocols import Phase
from hilbo.study.formats.json_file import decoded, digest_of, read_bytes
from hilbo.study.formats.parsing import UNREADABLE

__all__ = [
    "Block",
    "Plan",
    "PlanRow",
    "Planned",
    "PlannedSession",
    "Source",
    "hashed",
    "plan_in",
    "plan_text",
    "read_plan",
]

Source = Literal["aggregate", "individual"]
"""Map that the sets of a validation are read from: the population's, or each participant's."""


class Planned(msgspec.Struct, frozen=True, omit_defaults=True):
    """A planned trial: names of the sets presented (of the header's `sets`), and which side is presented first."""

    a: str
    b: str | None = None
    first: Literal["a", "b"] = "a"


class Block(msgspec.Struct, frozen=True, omit_defaults=True):
    """Consecutive trials of one phase with one material.

    `count`: number of trials that are needed; `trials`: the planned ones. A warm-up has more than `count`, as a
    reserve; an optimisation has none, since they are chosen during the session. `rest`: break before the block, in s.
    """

    phase: Phase
    count: int
    trials: tuple[Planned, ...] = ()
    material: str | None = None
    rest: float = 0.0


class PlannedSession(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The part of a session log's header that the plan fixes. `sets`: name -> parameters in physical units."""

    study: str
    participant: str
    session: str
    seed: int
    blocks: tuple[Block, ...]
    sets: dict[str, dict[str, float]]
    language: str


class PlanRow(msgspec.Struct, frozen=True, omit_defaults=True, forbid_unknown_fields=True):
    """A participant's slot in the plan: place in the order, and session; `reissued_from`: the drop-out who had it
    before."""

    participant: str
    order: Annotated[int, msgspec.Meta(ge=0)]
    header: PlannedSession
    reissued_from: str | None = None


class Plan(msgspec.Struct, frozen=True, omit_defaults=True, forbid_unknown_fields=True, kw_only=True):
    """Plan of one kind of session for all participants of a study. `study`: hash of the study file; `hash`: that of the
    plan."""

    schema: Literal[1]
    study: str
    meaning: tuple[str, ...]
    """What responses to each of the `materials` mean (`StudyFile.meaning`)."""
    name: str
    seed: int
    phase: Phase
    source: Source | None
    materials: tuple[str | None, ...]
    """(None,) for a study without materials."""
    complete_at: str
    """Text: numbers of participants for which the orders of materials are balanced."""
    complete: bool
    """Whether the orders are balanced for this number of participants."""
    participants: Annotated[tuple[PlanRow, ...], msgspec.Meta(min_length=1)]
    replaces: tuple[str, ...] = ()
    """Hashes of the plan before a slot was reassigned or a participant withdrew; logs of these sessions have one of
    them."""
    hash: str

    @property
    def intact(self) -> bool:
        """Whether the stored hash is that of the plan's content."""
        return self.hash == _hash_of(self)


def hashed(plan: Plan) -> Plan:
    """Copy of the plan with `hash` set to the hash of its content."""
    return replace(plan, hash=_hash_of(plan))


def plan_text(plan: Plan) -> str:
    """JSON text of plan.json."""
    return json.dumps(msgspec.to_builtins(plan), indent=1, ensure_ascii=False) + "\n"


def plan_in(content: bytes) -> Plan | None:
    """Parse a plan from the bytes of a file, without a check of its hash; None if it is not a plan."""
    try:
        return msgspec.json.decode(content, type=Plan)
    except UNREADABLE:
        return None


def read_plan(path: str | os.PathLike) -> Plan:
    """Read plan.json. Raises `InputError` for a file that cannot be read or is not a plan, one that was changed after
    it was made, and one with a repeated participant."""
    plan: Plan = decoded(read_bytes(path), Plan, str(path), "is no plan; make one with hilbo plan")
    if not plan.intact:
        raise InputError(f"{path}: was changed after it was made (its hash does not fit); make a new plan.")
    names = [row.participant for row in plan.participants]
    if len(set(names)) < len(names):
        raise InputError(f"{path}: names a participant twice; make a new plan.")
    return plan


def _hash_of(plan: Plan) -> str:
    """Hash of the plan's content without its field `hash`: first 16 hex digits of the SHA-256."""
    typed = msgspec.convert(msgspec.to_builtins(plan), Plan)  # a whole number in place of a float becomes one
    content: dict[str, Any] = msgspec.to_builtins(typed)
    del content["hash"]
    return digest_of(json.dumps(content, sort_keys=True, ensure_ascii=False, separators=(",", ":")).encode())
