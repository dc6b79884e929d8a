"""The Study record: a study file, read and checked.

A study file is TOML (docs, "Study file"); each table is a schema below, whose annotations carry the type, the range
and the words for both. Whatever is wrong becomes one `InputError`: `file:line: key.path is …, it must be …`.
The hash is the first 16 hex digits of the SHA-256 of the parsed content as JSON, in the order of the schemas, with
defaults left out: spelling a default out changes nothing, the order of the parameters does.
"""

import hashlib
import itertools
import json
import os
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import equinox as eqx
import msgspec

from hilbo.errors import InputError
from hilbo.mechanics.memory import Memory
from hilbo.ordinal_gp import RBF, OrdinalGP, OrdinalProbit
from hilbo.population.learnt import NOTHING, RECIPE, Learnt, Stated, prior_model
from hilbo.population.maps import ALL_RULES, AnyRule
from hilbo.search.feasibility import Mechanics
from hilbo.search.space import Parameter, SearchSpace
from hilbo.study.fields import NotNegative as _NotNegative
from hilbo.study.fields import Number as _Number
from hilbo.study.fields import Positive as _Positive
from hilbo.study.fields import Table as _Table
from hilbo.study.fields import check_keys, check_table, enclosing, lines_of, prefix, read_table, shown
from hilbo.study.fields import words as _text
from hilbo.study.protocols import SessionTable

__all__ = ["RBF", "Inference", "OrdinalGP", "OrdinalProbit", "Selection", "Study"]


class _StudyTable(_Table, frozen=True):
    name: Annotated[str, msgspec.Meta(min_length=1), _text("a text", '"memory foam"')]
    responses: Annotated[
        tuple[str, ...],
        msgspec.Meta(min_length=2),
        _text("a list of two or more texts, lowest first", '["different", "similar", "close"]'),
    ]
    attribute: Annotated[str, msgspec.Meta(min_length=1), _text("a text", '"perceived realism"')] = "perceived realism"
    exclude: Annotated[str, _text("a rule, or nothing", '"trials < 10 or lapse_low > 0.3"')] = ""


class _ParameterTable(_Table, frozen=True):
    low: _Number
    high: _Number
    unit: Annotated[str, _text("a text", '"N/mm"')] = ""
    scale: Annotated[Literal["linear", "log"], _text('"linear" or "log"', '"linear"')] = "linear"


class _RendererTable(_Table, frozen=True):
    K_eff: Annotated[_NotNegative, msgspec.Meta(examples=["0.44"])]
    damping: Annotated[_Positive, msgspec.Meta(examples=["0.95"])]
    model: Annotated[Literal["fosls"], _text('"fosls"', '"fosls"')] = "fosls"
    memory: Annotated[Memory, _text('"short" or "full"', '"short"')] = "short"
    N: Annotated[int, msgspec.Meta(ge=1), _text("an odd whole number, 1 or above", "101")] = 101
    states: Annotated[int, _text("a number of exponentials, for full memory", "10")] = 10
    T: Annotated[_Positive, msgspec.Meta(examples=["0.001"])] = 1e-3
    effective_damping: Annotated[tuple[float, float] | None, _text("a list of two numbers", "[10, 80]")] = None


Inference = Literal["laplace", "ep", "ep_corrected", "exact"]


class _GPTable(_Table, frozen=True):
    """What is left out is learnt; every key but `inference` is required by rules that do not learn."""

    theta: Annotated[
        _Positive | Annotated[tuple[_Positive, ...], msgspec.Meta(min_length=1)] | None,
        _text("a number above 0, or a list of one for each parameter", "30.0"),
    ] = None
    variance: Annotated[_Positive | None, _text("a number above 0", "1.0")] = None
    thresholds: Annotated[tuple[float, ...] | None, _text("a list of rising numbers", "[-0.5, 0.5]")] = None
    noise: Annotated[_Positive | None, _text("a number above 0", "0.5")] = None
    inference: Annotated[Inference, _text('"laplace", "ep", "ep_corrected" or "exact"', '"laplace"')] = "laplace"


Acquisition = Literal["ucb", "log_ei", "thompson", "top_category", "mean"]


class Selection(_Table, frozen=True):
    """How trials are chosen: first `space_filling` of them by a Latin hypercube, then by the acquisition function.

    `weight`: of the standard deviation in UCB. `minimum_distance`: to earlier trials, in the unit cube.
    """

    space_filling: Annotated[int, msgspec.Meta(ge=0), _text("a whole number, 0 or above", "5")] = 5
    trials: Annotated[int, msgspec.Meta(ge=1), _text("a whole number, 1 or above", "25")] = 25
    acquisition: Annotated[
        Acquisition, _text("one of " + ", ".join(f'"{name}"' for name in get_args(Acquisition)), '"ucb"')
    ] = "ucb"
    weight: Annotated[_NotNegative, msgspec.Meta(examples=["0.7"])] = 0.7
    minimum_distance: Annotated[_NotNegative | None, _text("a number, 0 or above", "0.05")] = None


