"""The tables of a study file as records: what may stand there, and what must fit together.

Each table is a schema, whose annotations carry the type, the range and the words for both. Loads no JAX.
"""

import itertools
from collections.abc import Mapping
from typing import Annotated, Any, Literal, get_args

import msgspec

from hilbo.errors import InputError
from hilbo.mechanics.span import Memory
from hilbo.search.box import Box, Mechanics, Parameter
from hilbo.study.fields import NotNegative as _NotNegative
from hilbo.study.fields import Number as _Number
from hilbo.study.fields import Positive as _Positive
from hilbo.study.fields import Table as _Table
from hilbo.study.fields import check_keys, check_table, read_table, shown
from hilbo.study.fields import words as _text
from hilbo.study.protocols import SessionTable
from hilbo.study.stimulus_table import StimulusTable

__all__ = [
    "GPTable",
    "Inference",
    "ReportTable",
    "Rule",
    "Selection",
    "Tables",
    "box_of",
    "check_together",
    "of_material",
    "read",
]

Inference = Literal["laplace", "ep", "ep_corrected", "exact"]
Rule = Literal["bcm", "hierarchical", "rbcm", "average", "pooled", "learnt-1"]
"""How people are merged; `hilbo.population.maps` has the rules."""
_LEARNS: Rule = "learnt-1"
Acquisition = Literal["ucb", "log_ei", "thompson", "top_category", "mean"]


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


class GPTable(_Table, frozen=True):
    """[gp]. What is left out is learnt; every key but `inference` is required by rules that do not learn."""

    theta: Annotated[
        _Positive | Annotated[tuple[_Positive, ...], msgspec.Meta(min_length=1)] | None,
        _text("a number above 0, or a list of one for each parameter", "30.0"),
    ] = None
    variance: Annotated[_Positive | None, _text("a number above 0", "1.0")] = None
    thresholds: Annotated[tuple[float, ...] | None, _text("a list of rising numbers", "[-0.5, 0.5]")] = None
    noise: Annotated[_Positive | None, _text("a number above 0", "0.5")] = None
    inference: Annotated[Inference, _text('"laplace", "ep", "ep_corrected" or "exact"', '"laplace"')] = "laplace"


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
    rule: Annotated[Rule, _text("one of " + ", ".join(f'"{name}"' for name in get_args(Rule)), '"bcm"')] = "bcm"


class ReportTable(_Table, frozen=True):
    """What `hilbo report` says besides. `hypotheses`: what the results say of the paper's hypotheses H1 to H4, and
    which figure is which of the paper's."""

    hypotheses: Annotated[bool, _text("true or false", "true")] = False


class Tables(_Table, frozen=True):
    """The whole file: what the hash is taken of."""

    study: _StudyTable
    parameters: dict[str, _ParameterTable]
    gp: GPTable = GPTable()
    renderer: _RendererTable | None = None
    selection: Selection = Selection()
    aggregation: _AggregationTable = _AggregationTable()
    materials: dict[str, dict[str, Any]] = msgspec.field(default_factory=dict)
    session: SessionTable = SessionTable()
    report: ReportTable = ReportTable()
    stimulus: StimulusTable | None = None


_TABLES = {
    "study": _StudyTable,
    "gp": GPTable,
    "selection": Selection,
    "aggregation": _AggregationTable,
    "session": SessionTable,
    "report": ReportTable,
    "stimulus": StimulusTable,
}
_REQUIRED = ("schema", "study", "parameters")
_KEYS = ("schema", "study", "parameters", "renderer", *list(_TABLES)[1:], "materials")
_OVERRIDES = ("renderer", "parameters")
_UNITS = {"K1": "N/mm", "B1": "N.s^alpha/mm", "alpha": ""}


def read(raw: Mapping[str, Any]) -> Tables:
    """The parsed file as records, every key known and of its type. Raises `InputError`."""
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
    return Tables(parameters=parameters, materials=dict(materials), **tables)


def box_of(tables: Tables) -> Box:
    """[parameters] and [renderer]. Raises `InputError`."""
    parameters = tuple(Parameter(name, **msgspec.structs.asdict(p)) for name, p in tables.parameters.items())
    if tables.renderer is None:
        return Box(parameters)
    for p in parameters:
        unit = p.unit.replace("·", ".").replace("α", "alpha")
        if p.name in _UNITS and unit not in ("", _UNITS[p.name]):
            raise InputError(
                f'parameters.{p.name}.unit is "{p.unit}", it must be "{_UNITS[p.name]}" where there is a [renderer].'
            )
    renderer = msgspec.structs.asdict(tables.renderer)
    del renderer["model"]
    return Box(parameters, Mechanics(**renderer))


def check_together(tables: Tables) -> None:
    """Refuse tables that do not fit each other. Raises `InputError`."""
    labels, selection = tables.study.responses, tables.selection
    if len(set(labels)) < len(labels):
        raise InputError(f"study.responses is {shown(labels)}, it must not have one label twice.")
    if selection.space_filling > selection.trials:
        raise InputError(
            f"selection.space_filling is {selection.space_filling}, it must be at most trials = {selection.trials}."
        )
    tables.session.check(labels)
    if tables.stimulus is not None:
        tables.stimulus.check(tuple(tables.parameters))
        if tables.renderer is not None:
            raise InputError("stimulus stands beside renderer, a study has one: a program presents, or a device.")
    _check_gp(tables.gp, tables.aggregation.rule, len(labels), len(tables.parameters))


def _check_gp(table: GPTable, rule: Rule, count: int, dim: int) -> None:
    """For `count` responses and `dim` parameters."""
    theta, thresholds = table.theta, table.thresholds
    if thresholds is not None:
        if len(thresholds) != count - 1:
            raise InputError(
                f"gp.thresholds has {len(thresholds)} numbers, it must have one fewer than the {count} responses."
            )
        if any(low >= high for low, high in itertools.pairwise(thresholds)):
            raise InputError(f"gp.thresholds is {shown(thresholds)}, it must rise from each number to the next.")
    if isinstance(theta, tuple) and len(theta) != dim:
        raise InputError(f"gp.theta has {len(theta)} numbers, it must be one number or {dim}, one per parameter.")
    if rule == _LEARNS:
        if table.inference != "laplace":
            raise InputError(f'gp.inference is {shown(table.inference)}, it must be "laplace" with rule = "{_LEARNS}".')
        return
    missing = [name for name in ("theta", "variance", "thresholds", "noise") if getattr(table, name) is None]
    if missing:
        raise InputError(f'gp.{missing[0]} is missing, add it; rule = "{_LEARNS}" learns it from the answers.')


def of_material(raw: Mapping[str, Any], name: str) -> dict[str, Any]:
    """The parsed file as it is for one material."""
    tables = {key: value for key, value in raw.items() if key != "materials"}
    for table, changes in raw["materials"][name].items():
        tables[table] = _merged(tables.get(table, {}), changes)
    return tables


def _merged(base: Any, changes: Any) -> Any:
    """Changes over what they change, table within table."""
    if not (isinstance(base, Mapping) and isinstance(changes, Mapping)):
        return changes
    return {**base, **{key: _merged(base.get(key, {}), value) for key, value in changes.items()}}
