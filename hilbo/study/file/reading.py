"""The study file, read and checked: the record from which plans, logs, tables and devices take what they need. Loads no
JAX.

A study file is TOML (docs, "Study file"). Every mistake becomes one `InputError`:
`file:line: key.path is …, it must be …`. The hash is the first 16 hex digits of the SHA-256 of the parsed content as
JSON, in the order of the schemas, with defaults left out: writing a default explicitly does not change it, the order of
the parameters does. A second hash covers the keys on which the meaning of responses depends
(`hilbo.study.file.meaning`); logs and results are read together if it is the same.
"""

import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from hilbo.errors import InputError
from hilbo.search.box import Box
from hilbo.study.file.fields import enclosing, lines_of, prefix
from hilbo.study.file.meaning import differing_keys, meaning_part
from hilbo.study.file.protocols import SessionTable
from hilbo.study.file.schema import GPTable, PlanTable, ReportTable, Selection, Tables, ValidationTable
from hilbo.study.file.simulated_people import SimulationTable
from hilbo.study.file.space_tables import box_of, check_together, of_material, read
from hilbo.study.file.stimuli import StimulusTable
from hilbo.study.file.trial_flags import TrialFlag
from hilbo.study.formats.json_file import Content, digest_of
from hilbo.study.formats.parsing import check_parsed, toml

__all__ = ["StudyFile", "checked", "read_study"]

_T = TypeVar("_T")


_NOT_HASHED = ("simulation", "random_effect", "validation")


@dataclass(frozen=True, eq=False)
class StudyFile:
    """The content of a study file. Two are equal if their content and their path are equal."""

    name: str
    responses: tuple[str, ...]
    """Labels, lowest first."""
    goal: str
    """The response that is searched for; empty for the highest."""
    attribute: str
    """Attribute that is rated, such as "perceived realism"; used in axis labels."""
    exclude: str
    """Rule that excludes participants (`hilbo.population.judged.response_quality`), empty for none."""
    missing: tuple[str, ...]
    """Cells of a trial table that stand for a missing response."""
    exclude_flags: tuple[TrialFlag, ...]
    """Flags of the device that exclude a trial from the analysis (`hilbo.study.file.trial_flags`)."""
    space: Box
    """The ranges and constraints of the parameters; with mechanics only a part of it may be passive."""
    gp: GPTable
    rule: str
    """Name of the aggregation method."""
    selection: Selection
    session: SessionTable
    report: ReportTable
    validation: ValidationTable
    plan: PlanTable
    stimulus: StimulusTable | None
    """How a program or a person presents the stimuli; None where a device does."""
    simulation: SimulationTable | None
    """The participants that `hilbo simulate` and `hilbo power` draw, if the file specifies them."""
    random_effect: str | None
    """Column of the trial table whose levels have a random effect (with a method that learns it); None for none."""
    materials: tuple[str, ...]
    """Names of the materials that override the renderer or the parameters."""
    content: str
    """The parsed file as JSON."""
    source: str
    """The path of the file, empty if there is none."""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, StudyFile) and (self.content, self.source) == (other.content, other.source)

    def __hash__(self) -> int:
        return hash((self.content, self.source))

    @staticmethod
    def load(path: str | os.PathLike) -> "StudyFile":
        """Read and check a study file, without building its model. Raises `InputError`, one sentence with the place of
        the mistake."""
        return read_study(path, _identity)

    @property
    def tables(self) -> Content:
        """The parsed file without its schema number; defaults are left out. `checked` makes the same file of it."""
        return json.loads(self.content)

    @cached_property
    def hash(self) -> str:
        """First 16 hex digits of the SHA-256 of the content, without [simulation], [random_effect] and [validation]:
        these do not change the trials of participants, whose sessions may be over."""
        hashed = {name: table for name, table in self.tables.items() if name not in _NOT_HASHED}
        return digest_of(_as_json(hashed).encode())

    @cached_property
    def meaning(self) -> str:
        """First 16 hex digits of the SHA-256 of what responses mean (`meaning_part`), materials not considered.
        Responses to studies of the same meaning are read together."""
        return digest_of(json.dumps(meaning_part(self.tables), ensure_ascii=False, sort_keys=True).encode())

    def meanings(self, materials: Sequence[str | None]) -> tuple[str, ...]:
        """`meaning` of the file of each of the materials; None: of this file. Raises `InputError` for a name that is
        not in [materials]."""
        return tuple((self.material(name) if name else self).meaning for name in materials)

    def changes(self, other: "StudyFile") -> list[str]:
        """Keys that differ from another study file."""
        return differing_keys(other.tables, self.tables)

    def changes_of_meaning(self, other: "StudyFile") -> list[str]:
        """Keys that differ from another study file and determine what responses mean; empty if `meaning` is the
        same."""
        return differing_keys(meaning_part(other.tables), meaning_part(self.tables))

    def stored(self, tables: Content) -> "StudyFile":
        """The file of `tables`, as in a log, under this file's path. Raises `InputError`."""
        return checked({"schema": 1} | tables, self.source, _identity)

    def material(self, name: str) -> "StudyFile":
        """The file of one material: its overrides applied. Raises `InputError` for a
        name that is not in [materials]."""
        return _of_material(self, name)


