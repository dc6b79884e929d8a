"""From what was asked for on the command line to a hub: study, plan, log, choosing; compiled before the device runs."""

import functools
import gc
import hashlib
from collections.abc import Callable, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from hilbo.app.hub.hub import Hub
from hilbo.app.pages.slices import Maps
from hilbo.app.rigs.device_rig import DeviceRig
from hilbo.app.rigs.stimulus_rig import StimulusRig
from hilbo.errors import InputError
from hilbo.session.choose.look_ahead import LiveChooser, warm_start_sources
from hilbo.session.choose.warm_start import read_warm_start
from hilbo.session.log.event_log import EventLog
from hilbo.session.log.header import header_for, participant_seed
from hilbo.session.log.header_check import study_of
from hilbo.session.log.log_files import check_alone, check_new, log_name
from hilbo.session.log.records import Header
from hilbo.session.log.state import LiveSession
from hilbo.session.plan.participants import check_consent, read_people
from hilbo.session.plan.plan import planned_by, planned_header
from hilbo.study.config import Study
from hilbo.study.file.plan_file import read_plan
from hilbo.study.file.reading import StudyFile

__all__ = ["Wanted", "let_go", "opened"]


class Wanted(NamedTuple):
    """A session as a person asks for it; None: as the plan, the log or the default has it."""

    study: Path
    participant: str
    session: str | None = None
    seed: int | None = None
    logs: Path = Path("logs")
    plan: Path | None = None
    material: str | None = None
    resume: bool = False
    people: Path | None = None
    warm_start: Path | None = None
    dry_run: bool = False
    reference: Mapping[str, float] | None = None
    """Of the reference that the participant's own page presents (`hilbo try`): the answers are unblinded."""


def opened(
    wanted: Wanted, connect: Callable[[float | None, float | None], Any], say: Callable[[str], Any]
) -> tuple[Hub, EventLog]:
    """The hub of a session, new or resumed, and its open log; `connect(damping, delay)` opens a device that has at
    least this damping (N·s/m) and at most this delay (s). Raises `InputError`."""
    study = Study.load(wanted.study).file
    say("preparing what chooses")
    import pandas  # noqa: F401  (what the device's bridge would load when it is in a hurry)

    log, chooser = (_resumed if wanted.resume else _begun)(wanted, study)
    try:
        check_alone(log.path, log.state.header)
    except InputError:
        let_go(log, wanted.resume)
        raise
    tag = _tag(log.state.header)
    if study.stimulus is not None:
        rig = functools.partial(StimulusRig, study, tag)
    else:
        mechanics = [_mechanics(study, block.material) for block in log.state.header.blocks]
        needs = max(m.damping for m in mechanics), min(m.delay for m in mechanics)
        rig = functools.partial(DeviceRig, study, lambda: connect(*needs))
    hub = Hub(log, chooser, rig, tag=tag, maps=Maps)
    hub.settle = _set_memory_aside
    return hub, log


def _set_memory_aside() -> None:
    """Leaves what is in memory by now out of all later garbage collections. To look through it takes 0.1 s, in which
    nobody is heard. Only for a process that ends with its session: what is left out is never freed."""
    gc.collect()
    gc.freeze()


def let_go(log: EventLog, resumed: bool = False) -> None:
    """Close a log. A new one in which nothing has happened is removed, so that the same command may begin it."""
    log.close()
    if not resumed and log.state.seq == 0:
        log.path.unlink(missing_ok=True)


def _mechanics(study: StudyFile, material: str | None) -> Any:
    return study_of(study, material).space.mechanics


def _begun(wanted: Wanted, study: StudyFile) -> tuple[EventLog, LiveChooser]:
    """A new log, last of all: what is refused leaves none behind."""
    if wanted.plan is None and wanted.material is None and study.materials:
        names = ", ".join(study.materials)
        raise InputError(
            f"{wanted.study}: has the materials {names}; add --material with the one of this session, or --plan."
        )
    header = _header(wanted, study)
    path = wanted.logs / log_name(header)
    check_new(path, header)
    warm = _warm_starts(wanted, study, header)
    header = msgspec.structs.replace(header, warm_start=warm_start_sources(warm))
    chooser = LiveChooser(LiveSession.start(study, header), warm)
    return EventLog.create(path, study, header), chooser


