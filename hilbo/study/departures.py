"""How a study's sessions depart from the plan that was made before them: people, answers, the study file, and by which
plan each session was held."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from hilbo.study.file.plan_file import Plan

__all__ = ["PHASE", "Held", "departures"]

PHASE = "optimisation"
"""Of the sessions that are compared with their plan."""


class Held(NamedTuple):
    """By which plan a session was held."""

    participant: str
    session: str
    plan: str
    """Its hash; empty where it was held by none."""


def departures(
    plan: Plan,
    study_hash: str,
    trials: int,
    counts: Mapping[str, Sequence[int]],
    sessions: Sequence[Held] | None = None,
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """What departs from the plan, in sentences; and what is as planned, if nothing does.

    **Arguments:** `study_hash`: of the study file of these answers; `trials`: that each person was to answer for each
    material; `counts`: person -> number of answers for each material; `sessions`: those of this phase, None where
    nothing says by which plan they were held.
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
    """Sentences on the sessions that were held by no plan, or by another."""
    own = (plan.hash, *plan.replaces)
    none = [f"{held.participant} (session {held.session})" for held in sessions if not held.plan]
    other = [
        f"{held.participant} (session {held.session}, plan {held.plan})"
        for held in sessions
        if held.plan and held.plan not in own
    ]
    sentences = [f"Held by no plan: {', '.join(none)}."] if none else []
    return sentences + ([f"Held by another plan: {', '.join(other)}."] if other else [])