class _AggregationTable(_Table, frozen=True):
    rule: Annotated[AnyRule, _text("one of " + ", ".join(f'"{name}"' for name in ALL_RULES), '"bcm"')] = "bcm"


class _Content(_Table, frozen=True):
    """The whole file: what the hash is taken of."""

    study: _StudyTable
    parameters: dict[str, _ParameterTable]
    gp: _GPTable = _GPTable()
    renderer: _RendererTable | None = None
    selection: Selection = Selection()
    aggregation: _AggregationTable = _AggregationTable()
    materials: dict[str, dict[str, Any]] = msgspec.field(default_factory=dict)
    session: SessionTable = SessionTable()


_TABLES = {
    "study": _StudyTable,
    "gp": _GPTable,
    "selection": Selection,
    "aggregation": _AggregationTable,
    "session": SessionTable,
}
_REQUIRED = ("schema", "study", "parameters")
_KEYS = ("schema", "study", "parameters", "renderer", "gp", "selection", "aggregation", "session", "materials")
_OVERRIDES = ("renderer", "parameters")
_UNITS = {"K1": "N/mm", "B1": "N.s^alpha/mm", "alpha": ""}


class Study(eqx.Module):
    """What is asked, over which space, with which model: everything but the answers.

    `gp` holds arrays and may be differentiated; all else is static. `source` is the file it came from, `hash`
    identifies its content.
    """

    gp: OrdinalGP
    space: SearchSpace
    name: str = eqx.field(static=True)
    responses: tuple[str, ...] = eqx.field(static=True)
    attribute: str = eqx.field(static=True)
    """What is judged, in words: labels of axes."""
    exclude: str = eqx.field(static=True)
    """The rule by which people are left out (`hilbo.population.response_quality`), empty for nobody."""
    selection: Selection = eqx.field(static=True)
    inference: Inference = eqx.field(static=True)
    rule: AnyRule = eqx.field(static=True)
    source: str = eqx.field(static=True)
    content: str = eqx.field(static=True, repr=False)  # the parsed file as JSON
    session: SessionTable = eqx.field(static=True, repr=False, default=SessionTable())
    stated: Stated = eqx.field(static=True, repr=False, default=NOTHING)
    """What the file states of the model, where the rule learns the rest."""
    learnt: Learnt | None = eqx.field(repr=False, default=None)
    """What was learnt from the answers, by a rule that learns; `gp` is then the learnt model, and before that the
    priors' medians."""

    @staticmethod
    def load(path: str | os.PathLike) -> "Study":
        """Read and check a study file; InputError says in one sentence what is wrong with it, and where."""
        source = str(path)
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
            raise InputError(f"{place}: is not valid TOML ({reason}), mend that line.") from error
        return _checked(raw, source, text)

    @staticmethod
    def from_dict(raw: Mapping[str, Any], source: str = "") -> "Study":
        """As `load`, from the parsed tables; numbers and lists may be NumPy's."""
        return _checked(_plain(raw), source, "")

    @property
    def hash(self) -> str:
        """First 16 hex digits of the SHA-256 of the content."""
        return hashlib.sha256(self.content.encode()).hexdigest()[:16]

    @property
    def materials(self) -> tuple[str, ...]:
        """Names of the materials that override the renderer or the parameters."""
        return tuple(json.loads(self.content).get("materials", {}))

    def material(self, name: str) -> "Study":
        """The study of one material: its overrides of [renderer] and [parameters] applied."""
        if name not in self.materials:
            listed = ", ".join(self.materials) or "there are none"
            raise InputError(f"{prefix(self.source)}materials.{name} is not in the study, its materials: {listed}.")
        return _checked(_of_material({"schema": 1} | json.loads(self.content), name), self.source, "")


def _plain(raw: Any) -> Any:
    """With Python's own numbers, lists and dicts in place of NumPy's and other mappings."""
    if isinstance(raw, Mapping):
        return {key: _plain(value) for key, value in raw.items()}
    if isinstance(raw, list | tuple):
        return [_plain(value) for value in raw]
    return raw.tolist() if hasattr(raw, "tolist") else raw


def _checked(raw: Mapping[str, Any], source: str, text: str) -> Study:
    """Build the study and, to find mistakes now, that of each material; name the place of a mistake."""
    place = ""
    try:
        study = _study(raw, source)
        for name in study.materials:
            place = f"materials.{name}."
            _study(_of_material(raw, name), source)
    except InputError as error:
        lines = lines_of(text)
        where = next((lines[key] for key in enclosing(place + str(error).split()[0], place) if key in lines), None)
        raise InputError(f"{prefix(source, where)}{place}{error}") from None
    return study


