"""A study file, read and checked: all that plans, logs, tables and devices need to know of a study. Loads no JAX.

A study file is TOML (docs, "Study file"). Whatever is wrong becomes one `InputError`: `file:line: key.path is …, it
must be …`. The hash is the first 16 hex digits of the SHA-256 of the parsed content as JSON, in the order of the
schemas, with defaults left out: spelling a default out changes nothing, the order of the parameters does.
"""

import hashlib
import json
import os
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

import msgspec

from hilbo.errors import InputError
from hilbo.search.box import Box, Constraint, Mechanics, Parameter
from hilbo.study.file.fields import enclosing, lines_of, prefix
from hilbo.study.file.protocols import SessionTable
from hilbo.study.file.schema import Selection, Tables
from hilbo.study.file.space_tables import box_of, check_together, of_material, read
from hilbo.study.file.stimuli import StimulusTable

__all__ = ["AnyStudy", "StudyFile", "checked", "hash_of", "made_of_material", "materials_in", "read_study"]

_T = TypeVar("_T")


@dataclass(frozen=True)
class StudyFile:
    """What stands in a study file. `space` is the box of its parameters, of which a part may be passive."""

    tables: Tables
    space: Box
    source: str
    """The file that it came from."""

    @staticmethod
    def load(path: str | os.PathLike) -> "StudyFile":
        """Read and check a study file; InputError says in one sentence what is wrong with it, and where."""
        return read_study(path, _itself)

    @property
    def name(self) -> str:
        """The study's name."""
        return self.tables.study.name

    @property
    def responses(self) -> tuple[str, ...]:
        """The answers, lowest first."""
        return self.tables.study.responses

    @property
    def random_effect(self) -> str | None:
        """The column of the answers' table whose levels have an effect of their own."""
        table = self.tables.random_effect
        return None if table is None else table.column

    @property
    def exclude_flags(self) -> tuple[str, ...]:
        """Flags of the device for which an analysis leaves a trial out."""
        return self.tables.study.exclude_flags

    @property
    def selection(self) -> Selection:
        """How trials are chosen."""
        return self.tables.selection

    @property
    def session(self) -> SessionTable:
        """What is said of live sessions."""
        return self.tables.session

    @property
    def stimulus(self) -> StimulusTable | None:
        """What is asked of the program that presents the renderings; None where a device does."""
        return None if self.space.mechanics is not None else self.tables.stimulus or StimulusTable()

    @cached_property
    def content(self) -> str:
        """The parsed file as JSON."""
        return json.dumps(msgspec.to_builtins(self.tables), ensure_ascii=False, separators=(",", ":"))

    @property
    def hash(self) -> str:
        """Identifies the content."""
        return hash_of(self.content)

    @property
    def materials(self) -> tuple[str, ...]:
        """Names of the materials that override the renderer or the parameters."""
        return materials_in(self.content)

    def material(self, name: str) -> "StudyFile":
        """The file as it is for one material: its overrides of [renderer] and [parameters] applied."""
        return made_of_material(self.content, self.source, name, _itself)


@runtime_checkable
class _AnySpace(Protocol):
    """The names and ranges of a space: of a `Box`, or of the `SearchSpace` that is in it."""

    @property
    def parameters(self) -> tuple[Parameter, ...]: ...

    @property
    def mechanics(self) -> Mechanics | None: ...

    @property
    def constraints(self) -> tuple[Constraint, ...]: ...

    @property
    def names(self) -> tuple[str, ...]: ...

    @property
    def dim(self) -> int: ...


@runtime_checkable
class AnyStudy(Protocol):
    """What plans, logs and tables need of a study: a `StudyFile`, or the `Study` that was made of it."""

    @property
    def name(self) -> str: ...

    @property
    def responses(self) -> tuple[str, ...]: ...

    @property
    def space(self) -> _AnySpace: ...

    @property
    def random_effect(self) -> str | None: ...

    @property
    def exclude_flags(self) -> tuple[str, ...]: ...

    @property
    def selection(self) -> Selection: ...

    @property
    def session(self) -> SessionTable: ...

    @property
    def stimulus(self) -> StimulusTable | None: ...

    @property
    def hash(self) -> str: ...

    @property
    def materials(self) -> tuple[str, ...]: ...

    def material(self, name: str) -> "AnyStudy": ...


def read_study(path: str | os.PathLike, make: Callable[[StudyFile], _T]) -> _T:
    """What `make` makes of a study file, of that of each material too, to find mistakes now. InputError says in one
    sentence what is wrong, with the file or for `make`, and where."""
    source = str(path)
    if Path(path).suffix.lower() in (".csv", ".parquet", ".tsv"):
        raise InputError(f"{source}: is a table by its name, and no study file; give a file such as study.toml.")
    try:
        text = Path(path).read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise InputError(f"{source}: cannot be read ({error.strerror}), check the path.") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{source}: is not UTF-8 text, save it as UTF-8.") from error
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        reason, _, rest = str(error).partition(" (at line ")
        line = rest.partition(",")[0]
        place = f"{source}:{line or len(text.splitlines())}"
        raise InputError(f"{place}: is not valid TOML ({reason}), fix that line.") from error
    return checked(raw, source, make, text)


def checked(raw: Mapping[str, Any], source: str, make: Callable[[StudyFile], _T], text: str = "") -> _T:
    """As `read_study`, from the parsed tables; `text`: the file's, in which the line of a mistake is looked for."""
    place = ""
    try:
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


@lru_cache(maxsize=64)
def hash_of(content: str) -> str:
    """First 16 hex digits of the SHA-256 of a study's content, without the people of its simulations and the column of
    a random effect: they change nothing that is asked of people, whose sessions may be over."""
    tables = json.loads(content)
    hashed = {name: table for name, table in tables.items() if name not in ("simulation", "random_effect")}
    if len(hashed) < len(tables):
        content = json.dumps(hashed, ensure_ascii=False, separators=(",", ":"))
    return hashlib.sha256(content.encode()).hexdigest()[:16]


def materials_in(content: str) -> tuple[str, ...]:
    """Names of the materials in a study's content."""
    return tuple(json.loads(content).get("materials", {}))


@lru_cache(maxsize=32)  # every event of a log may ask for its block's
def made_of_material(content: str, source: str, name: str, make: Callable[[StudyFile], _T]) -> _T:
    """What `make` makes of the study of one material, from the content of the whole one. Raises InputError."""
    if name not in materials_in(content):
        listed = ", ".join(materials_in(content)) or "there are none"
        raise InputError(f"{prefix(source)}materials.{name} is not in the study, its materials: {listed}.")
    return checked(of_material({"schema": 1} | json.loads(content), name), source, make)


def _file(raw: Mapping[str, Any], source: str) -> StudyFile:
    """The file itself, without its materials' overrides."""
    tables = read(raw)
    box = box_of(tables)
    check_together(tables, box.parameters)
    return StudyFile(tables, box, source)


def _itself(file: StudyFile) -> StudyFile:
    return file
