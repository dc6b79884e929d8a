"""plan.json, the plan of a study's sessions: one record, read and checked, and its text.

A plan's hash is the first 16 hex digits of the SHA-256 of all else in it, as JSON with sorted keys and no blanks. A log
holds it, and a file whose hash does not fit has been changed since.
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
"""Whose map the sets of a validation are from: the population's, or each participant's own."""


class Planned(msgspec.Struct, frozen=True, omit_defaults=True):
    """A trial whose renderings are known in advance: names of sets in the header, and which side is felt first."""

    a: str
    b: str | None = None
    first: Literal["a", "b"] = "a"


class Block(msgspec.Struct, frozen=True, omit_defaults=True):
    """A run of trials of one phase with one material.

    `count` of them are needed; `trials` are the planned ones, more than `count` for a warm-up, whose others wait for
    "another one"; none for an optimisation, which chooses them. `rest`: seconds of break before the block.
    """

    phase: Phase
    count: int
    trials: tuple[Planned, ...] = ()
    material: str | None = None
    rest: float = 0.0


class PlannedSession(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The part of a session's header that a plan fixes. `sets`: name -> parameters in physical units."""

    study: str
    participant: str
    session: str
    seed: int
    blocks: tuple[Block, ...]
    sets: dict[str, dict[str, float]]
    language: str


class PlanRow(msgspec.Struct, frozen=True, omit_defaults=True, forbid_unknown_fields=True):
    """A participant's place in the order, and session; `reissued_from`: who had them and dropped out."""

    participant: str
    order: Annotated[int, msgspec.Meta(ge=0)]
    header: PlannedSession
    reissued_from: str | None = None


class Plan(msgspec.Struct, frozen=True, omit_defaults=True, forbid_unknown_fields=True, kw_only=True):
    """One kind of session for all participants of a study. `study` and `hash`: of the study file, and of the plan."""

    schema: Literal[1]
    study: str
    name: str
    seed: int
    phase: Phase
    source: Source | None
    materials: tuple[str | None, ...]
    """[None] of a study without."""
    complete_at: str
    """For which numbers of participants the orders of materials are balanced, in words,"""
    complete: bool
    """and whether they are for this number."""
    participants: Annotated[tuple[PlanRow, ...], msgspec.Meta(min_length=1)]
    replaces: tuple[str, ...] = ()
    """Its hashes before a row was reissued, or somebody withdrew: logs of these sessions have one of them."""
    hash: str

    @property
    def intact(self) -> bool:
        """Whether the hash fits."""
        return self.hash == _hash_of(self)


def hashed(plan: Plan) -> Plan:
    """The plan with the hash of its content."""
    return replace(plan, hash=_hash_of(plan))


def plan_text(plan: Plan) -> str:
    """The text of plan.json."""
    return json.dumps(msgspec.to_builtins(plan), indent=1, ensure_ascii=False) + "\n"


def plan_in(content: bytes) -> Plan | None:
    """The plan in the content of a file, whether its hash fits or not; None where there is none."""
    try:
        return msgspec.json.decode(content, type=Plan)
    except UNREADABLE:
        return None


def read_plan(path: str | os.PathLike) -> Plan:
    """A plan's file. Raises `InputError` for one that is no plan, was changed after it was made, or names a participant
    twice."""
    plan: Plan = decoded(read_bytes(path), Plan, str(path), "is no plan; make one with hilbo plan")
    if not plan.intact:
        raise InputError(f"{path}: was changed after it was made (its hash does not fit); make a new plan.")
    names = [row.participant for row in plan.participants]
    if len(set(names)) < len(names):
        raise InputError(f"{path}: names a participant twice; make a new plan.")
    return plan


def _hash_of(plan: Plan) -> str:
    typed = msgspec.convert(msgspec.to_builtins(plan), Plan)  # a whole number that stands for a float becomes one
    content: dict[str, Any] = msgspec.to_builtins(typed)
    del content["hash"]
    return digest_of(json.dumps(content, sort_keys=True, ensure_ascii=False, separators=(",", ":")).encode())