def read_study(path: str | os.PathLike, make: Callable[[StudyFile], _T]) -> _T:
    """Read and check a study file; returns `make` of it. `make` is also called for each material's file, to find
    mistakes early.

    Raises InputError for a file that cannot be read or is invalid, and adds file and line to an InputError of `make`.
    """
    source = str(path)
    if Path(path).suffix.lower() in (".csv", ".parquet", ".tsv"):
        raise InputError(f"{source}: is a table by its name, and no study file; give a file such as study.toml.")
    try:
        text = Path(path).read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise InputError(f"{source}: cannot be read ({error.strerror}), check the path.") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{source}: is not UTF-8 text, save it as UTF-8.") from error
    return checked(toml(text, source), source, make, text)


def checked(raw: Mapping[str, Any], source: str, make: Callable[[StudyFile], _T], text: str = "") -> _T:
    """Check the parsed tables of a study file; returns `make` of its StudyFile. `make` is also called for each
    material's file.

    `source`: path for messages, or ""; `text`: text of the file, in which the line of a mistake is found. Raises
    InputError, also for one of `make`, with the file and the line.
    """
    place = ""
    try:
        check_parsed(raw)
        file = _file(raw, source)
        whole = make(file)
        for name in file.materials:
            place = f"materials.{name}."
            make(_file(of_material(raw, name), source))
    except InputError as error:
        lines = lines_of(text)
        where = next((lines[key] for key in enclosing(place + str(error).split()[0], place) if key in lines), None)
        raise InputError(f"{prefix(source, where)}{place}{error}") from None
    return whole


@lru_cache(maxsize=32)  # every event of a log may ask for its block's
def _of_material(file: StudyFile, name: str) -> StudyFile:
    """The file of one material: its overrides applied, without [materials]. Raises
    `InputError` for an unknown name. The last 32 are cached."""
    if name not in file.materials:
        listed = ", ".join(file.materials) or "there are none"
        raise InputError(f"{prefix(file.source)}materials.{name} is not in the study, its materials: {listed}.")
    return checked(of_material({"schema": 1} | file.tables, name), file.source, _identity)


def _file(raw: Mapping[str, Any], source: str) -> StudyFile:
    """The checked StudyFile of parsed tables; overrides in [materials] are not applied. Raises InputError."""
    tables = _without_default_goal(read(raw))
    box = box_of(tables)
    check_together(tables, box.parameters)
    return StudyFile(
        **msgspec.structs.asdict(tables.study),
        space=box,
        gp=tables.gp,
        rule=tables.aggregation.rule,
        selection=tables.selection,
        session=tables.session,
        report=tables.report,
        validation=tables.validation,
        plan=tables.plan,
        stimulus=tables.stimulus or (StimulusTable() if tables.renderer is None else None),
        simulation=tables.simulation,
        random_effect=None if tables.random_effect is None else tables.random_effect.column,
        materials=tuple(tables.materials),
        content=_as_json(msgspec.to_builtins(tables)),
        source=source,
    )


def _without_default_goal(tables: Tables) -> Tables:
    """The tables without a goal that is the highest response, which is the default."""
    if tables.study.goal != tables.study.responses[-1]:
        return tables
    return msgspec.structs.replace(tables, study=msgspec.structs.replace(tables.study, goal=""))


def _as_json(tables: Mapping[str, Any]) -> str:
    """Compact JSON text of the tables, in their order."""
    return json.dumps(tables, ensure_ascii=False, separators=(",", ":"))


def _identity(file: StudyFile) -> StudyFile:
    """Identity, as the `make` of `read_study`."""
    return file