def _study(raw: Mapping[str, Any], source: str) -> Study:
    """The study itself, without its materials' overrides."""
    content = _read(raw)
    space = _space(content)
    labels = content.study.responses
    if len(set(labels)) < len(labels):
        raise InputError(f"study.responses is {shown(labels)}, it must not have one label twice.")
    if content.selection.space_filling > content.selection.trials:
        raise InputError(
            f"selection.space_filling is {content.selection.space_filling}, it must be at most"
            f" trials = {content.selection.trials}."
        )
    content.session.check(labels)
    gp, stated = _gp(content, space.dim)
    return Study(
        gp=gp,
        space=space,
        name=content.study.name,
        responses=labels,
        attribute=content.study.attribute,
        exclude=content.study.exclude,
        selection=content.selection,
        inference=content.gp.inference,
        rule=content.aggregation.rule,
        source=source,
        content=json.dumps(msgspec.to_builtins(content), ensure_ascii=False, separators=(",", ":")),
        session=content.session,
        stated=stated,
    )


def _gp(content: _Content, dim: int) -> tuple[OrdinalGP, Stated]:
    """The model of [gp], and what the file states of it; a rule that learns takes the priors' medians for the rest."""
    table, rule, count = content.gp, content.aggregation.rule, len(content.study.responses)
    theta, variance, thresholds, noise = table.theta, table.variance, table.thresholds, table.noise
    if thresholds is not None:
        if len(thresholds) != count - 1:
            raise InputError(
                f"gp.thresholds has {len(thresholds)} numbers, it must have one fewer than the {count} responses."
            )
        if any(low >= high for low, high in itertools.pairwise(thresholds)):
            raise InputError(f"gp.thresholds is {shown(thresholds)}, it must rise from each number to the next.")
    if isinstance(theta, tuple) and len(theta) != dim:
        raise InputError(f"gp.theta has {len(theta)} numbers, it must be one number or {dim}, one per parameter.")
    if rule == RECIPE:
        if table.inference != "laplace":
            raise InputError(f'gp.inference is {shown(table.inference)}, it must be "laplace" with rule = "{RECIPE}".')
        lengths = theta if theta is None or isinstance(theta, tuple) else (theta,) * dim
        stated = Stated(lengths, variance, thresholds, noise)
        return prior_model(dim, count, stated), stated
    missing = [name for name in Stated._fields if getattr(table, name) is None]
    if missing:
        raise InputError(f'gp.{missing[0]} is missing, add it; rule = "{RECIPE}" learns it from the answers.')
    assert theta is not None and variance is not None and thresholds is not None and noise is not None
    return OrdinalGP(RBF(theta, variance), OrdinalProbit(thresholds, noise)), NOTHING


def _space(content: _Content) -> SearchSpace:
    """The search space of [parameters] and [renderer]."""
    parameters = tuple(Parameter(name, **msgspec.structs.asdict(p)) for name, p in content.parameters.items())
    if content.renderer is None:
        return SearchSpace(parameters)
    for p in parameters:
        unit = p.unit.replace("·", ".").replace("α", "alpha")
        if p.name in _UNITS and unit not in ("", _UNITS[p.name]):
            raise InputError(
                f'parameters.{p.name}.unit is "{p.unit}", it must be "{_UNITS[p.name]}" where there is a [renderer].'
            )
    renderer = msgspec.structs.asdict(content.renderer)
    del renderer["model"]
    return SearchSpace(parameters, Mechanics(**renderer))


def _read(raw: Mapping[str, Any]) -> _Content:
    """The parsed file as records, every key known and of its type."""
    check_keys(raw, "", _KEYS, _REQUIRED)
    if raw["schema"] is True or raw["schema"] != 1:
        raise InputError(f"schema is {shown(raw['schema'])}, it must be 1: this hilbo reads no other.")
    tables = {key: read_table(kind, raw[key], key) for key, kind in _TABLES.items() if key in raw}
    if "renderer" in raw:
        tables["renderer"] = read_table(_RendererTable, raw["renderer"], "renderer")
    check_table(raw["parameters"], "parameters")
    parameters = {
        name: read_table(_ParameterTable, table, f"parameters.{name}") for name, table in raw["parameters"].items()
    }
    materials = raw.get("materials", {})
    check_table(materials, "materials")
    for name, table in materials.items():
        check_keys(table, f"materials.{name}", _OVERRIDES)
    return _Content(parameters=parameters, materials=dict(materials), **tables)


def _of_material(raw: Mapping[str, Any], name: str) -> dict[str, Any]:
    """The file as it is for one material."""
    tables = {key: value for key, value in raw.items() if key != "materials"}
    for table, changes in raw["materials"][name].items():
        tables[table] = _merged(tables.get(table, {}), changes)
    return tables


def _merged(base: Any, changes: Any) -> Any:
    """Changes over what they change, table within table."""
    if not (isinstance(base, Mapping) and isinstance(changes, Mapping)):
        return changes
    return {**base, **{key: _merged(base.get(key, {}), value) for key, value in changes.items()}}
