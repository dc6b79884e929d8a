"""Checks of a session's header, whether it comes from a plan, a log, or the command line."""

import math

from hilbo.errors import InputError
from hilbo.session.log.records import SCHEMA, Header
from hilbo.study.file.plan_file import Block
from hilbo.study.file.protocols import Protocol, protocol
from hilbo.study.file.reading import StudyFile
from hilbo.study.formats.cell_text import check_id, check_text
from hilbo.study.formats.json_file import check_values

__all__ = ["check_header", "check_label", "check_new_header", "own_study", "protocol_of", "study_of"]

_MOST = 100_000  # trials of a block
_LABEL = 64  # characters of a session's label, and of an id
_DAY = 86_400.0  # s


def study_of(study: StudyFile, material: str | None) -> StudyFile:
    """The study file of one material; for None the study itself."""
    return study if material is None else study.material(material)


def protocol_of(study: StudyFile, block: Block) -> Protocol:
    """Protocol of a block: that of its phase, with the changes of its material."""
    return protocol(study_of(study, block.material).session, block.phase)


def own_study(study: StudyFile, header: Header) -> StudyFile:
    """The study file that a session was begun with: `study` if it is still the same, otherwise the one that the header
    holds. Raises InputError if that one is damaged, or if responses to one of the session's materials mean something
    else than by `study`."""
    if header.study == study.hash:
        return study
    try:
        own = study.stored(header.study_tables)
    except InputError as error:
        raise InputError(
            f"its first line has no complete study file ({error}); restore the log from a copy."
        ) from error
    if own.hash != header.study:
        raise InputError("its first line has a study file that does not fit its hash; restore the log from a copy.")
    keys: list[str] = []
    for material in dict.fromkeys(block.material for block in header.blocks):
        keys += study_of(study, material).changes_of_meaning(study_of(own, material))
    if keys:
        raise InputError(
            f"is the log of another study ({header.study}, not {study.hash}): they differ in"
            f" {', '.join(dict.fromkeys(keys))}, which responses depend on; use the study file it was started with."
        )
    return own


def check_header(study: StudyFile, header: Header) -> None:
    """Raise InputError for a header that is not valid for this study: schema, participant, label, seed, blocks or
    sets."""
    if header.schema != SCHEMA:
        raise InputError(f"the session's header is of schema {header.schema}; this hilbo reads {SCHEMA}.")
    person = header.participant
    if not 0 < len(person) <= _LABEL or not person.isprintable() or any(mark in person for mark in "/\\"):
        raise InputError(f'the session\'s participant is "{person[:_LABEL]}", which is not a valid id.')
    check_label(header.session)
    if not 0 <= header.seed < 2**63:
        raise InputError(f"the session's seed is {header.seed}; it must be a whole number from 0.")
    if not header.blocks:
        raise InputError("the session's header has no blocks; there is nothing to ask.")
    for number, block in enumerate(header.blocks, 1):
        _check_block(study, header, block, f"block {number}")
    for name, values in header.sets.items():
        if not all(math.isfinite(value) for value in values.values()):
            raise InputError(f'the set "{name}" of the session has a value that is not a finite number.')


def check_label(label: str) -> None:
    """Raise InputError for a session label that is empty, too long, or has characters that cannot be printed."""
    if not 0 < len(label) <= _LABEL or not label.isprintable():
        words = "".join(c if c.isprintable() else "?" for c in label[:_LABEL])
        raise InputError(
            f'the session\'s label is "{words}"; it must have 1 to {_LABEL} characters, all of which can be printed.'
        )


def check_new_header(study: StudyFile, header: Header) -> None:
    """Raise InputError for a header with which no session may begin: one that `check_header` refuses, more chosen
    trials than the study file has, an id that is not pseudonymous, or a label or name of a set that a spreadsheet would
    run as a formula."""
    check_header(study, header)
    check_id(header.participant, "the session's header")
    check_text(header.session, "the session's label")
    for number, block in enumerate(header.blocks, 1):
        trials = study_of(study, block.material).selection.trials
        if not block.trials and block.count > trials:
            raise InputError(
                f"block {number} has {block.count} trials that are chosen, as in the plan, and the study file has"
                f" selection.trials = {trials}; write {block.count} there, or make a new plan."
            )
        for name in (name for planned in block.trials for name in (planned.a, planned.b) if name is not None):
            check_text(name, "the name of a set", f"block {number}")


def _check_block(study: StudyFile, header: Header, block: Block, place: str) -> None:
    """Raise InputError for a block with too many trials or too long a rest, no planned trials where its phase needs
    them, a wrong number of sides, or sets that the header lacks or that are out of range. `place` names the block in
    messages."""
    if not 0 <= block.count <= _MOST or not 0 <= block.rest <= _DAY:
        raise InputError(f"{place} has {block.count} trials after {block.rest:g} s of rest, which is no session's.")
    if not block.trials:
        if block.phase != "optimisation":
            raise InputError(f"{place} is of the phase {block.phase} and has no planned trials.")
        return
    if block.count > len(block.trials):
        raise InputError(f"{place} needs {block.count} trials and plans {len(block.trials)}.")
    here, two = study_of(study, block.material), "b" in protocol_of(study, block).sides
    for planned in block.trials:
        if (planned.b is not None) != two:
            raise InputError(f"{place} has a trial of {1 + (not two)} renderings, its phase shows {1 + two}.")
        for name in (planned.a, planned.b):
            if name is not None and name not in header.sets:
                raise InputError(f'{place} shows the set "{name}", which the session does not have.')
            if name is not None:
                check_values(header.sets[name], here.space.parameters, place, f'the set "{name}"')
