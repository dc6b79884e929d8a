"""Deviations of a study's sessions from their plan, and from each other: participants, numbers of responses, the plan
that each session followed, the study file that it was begun with."""

import math
from collections.abc import Collection, Mapping, Sequence
from datetime import UTC, datetime

from hilbo.study.file.plan_file import Plan
from hilbo.study.tables.sessions import SessionRow

__all__ = ["PHASE", "changed_files", "departures"]

PHASE = "optimisation"
"""Phase whose numbers of responses are compared with a plan."""


def departures(
    plans: Sequence[Plan],
    counts: Mapping[str, Mapping[str, int]],
    held: Sequence[SessionRow] | None = None,
    study_hash: str = "",
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Compare sessions with their plans; returns (deviations, confirmations), each a tuple of sentences. Plans of one
    phase are compared together; of a plan and its earlier versions only the last counts.

    **Arguments:** `counts`: participant -> material ("" without) -> number of responses in optimisations; `held`: the
    sessions, None if not known; `study_hash`: of the study file that the responses are read with.
    """
    plans = _latest(plans)
    deviations, confirmations = [], []
    for phase in dict.fromkeys(plan.phase for plan in plans):
        those = [plan for plan in plans if plan.phase == phase]
        if held is None and phase != PHASE:
            what = "and the sessions that followed it are unknown: a table of sessions, as of hilbo export, is missing"
            deviations += [f"The plan {plan.hash} is of {phase}, {what}." for plan in those]
            continue
        here = None if held is None else [session for session in held if phase in session.phases.split(", ")]
        sentences = _other_files(those, here, study_hash)
        sentences += _of_optimisations(those, counts, here) if phase == PHASE else _of_comparisons(those, here or ())
        named = f"the plan{'s' if len(those) > 1 else ''} {', '.join(plan.hash for plan in those)}"
        if sentences:
            deviations += [f"Departs from {named}. {sentence}" for sentence in sentences]
        else:
            confirmations.append(f"Nothing departs from {named}: {_confirmed(those, here)}.")
    return tuple(deviations), tuple(confirmations)


def changed_files(held: Sequence[SessionRow]) -> tuple[str, ...]:
    """Sentences on sessions that were begun with a version of the study file other than the one of the export, one for
    each version, in the order of their first session: which keys differ, which sessions, and from when to when."""
    versions: dict[str, list[SessionRow]] = {}
    for session in sorted(held, key=lambda session: math.inf if session.began_at is None else session.began_at):
        if session.differs_in:
            versions.setdefault(session.study, []).append(session)
    return tuple(
        f"Another version of the study file, {study}, which differs in {sessions[0].differs_in}, was"
        f" used{_between(sessions)} for {', '.join(f'{s.participant} (session {s.session})' for s in sessions)}."
        for study, sessions in versions.items()
    )


def _between(sessions: Sequence[SessionRow]) -> str:
    """Clause, after a blank, with the days (UTC) of the first and the last of these sessions, which are in order of
    time: " on 2026-03-01"; "" if no session has a time."""
    times = [session.began_at for session in sessions if session.began_at is not None]
    days = list(dict.fromkeys(datetime.fromtimestamp(t, UTC).date().isoformat() for t in times))
    if not days:
        return ""
    return f" on {days[0]}" if len(days) == 1 else f" from {days[0]} to {days[-1]}"


def _latest(plans: Sequence[Plan]) -> list[Plan]:
    """The plans, each once, without those that another of them replaces."""
    replaced = {hash for plan in plans for hash in plan.replaces}
    return list({plan.hash: plan for plan in plans if plan.hash not in replaced}.values())


def _other_files(plans: Sequence[Plan], held: Sequence[SessionRow] | None, study_hash: str) -> list[str]:
    """Sentences on sessions, or without a table of sessions on responses, whose study file is not the one that a plan
    was made from."""
    planned = {plan.study for plan in plans}
    words = f"planned: {', '.join(sorted(planned))}"
    if held is None:
        same = not study_hash or study_hash in planned
        return [] if same else [f"The study file has changed since the plan was made ({study_hash}, {words})."]
    others = [f"{s.participant} (session {s.session}, {s.study})" for s in held if s.study not in planned]
    return [f"Sessions with another study file ({words}): {', '.join(others)}."] if others else []


def _of_optimisations(
    plans: Sequence[Plan], counts: Mapping[str, Mapping[str, int]], held: Sequence[SessionRow] | None
) -> list[str]:
    """Sentences on participants and numbers of responses that differ from the plans, and on other plans that were
    followed."""
    planned = _planned_counts(plans)
    sentences = _who(planned, counts, "answers")
    differing = [_in_place_of(name, here, planned[name]) for name, here in counts.items() if name in planned]
    if any(differing):
        sentences.append(f"Another number of answers than planned: {', '.join(filter(None, differing))}.")
    sentences += _other_plans(plans, held or ())
    known = {session.participant for session in held or ()}
    unknown = [name for name in counts if name not in known]
    if held is not None and unknown:
        sentences.append(f"The table of sessions lacks the plan of these: {', '.join(unknown)}.")
    return sentences


def _of_comparisons(plans: Sequence[Plan], held: Sequence[SessionRow]) -> list[str]:
    """Sentences on participants who lack a planned session of comparisons or were not planned, and on other plans that
    were followed."""
    planned = list(dict.fromkeys(row.participant for plan in plans for row in plan.participants))
    had = list(dict.fromkeys(session.participant for session in held))
    return _who(planned, had, "a session") + _other_plans(plans, held)


def _who(planned: Collection[str], had: Collection[str], what: str) -> list[str]:
    """Up to two sentences: participants who were planned and are missing, and who were not planned. `what`: what they
    have or lack."""
    absent, others = [name for name in planned if name not in had], [name for name in had if name not in planned]
    sentences = []
    if absent:
        names = f"{', '.join(absent)} ({len(absent)} of {len(planned)})"
        sentences.append(f"Planned, and without {what} here: {names}.")
    if others:
        sentences.append(f"Not in the plan, and with {what} here: {', '.join(others)}.")
    return sentences


def _confirmed(plans: Sequence[Plan], held: Sequence[SessionRow] | None) -> str:
    """Agreement with the plans, all of one phase, as the end of a sentence: number of participants, for optimisations
    also that of their answers, and whether their sessions followed the plans (not known if `held` is None)."""
    people = len({row.participant for plan in plans for row in plan.participants})
    them = "it" if len(plans) == 1 else "them"
    by = "which plan the sessions followed is not known here" if held is None else f"all sessions followed {them}"
    if plans[0].phase != PHASE:
        return f"{people} participants of the {plans[0].phase}; {by}"
    numbers = sorted({count for row in _planned_counts(plans).values() for count in row.values()})
    return f"{people} participants, {' or '.join(map(str, numbers))} answers each; {by}"


def _planned_counts(plans: Sequence[Plan]) -> dict[str, dict[str, int]]:
    """Participant -> material ("" without) -> planned number of responses in optimisations."""
    counts: dict[str, dict[str, int]] = {}
    for row in (row for plan in plans for row in plan.participants):
        of = counts.setdefault(row.participant, {})
        for block in row.header.blocks:
            if block.phase == PHASE:
                of[block.material or ""] = of.get(block.material or "", 0) + block.count
    return counts


def _in_place_of(name: str, here: Mapping[str, int], planned: Mapping[str, int]) -> str:
    """A participant's numbers of responses where they differ from the plan's, as "NAME (24 in place of 25)"; empty if
    none does. Tables without materials have one number, compared with the sum of the planned ones."""
    if set(here) == {""}:
        planned = {"": sum(planned.values())}
    words = [
        f"{here.get(material, 0)} in place of {planned.get(material, 0)}" + (f" of {material}" if material else "")
        for material in dict.fromkeys([*planned, *here])
        if here.get(material, 0) != planned.get(material, 0)
    ]
    return f"{name} ({', '.join(words)})" if words else ""


def _other_plans(plans: Sequence[Plan], held: Sequence[SessionRow]) -> list[str]:
    """Up to two sentences: sessions without a plan, and sessions under a plan other than these or those they
    replace."""
    own = {hash for plan in plans for hash in (plan.hash, *plan.replaces)}
    none = [f"{session.participant} (session {session.session})" for session in held if not session.plan]
    other = [
        f"{session.participant} (session {session.session}, plan {session.plan})"
        for session in held
        if session.plan and session.plan not in own
    ]
    sentences = [f"Sessions without a plan: {', '.join(none)}."] if none else []
    return sentences + ([f"Sessions by another plan: {', '.join(other)}."] if other else [])
