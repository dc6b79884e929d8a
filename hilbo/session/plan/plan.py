"""Plans of a study's sessions: stimuli and order for each participant, from one seed; to be registered before it
begins.

`make_plan` gives the plan of a whole study, whose hash is in every log, `planned_header` the header of one session.
Materials come in the orders of a Williams design, pairs balanced as `hilbo.session.plan.counterbalance` describes. With
`[plan] people` each participant of an optimisation is assigned to one material. Participants are validated with their
own sets of those materials of which they have a map.

A validation compares the sets best, mid and worst: of the population's map (`source` aggregate; for participants who
were not in it), or of each participant's own (individual; for these same participants). An aggregate-best validation
compares the population's optimum with every individual optimum. Individual sets are named by a code made from their
values only, in plans, logs and tables: after a withdrawal no id is left in the answers of others.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
from msgspec.structs import replace

from hilbo.errors import InputError
from hilbo.session.log.header import header_for, header_of, participant_seed, seed_of, warm_up
from hilbo.session.log.header_check import check_header, study_of
from hilbo.session.log.records import Header
from hilbo.session.plan.counterbalance import assigned, block_size, comparisons, orders
from hilbo.session.plan.set_codes import OWN, Sets, coded, set_codes
from hilbo.study.file.plan_file import Block, Plan, Planned, PlannedSession, PlanRow, Source, hashed
from hilbo.study.file.protocols import Phase, protocol
from hilbo.study.file.reading import StudyFile
from hilbo.study.formats.cell_text import but_for_case, check_id, check_text

__all__ = [
    "check_plan",
    "make_plan",
    "planned_by",
    "planned_header",
    "planned_part",
    "reissue",
]

_PAIRS = (("best", "mid"), ("best", "worst"), ("mid", "worst"))


def make_plan(
    study: StudyFile,
    participants: Sequence[str],
    seed: int = 0,
    phase: Phase = "optimisation",
    *,
    materials: Sequence[str] = (),
    session: str = "1",
    sets: Mapping[str, Sets] | None = None,
    source: Source | None = None,
) -> Plan:
    """Plan one kind of session for all participants; the same for the same arguments. Nothing is written.

    **Arguments:** `materials`: all that each participant has, by default those of the study; without them an
    optimisation assigns each participant to one material if the study has `[plan] people`. `sets`: for validations
    material ("" for a study without) -> name of a set -> parameters; names are `best`, `mid` and `worst`, or with an
    individual source `PARTICIPANT best` and so on; for aggregate-best `aggregate` and `individual:PARTICIPANT`. The
    plan has a code in place of each PARTICIPANT in these names. Raises InputError for ids, labels or sets that are not
    valid.
    """
    if len(set(participants)) < len(participants) or not participants:
        raise InputError("plan: participants must be named, each once.")
    for person in participants:
        check_id(person, "plan")
    if alike := but_for_case(participants):
        raise InputError(f"plan: {alike} differ in capitals only, and many disks take their logs for one; rename one.")
    check_text(session, "--session")
    names: list[str | None] = list(materials or study.materials) or [None]
    codes = set_codes(sets or {})
    one_each = phase == "optimisation" and not materials and bool(study.plan.people)
    sequence = _assigned(study, participants, seed) if one_each else _all_materials(names, participants, seed)
    rows_of_materials = [
        _with_own_map(row, person, sets or {}) if source == "individual" else row
        for person, row in zip(participants, sequence, strict=True)
    ]
    people = []
    for i, (person, in_order) in enumerate(zip(participants, rows_of_materials, strict=True)):
        header = _header(study, person, session, participant_seed(seed, person), phase, in_order, sets, source, codes)
        check_header(study, header)
        people.append(PlanRow(person, i, planned_part(header)))
    size = 1 if one_each else block_size(len(names))
    whole = one_each or all(len(row) == len(names) for row in rows_of_materials)
    plan = Plan(
        schema=1,
        study=study.hash,
        meaning=study.meanings(names),
        name=study.name,
        seed=seed,
        phase=phase,
        source=source,
        materials=tuple(names),
        complete_at=("any number of" if size == 1 else f"multiples of {size}")
        + (" participants" if whole else " participants with all materials"),
        complete=whole and len(participants) % size == 0,
        participants=tuple(people),
        hash="",
    )
    return hashed(plan)


def _all_materials(names: Sequence[str | None], participants: Sequence[str], seed: int) -> list[list[str | None]]:
    """All materials for each participant, in the orders of a Williams design."""
    return [[names[k] for k in row] for row in orders(len(names), len(participants), seed)]


def _assigned(study: StudyFile, participants: Sequence[str], seed: int) -> list[list[str | None]]:
    """The one material of each participant, at random. Raises InputError for another number of participants than in
    `[plan] people`."""
    people = study.plan.people
    if len(participants) != sum(people.values()):
        raise InputError(
            f"plan: there are {len(participants)} participants, and [plan] people of the study file has"
            f" {sum(people.values())}; plan for these, or name a --material."
        )
    return [[name] for name in assigned(people, seed)]


def _with_own_map(materials: list[str | None], person: str, sets: Mapping[str, Sets]) -> list[str | None]:
    """Those of the materials of which the participant has individual sets; all of them if there are none, which is
    refused later."""
    own = [name for name in materials if any(key.startswith(f"{person} ") for key in sets.get(name or "", {}))]
    return own or materials


def planned_header(plan: Plan, study: StudyFile, participant: str, **others: Any) -> Header:
    """Header of a participant's planned session with this study file, which may have changed since the plan was made,
    but not in what responses mean; trials and sets are the plan's. `others`: further fields of Header.

    Raises InputError if the plan belongs to another study, or the participant is not in it.
    """
    check_plan(plan, study)
    rows = {row.participant: row for row in plan.participants}
    if participant not in rows:
        raise InputError(
            f'participant "{participant}" is not in the plan, which has {len(rows)}, {min(rows)} to {max(rows)}; add'
            " them by a new plan, or reissue the row of a drop-out."
        )
    now = {"study": study.hash, "language": study.session.language, "plan": plan.hash}
    return replace(_header_of_row(rows[participant]), **now, **others)


def planned_by(plan: Plan, planned: Header, begun: Header) -> bool:
    """Whether the session with the header `begun` follows this plan, or an earlier version of it, with the same row.

    `planned`: header that the row gives now; another session label, study file or language is no difference.
    """
    known = begun.plan in (plan.hash, *plan.replaces)
    same = {"session": begun.session, "study": begun.study, "language": begun.language}
    return known and planned_part(begun) == planned_part(replace(planned, **same))


def check_plan(plan: Plan, study: StudyFile) -> None:
    """Raise InputError for a plan of a study in which responses mean something else, or with a row whose header is not
    valid or of another participant."""
    if len(plan.meaning) != len(plan.materials):
        raise InputError("the plan lacks the meaning of each of its materials; make a new one.")
    for name, planned, meaning in zip(plan.materials, plan.meaning, study.meanings(plan.materials), strict=True):
        if planned != meaning:
            raise InputError(
                f"the plan belongs to another study ({plan.study}, not {study.hash}): parameters, responses, questions,"
                f" renderer or stimulus{f' of {name}' if name else ''} differ; use the study file it was made from."
            )
    for row in plan.participants:
        check_header(study, _header_of_row(row))
        if row.header.participant != row.participant or row.header.study != plan.study:
            raise InputError(f"the plan's row of {row.participant} has another participant's session; make a new one.")


def reissue(plan: Plan, dropped: str, new: str) -> Plan:
    """Copy of the plan with a row for `new`, with order, seed and sets of `dropped`, whose row stays; `replaces` gets
    the hash of the old plan.

    Raises InputError if `dropped` is not in the plan, `new` is, the row was reissued before, or its sets are
    individual.
    """
    check_id(new, "plan")
    rows = {row.participant: row for row in plan.participants}
    if dropped not in rows or new in rows:
        raise InputError(f'plan: "{dropped}" must be in the plan and "{new}" must not.')
    given = {row.reissued_from: row.participant for row in plan.participants}
    if dropped in given:
        raise InputError(f'plan: the row of "{dropped}" has been reissued to {given[dropped]}; reissue that one.')
    if plan.source == "individual":
        raise InputError(
            f'plan: the sets of "{dropped}" are individual; other participants cannot be validated with them.'
        )
    row = rows[dropped]
    fresh = PlanRow(new, row.order, replace(row.header, participant=new), dropped)
    return hashed(replace(plan, participants=(*plan.participants, fresh), replaces=(*plan.replaces, plan.hash)))


def planned_part(header: Header) -> PlannedSession:
    """The fields of a header that a plan fixes."""
    return PlannedSession(*(getattr(header, name) for name in PlannedSession.__struct_fields__))


def _header_of_row(row: PlanRow) -> Header:
    """Header of the session in a plan's row."""
    return Header(**msgspec.structs.asdict(row.header))


