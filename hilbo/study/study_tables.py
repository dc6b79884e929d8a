"""The tables of a study file as records: what may stand there, and what must fit together.

Each table is a schema, whose annotations carry the type, the range and the words for both. Loads no JAX.
"""

import itertools
from collections.abc import Collection, Mapping, Sequence
from typing import Annotated, Any, Literal, get_args

import msgspec

from hilbo.errors import InputError
from hilbo.mechanics.span import Memory
from hilbo.search.box import Box, Constraint, Mechanics, Parameter
from hilbo.study.fields import NotNegative as _NotNegative
from hilbo.study.fields import Number as _Number
from hilbo.study.fields import Positive as _Positive
from hilbo.study.fields import Table as _Table
from hilbo.study.fields import check_keys, check_present, check_table, missing_keys, read_table, shown
from hilbo.study.fields import words as _text
from hilbo.study.protocols import SessionTable
from hilbo.study.reserved_names import TRIAL_COLUMNS, is_reserved
from hilbo.study.simulation_table import SimulationTable
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
Rule = Literal["bcm", "hierarchical", "rbcm", "average", "pooled", "learnt-1", "learnt-2"]
"""How people are aggregated; `hilbo.population.maps` has the rules."""
_LEARN: tuple[Rule, ...] = ("learnt-1", "learnt-2")
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
    integer: Annotated[bool, _text("true or false", "true")] = False


class _LevelsTable(_Table, frozen=True):
    """A parameter of unordered levels. `correlation`: of the latent score at two of them, before any answer."""

    levels: Annotated[
        tuple[Annotated[str, msgspec.Meta(min_length=1)], ...],
        msgspec.Meta(min_length=2),
        _text("a list of two or more texts", '["silk", "wood", "stone"]'),
    ]
    correlation: Annotated[float, msgspec.Meta(gt=0, lt=1), _text("a number above 0 and below 1", "0.5")] = 0.5


class _ConstraintTable(_Table, frozen=True):
    """`least` <= the sum of weight times parameter <= `most`, in physical units."""

    terms: Annotated[
        dict[str, float], msgspec.Meta(min_length=1), _text("a table of weights", "{gain = 1, delay = 0.5}")
    ]
    least: _Number | None = None
    most: _Number | None = None


class _RendererTable(_Table, frozen=True):
    K_eff: Annotated[_NotNegative, msgspec.Meta(examples=["0.44"])]
    damping: Annotated[_Positive, msgspec.Meta(examples=["0.95"])]
    model: Annotated[Literal["fosls"], _text('"fosls"', '"fosls"')] = "fosls"
    memory: Annotated[Memory, _text('"short" or "full"', '"short"')] = "short"
    N: Annotated[int, msgspec.Meta(ge=1), _text("an odd whole number, 1 or above", "101")] = 101
    states: Annotated[int, _text("a number of exponentials, for full memory", "10")] = 10
    T: Annotated[_Positive, msgspec.Meta(examples=["0.001"])] = 1e-3
    effective_damping: Annotated[tuple[float, float] | None, _text("a list of two numbers", "[10, 80]")] = None


_Length = Annotated[float, msgspec.Meta(ge=1e-3, le=1e3)]