def _resumed(wanted: Wanted, study: StudyFile) -> tuple[EventLog, LiveChooser]:
    header = _header(wanted._replace(dry_run=True), study)  # consent was looked for when it began
    log = EventLog.resume(wanted.logs / log_name(header), study)
    try:
        if log.state.header.dry_run and not wanted.dry_run:
            raise InputError(f"{log.path}: was begun as a dry run; choose another --session, or add --dry-run.")
        if wanted.dry_run and not log.state.header.dry_run:
            raise InputError(
                f"{log.path}: was begun with a participant; leave --dry-run out, or choose another --session."
            )
        _check_asked_for(wanted, header, log)
        return log, LiveChooser(log.state, _warm_starts(wanted, study, log.state.header))
    except BaseException:
        log.close()
        raise


def _check_asked_for(wanted, header: Header, log: EventLog) -> None:
    """Refuse a log that is of somebody else, or was begun with another material, seed or plan than asked for."""
    begun = log.state.header
    if (begun.participant, begun.session) != (header.participant, header.session):
        raise InputError(
            f"{log.path}: is session {begun.session} of participant {begun.participant}; choose another --session."
        )
    if wanted.material is not None and _materials(begun) != _materials(header):
        with_ = ", ".join(_materials(begun))
        raise InputError(f"{log.path}: was begun with the material {with_}; choose another --session, or --material.")
    if wanted.seed is not None and begun.seed != wanted.seed:
        raise InputError(f"{log.path}: was begun with the seed {begun.seed}; choose another --session, or --seed.")
    if wanted.plan is not None and not planned_by(read_plan(wanted.plan), header, begun):
        raise InputError(f"{log.path}: was begun by another plan, or without one; give that one, or another --session.")


def _header(wanted: Wanted, study: StudyFile) -> Header:
    number = study.session.protocol_number
    facts: dict[str, Any] = {"protocol_number": number, "versions": _versions()}
    if study.stimulus is not None:
        facts["shown_to"] = study.stimulus.shown_to
    if wanted.reference is not None:
        facts |= {"unblinded": "try", "warm": False}
    elif wanted.dry_run:
        facts["dry_run"] = True
    else:
        people = read_people(wanted.people or wanted.logs / "participants.csv")
        facts["consent"] = check_consent(people, wanted.participant, number)["consent_time"]
    if wanted.plan is None:
        seed = participant_seed(0, wanted.participant) if wanted.seed is None else wanted.seed
        place = (wanted.participant, "1" if wanted.session is None else wanted.session, seed)
        header = header_for(study, *place, materials=(wanted.material,), **facts)
        shown = {} if wanted.reference is None else {"reference": dict(wanted.reference)}
        return msgspec.structs.replace(header, sets=header.sets | shown)
    plan = read_plan(wanted.plan)
    try:
        header = planned_header(plan, study, wanted.participant, **facts)
    except InputError as error:
        raise InputError(f"{wanted.plan}: {error}") from error
    return _as_asked(wanted, header)


def _as_asked(wanted, header: Header) -> Header:
    """A planned header, under the label that was asked for. Another seed or material than the plan's is refused.

    With a label of its own somebody whose session was ended by accident goes through the same plan again.
    """
    where = f"{wanted.plan}: plans the session of {wanted.participant}"
    if wanted.seed not in (None, header.seed):
        raise InputError(f"{where} with the seed {header.seed}; leave --seed {wanted.seed} out.")
    if wanted.material is not None and _materials(header) != [wanted.material]:
        with_ = ", ".join(_materials(header))
        raise InputError(f"{where} with the material {with_}; leave --material {wanted.material} out.")
    return header if wanted.session is None else msgspec.structs.replace(header, session=wanted.session)


def _materials(header: Header) -> list[str]:
    """The materials of a session, as they come."""
    return list(dict.fromkeys(block.material or "none" for block in header.blocks))


def _warm_starts(wanted: Wanted, study: StudyFile, header: Header) -> dict[str | None, Any]:
    """Material -> what its choices begin with. The candidates are those of the session's seed, not of the command's."""
    if wanted.warm_start is None:
        return {}
    materials = {block.material for block in header.blocks if not block.trials}
    if not materials:
        raise InputError("--warm-start: in this session nothing is chosen, all is planned; leave it out.")
    return {
        name: read_warm_start(wanted.warm_start, Study.of(study_of(study, name)), header.seed) for name in materials
    }


def _versions() -> dict[str, str]:
    return {part: metadata.version(part) for part in ("hilbo", "jax", "jaxlib", "numpy")}


def _tag(header: Header) -> str:
    """What this session's trials are known by in browsers."""
    return hashlib.sha256(msgspec.json.encode(header)).hexdigest()[:12]
