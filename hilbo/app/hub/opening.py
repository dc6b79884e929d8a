"""Make the hub of a session from the options of the command line: study, plan, log and chooser."""

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
    """A session as the command line asks for it. None: as the plan or the log has it, else the default."""

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
    """The hub of a session, new or resumed, not yet open, and its open log, which for a new session is created. Opening
    the hub calls `connect(damping, delay)`, which connects a device with at least this damping (N·s/m) and at most this
    delay (s); a study with [stimulus] has no device. `say` is told of progress. Raises `InputError`, with the log
    closed and, if new, deleted."""
    study = Study.load(wanted.study).file
    say("compiling the trial selection")
    import pandas  # noqa: F401  (what the device's bridge would load when it is in a hurry)

    log, chooser = (_resumed if wanted.resume else _begun)(wanted, study)
    try:
        check_alone(log.path, log.state.header)
    except InputError:
        let_go(log, wanted.resume)
        raise
    study = log.state.study  # a session goes on with the study file that it was begun with
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
    """Exclude all objects that exist now from garbage collection, after one collection: a later one would take 0.1 s,
    in which the server answers nobody. Only for a process that ends with its session, because these objects are never
    freed."""
    gc.collect()
    gc.freeze()


def let_go(log: EventLog, resumed: bool = False) -> None:
    """Close a log. One that was not `resumed` and has no event is deleted, so that the same command can begin it
    again."""
    log.close()
    if not resumed and log.state.seq == 0:
        log.path.unlink(missing_ok=True)


def _mechanics(study: StudyFile, material: str | None) -> Any:
    """The mechanics of the study's renderer for a material; None for a study without a renderer."""
    return study_of(study, material).space.mechanics


def _begun(wanted: Wanted, study: StudyFile) -> tuple[EventLog, LiveChooser]:
    """A new log and its chooser. The log is created last, so that a refused session leaves no file. Raises `InputError`
    if the session was begun before, or its options do not fit study or plan."""
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
    """The log of a session that was begun before, opened for writing, and its chooser. Raises `InputError`, with the
    log closed, if it was begun with other options, or as a dry run and is resumed as none, or the reverse."""
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
        return log, LiveChooser(log.state, _warm_starts(wanted, log.state.study, log.state.header))
    except BaseException:
        log.close()
        raise


def _check_asked_for(wanted: Wanted, header: Header, log: EventLog) -> None:
    """Raise `InputError` if the log belongs to another participant or session, or was begun with another material, seed
    or plan than the options give; `header` is that of a new session with these options. Options that are None pass."""
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
    """The header of the session: from the row of the participant in the plan, else an optimisation of one material.
    Unless it is a dry run or `hilbo try`, the participant's consent is looked up in participants.csv. Raises
    `InputError` if it is missing, or plan, study and options do not fit."""
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


def _as_asked(wanted: Wanted, header: Header) -> Header:
    """A planned header with the session label of the options, if there is one. Raises `InputError` if the options have
    another seed or material than the plan.

    With a separate label, a session that was ended by accident can be run again by the same plan.
    """
    where = f"{wanted.plan}: plans the session of {wanted.participant}"
    if wanted.seed not in (None, header.seed):
        raise InputError(f"{where} with the seed {header.seed}; leave --seed {wanted.seed} out.")
    if wanted.material is not None and _materials(header) != [wanted.material]:
        with_ = ", ".join(_materials(header))
        raise InputError(f"{where} with the material {with_}; leave --material {wanted.material} out.")
    return header if wanted.session is None else msgspec.structs.replace(header, session=wanted.session)


def _materials(header: Header) -> list[str]:
    """The materials of a session in order, each once; "none" for blocks without a material."""
    return list(dict.fromkeys(block.material or "none" for block in header.blocks))


def _warm_starts(wanted: Wanted, study: StudyFile, header: Header) -> dict[str | None, Any]:
    """Material -> the warm start of its choices, empty without --warm-start; candidates by the seed of the header.
    Raises `InputError` if all trials are planned, or the file does not fit."""
    if wanted.warm_start is None:
        return {}
    materials = {block.material for block in header.blocks if not block.trials}
    if not materials:
        raise InputError("--warm-start: in this session nothing is chosen, all is planned; leave it out.")
    return {
        name: read_warm_start(wanted.warm_start, Study.of(study_of(study, name)), header.seed) for name in materials
    }


def _versions() -> dict[str, str]:
    """Installed versions of hilbo, jax, jaxlib and numpy, by name."""
    return {part: metadata.version(part) for part in ("hilbo", "jax", "jaxlib", "numpy")}


def _tag(header: Header) -> str:
    """A digest of the header (12 hexadecimal digits), the prefix of the trials' names in browsers."""
    return hashlib.sha256(msgspec.json.encode(header)).hexdigest()[:12]