class GPTable(_Table, frozen=True):
    """[gp]. What is left out is learnt; rules that do not learn require theta or length, and all but `inference`.

    `length`: over which answers change, as a part of a parameter's range; theta = 1/(2 length^2).
    """

    theta: Annotated[
        _Positive | Annotated[tuple[_Positive, ...], msgspec.Meta(min_length=1)] | None,
        _text("a number above 0, or a list of one for each parameter", "30.0"),
    ] = None
    length: Annotated[
        _Length | Annotated[tuple[_Length, ...], msgspec.Meta(min_length=1)] | None,
        _text("a number from 0.001 to 1000, or a list of one for each parameter", "0.3"),
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


class _RandomEffectTable(_Table, frozen=True):
    """`column`: of the answers' table, such as the clip, whose levels add something of their own."""

    column: Annotated[str, msgspec.Meta(min_length=1), _text("the name of a column", '"clip"')]


class ReportTable(_Table, frozen=True):
    """What `hilbo report` says besides. `hypotheses`: what the results say of the paper's hypotheses H1 to H4, and
    which figure is which of the paper's."""

    hypotheses: Annotated[bool, _text("true or false", "true")] = False


class Tables(_Table, frozen=True):
    """The whole file: what the hash is taken of."""

    study: _StudyTable
    parameters: dict[str, _ParameterTable | _LevelsTable]
    gp: GPTable = GPTable()
    renderer: _RendererTable | None = None
    selection: Selection = Selection()
    aggregation: _AggregationTable = _AggregationTable()
    materials: dict[str, dict[str, Any]] = msgspec.field(default_factory=dict)
    session: SessionTable = SessionTable()
    report: ReportTable = ReportTable()
    stimulus: StimulusTable | None = None
    simulation: SimulationTable | None = None
    random_effect: _RandomEffectTable | None = None
    constraints: tuple[_ConstraintTable, ...] = ()


_TABLES = {
    "study": _StudyTable,
    "gp": GPTable,
    "selection": Selection,
    "aggregation": _AggregationTable,
    "session": SessionTable,
    "report": ReportTable,
    "stimulus": StimulusTable,
    "simulation": SimulationTable,
    "random_effect": _RandomEffectTable,
}
_REQUIRED = ("schema", "study", "parameters")
_KEYS = ("schema", "study", "parameters", "renderer", *list(_TABLES)[1:], "constraints", "materials")
_LEARNT = ("theta", "variance", "thresholds", "noise")
_OVERRIDES = ("renderer", "parameters")
_NUMBERS_KEYS = ("low", "high", "unit", "scale", "integer")
_UNITS = {"K1": "N/mm", "B1": "N.s^alpha/mm", "alpha": ""}


def read(raw: Mapping[str, Any]) -> Tables:
    """The parsed file as records, every key known and of its type. Raises `InputError`."""
    check_keys(raw, "", _KEYS)
    _check_complete(raw)
    if raw["schema"] is True or raw["schema"] != 1:
        raise InputError(f"schema is {shown(raw['schema'])}; it must be 1: this hilbo reads no other.")
    tables = {key: read_table(kind, raw[key], key) for key, kind in _TABLES.items() if key in raw}
    parameters = {
        name: read_table(_kind_of(table), table, f"parameters.{name}") for name, table in raw["parameters"].items()
    }
    if "gp" in tables:
        tables["gp"] = _with_theta(tables["gp"], parameters.values())
    if "renderer" in raw:
        tables["renderer"] = read_table(_RendererTable, raw["renderer"], "renderer")
    if "constraints" in raw:
        tables["constraints"] = _constraints(raw["constraints"])
    materials = check_table(raw.get("materials", {}), "materials")
    for name, table in materials.items():
        check_keys(table, f"materials.{name}", _OVERRIDES)
        check_keys(table.get("parameters", {}), f"materials.{name}.parameters", tuple(raw["parameters"]))
    return Tables(parameters=parameters, materials=dict(materials), **tables)


def _constraints(raw: Any) -> tuple[_ConstraintTable, ...]:
    """[[constraints]], each called by its number from 1. Raises `InputError`."""
    if not isinstance(raw, list):
        raise InputError(f"constraints is {shown(raw)}; it must be tables; write each as [[constraints]].")
    return tuple(read_table(_ConstraintTable, table, f"constraints.{i}") for i, table in enumerate(raw, 1))


def _check_complete(raw: Mapping[str, Any]) -> None:
    """Refuse a file that lacks keys: all of them at once. Raises `InputError`."""
    missing = [key for key in _REQUIRED if key not in raw]
    kinds = _TABLES | {"renderer": _RendererTable}
    missing += (key for name, kind in kinds.items() if name in raw for key in missing_keys(kind, raw[name], name))
    for name, table in check_table(raw.get("parameters", {}), "parameters").items():
        missing += missing_keys(_kind_of(table), _of_one_kind(table, f"parameters.{name}"), f"parameters.{name}")
    rule = raw.get("aggregation", {}).get("rule", "bcm")  # one that is none is refused with its value
    stated = {"theta" if key == "length" else key for key in raw.get("gp", {})}
    fixed = rule not in _LEARN and rule in get_args(Rule)
    unstated = [f"gp.{key}" for key in _LEARNT if fixed and key not in stated]
    hint = f'; rule = "{_LEARN[-1]}" in [aggregation] learns what [gp] does not state' if unstated else ""
    check_present([*missing, *unstated], hint)


def _kind_of(table: Any) -> type[_ParameterTable | _LevelsTable]:
    """The schema of a parameter: of numbers, or of levels."""
    return _LevelsTable if isinstance(table, Mapping) and "levels" in table else _ParameterTable


def _of_one_kind(table: Any, path: str) -> Any:
    """The parsed table of a parameter. Raises `InputError` for levels beside what only numbers have."""
    if _kind_of(table) is _LevelsTable:
        beside = next((key for key in table if key in _NUMBERS_KEYS), None)
        if beside is not None:
            raise InputError(f"{path}.{beside} stands beside levels, which have no order and no unit; leave it out.")
    elif isinstance(table, Mapping) and "correlation" in table:
        raise InputError(f"{path}.correlation is of levels, and there are none; leave it out, or give levels.")
    return table


def _with_theta(table: GPTable, parameters: Collection[_ParameterTable | _LevelsTable]) -> GPTable:
    """The same model with its lengths as theta: how they are written is not part of a study's hash. Levels have none,
    but a correlation."""
    dim = sum(isinstance(p, _ParameterTable) for p in parameters)
    for name, values in (("theta", table.theta), ("length", table.length)):
        if isinstance(values, tuple) and len(values) != dim:
            count, which = len(values), "" if dim == len(parameters) else " without levels"
            raise InputError(
                f"gp.{name} has {count} numbers; it must be one number or {dim}, one per parameter{which}."
            )
    if table.length is None:
        return table
    if table.theta is not None:
        raise InputError(
            "gp.length stands beside theta, which says the same (theta = 1/(2 length^2)); keep one of them."
        )
    each = table.length if isinstance(table.length, tuple) else (table.length,)
    theta = tuple(1 / (2 * length**2) for length in each)
    return msgspec.structs.replace(table, theta=theta if isinstance(table.length, tuple) else theta[0], length=None)


def box_of(tables: Tables) -> Box:
    """[parameters] and [renderer]. Raises `InputError`."""
    parameters = tuple(_parameter(name, table) for name, table in tables.parameters.items())
    constraints = tuple(Constraint(tuple(c.terms.items()), c.least, c.most) for c in tables.constraints)
    if tables.renderer is None:
        return Box(parameters, None, constraints)
    for p in parameters:
        unit = p.unit.replace("·", ".").replace("α", "alpha")
        if p.name in _UNITS and unit not in ("", _UNITS[p.name]):
            raise InputError(
                f'parameters.{p.name}.unit is "{p.unit}"; it must be "{_UNITS[p.name]}" where there is a [renderer].'
            )
    renderer = msgspec.structs.asdict(tables.renderer)
    del renderer["model"]
    return Box(parameters, Mechanics(**renderer), constraints)


def _parameter(name: str, table: _ParameterTable | _LevelsTable) -> Parameter:
    if isinstance(table, _LevelsTable):
        return Parameter.of_levels(name, table.levels, table.correlation)
    return Parameter(name, **msgspec.structs.asdict(table))


def check_together(tables: Tables, parameters: Sequence[Parameter]) -> None:
    """Refuse tables that do not fit each other, or the parameters. Raises `InputError`."""
    labels, selection = tables.study.responses, tables.selection
    if len(set(labels)) < len(labels):
        raise InputError(f"study.responses is {shown(labels)}; it must not have one label twice.")
    if selection.space_filling > selection.trials:
        raise InputError(
            f"selection.space_filling is {selection.space_filling}; it must be at most trials = {selection.trials}."
        )
    rendered = tables.renderer is not None
    reserved = next((p.name for p in parameters if is_reserved(p.name, labels, rendered)), None)
    if reserved is not None:
        raise InputError(
            f"parameters.{reserved}: tables have a column {reserved} already; call the parameter otherwise, for example"
            f" {reserved}_1."
        )
    tables.session.check(labels)
    if tables.stimulus is not None:
        tables.stimulus.check(parameters)
        if tables.renderer is not None:
            raise InputError("stimulus stands beside renderer, a study has one: a program presents, or a device.")
    if tables.simulation is not None:
        tables.simulation.check(parameters, len(labels))
    _check_gp(tables.gp, tables.aggregation.rule, len(labels))
    column = "" if tables.random_effect is None else tables.random_effect.column
    if column in TRIAL_COLUMNS or column in {p.name for p in parameters} or column.startswith("_"):
        raise InputError(
            f'random_effect.column is "{column}", which has a meaning of its own; name another column of the'
            " answers' table, such as the clip or the day."
        )


def _check_gp(table: GPTable, rule: Rule, count: int) -> None:
    """For `count` responses."""
    thresholds = table.thresholds
    if thresholds is not None:
        if len(thresholds) != count - 1:
            raise InputError(
                f"gp.thresholds is {shown(thresholds)}; it must have one number fewer than the {count} responses."
            )
        if any(low >= high for low, high in itertools.pairwise(thresholds)):
            raise InputError(f"gp.thresholds is {shown(thresholds)}; it must rise from each number to the next.")
    if rule in _LEARN and table.inference != "laplace":
        raise InputError(f'gp.inference is {shown(table.inference)}; it must be "laplace" with rule = "{rule}".')


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
