"""Deviations of a study's sessions from their plan: participants, numbers of responses, study file, and the plan that
each session followed."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from hilbo.study.file.plan_file import Plan

__all__ = ["PHASE", "Held", "departures"]

PHASE = "optimisation"
"""Phase whose sessions are compared with their plan."""


class Held(NamedTuple):
    """A session and the plan that it followed."""

    participant: str
    session: str
    plan: str
    """Hash of the plan; empty if the session had none."""


def departures(
    plan: Plan,
    study_hash: str,
    trials: int,
    counts: Mapping[str, Sequence[int]],
    sessions: Sequence[Held] | None = None,
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Compare sessions with their plan; returns (deviations, confirmation), each a tuple of sentences, of which one is
    empty.

    The second has one sentence if there is no deviation. A plan of another phase than `PHASE` is compared with nothing
    and gives one sentence in the first.

    **Arguments:** `study_hash`: of the study file of these responses; `trials`: planned number per participant and
    material; `counts`: participant -> number of responses for each material; `sessions`: the sessions of this phase
    with their plans, None if not known.
    """
    if plan.phase != PHASE:
        return (f"plan.json is a plan of {plan.phase}, so that these answers are compared with no plan.",), ()
    planned = [row.participant for row in plan.participants]
    sentences = []
    if plan.study != study_hash:
        sentences.append(f"The study file is not the one that was planned with ({study_hash}, planned {plan.study}).")
    absent = [name for name in planned if name not in counts]
    if absent:
        sentences.append(f"Planned, and without answers here: {', '.join(absent)} ({len(absent)} of {len(planned)}).")
    others = [name for name in counts if name not in planned]
    if others:
        sentences.append(f"Not in the plan, and with answers here: {', '.join(others)}.")
    other = [f"{name} ({', '.join(map(str, n))})" for name, n in counts.items() if any(k != trials for k in n)]
    if other:
        sentences.append(f"Another number of answers than the planned {trials}: {', '.join(other)}.")
    sentences += _held_otherwise(plan, sessions or ())
    known = {held.participant for held in sessions or ()}
    unknown = [name for name in counts if name not in known]
    if sessions is not None and unknown:
        sentences.append(f"The table of sessions does not say by which plan these were held: {', '.join(unknown)}.")
    if not sentences:
        by = (
            "their sessions were held by it"
            if sessions is not None
            else "by which plan they were held is not said here"
        )
        what = f"{len(planned)} participants, {trials} answers each; {by}."
        return (), (f"Nothing departs from the plan {plan.hash}: {what}",)
    return tuple(f"Departs from the plan {plan.hash}. {sentence}" for sentence in sentences), ()


def _held_otherwise(plan: Plan, sessions: Sequence[Held]) -> list[str]:
    """Up to two sentences: sessions without a plan, and sessions under a plan other than this one or those it
    replaces."""
    own = (plan.hash, *plan.replaces)
    none = [f"{held.participant} (session {held.session})" for held in sessions if not held.plan]
    other = [
        f"{held.participant} (session {held.session}, plan {held.plan})"
        for held in sessions
        if held.plan and held.plan not in own
    ]
    sentences = [f"Held by no plan: {', '.join(none)}."] if none else []
    return sentences + ([f"Held by another plan: {', '.join(other)}."] if other else [])