def _header(study, person, session, seed, phase, materials, sets, source, codes) -> Header:
    """Header of one participant's session: of optimisation, or of comparisons with the codes in the names of sets.

    `materials` are in this participant's order; `sets`: material -> name -> parameters, or None; `codes`: participant
    -> code. Raises InputError if the phase needs sets and lacks them.
    """
    if phase == "optimisation":
        return header_for(study, person, session, seed, materials=materials)
    if phase == "warm-up" or sets is None:
        raise InputError(f"plan: a session of {phase} needs sets to compare; give --from result.json.")
    first_block, compared = warm_up(study, seed, materials[0])
    blocks = [first_block]
    for i, material in enumerate(materials):
        here = sets.get(material or "", {})
        trials, used = _compared(study_of(study, material), person, phase, here, source, codes, seed_of(seed, i, 7))
        prefix = f"{material} " if material else ""
        named = {name: prefix + coded(name, codes) for name in used}
        renamed = {named[name]: {k: float(v) for k, v in here[name].items()} for name in used}
        planned = tuple(Planned(named[a], named[b], first) for a, b, first in trials)
        rest = protocol(study_of(study, material).session, phase).rest if i else 0.0
        blocks.append(Block(phase, len(planned), planned, material, rest))
        compared |= renamed
    return header_of(study, person, session, seed, blocks, compared)


def _compared(study, person, phase, sets, source, codes, seed):
    """Comparisons of one block by the `study` of its material, (set a, set b, side felt first) each, and the list of
    the sets in it, by their names in `sets`. Raises InputError if a set is missing."""
    repeats = protocol(study.session, phase).count
    if phase == "aggregate-best":
        others = sorted((name for name in sets if name.startswith(OWN)), key=lambda name: coded(name, codes))
        if "aggregate" not in sets or not others:
            raise InputError("plan: aggregate-best needs the population's optimum and individuals' own.")
        pairs = [("aggregate", name) for name in others]
    else:
        prefix = f"{person} " if source == "individual" else ""
        pairs = [(prefix + a, prefix + b) for a, b in _PAIRS]
        missing = [name for pair in pairs for name in pair if name not in sets]
        if missing:
            raise InputError(f'plan: there is no set "{missing[0]}"; participant {person} has no individual map here.')
    return comparisons(pairs, repeats, seed), list(dict.fromkeys(name for pair in pairs for name in pair))
