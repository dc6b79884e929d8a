"""The tables of a study file: parsed into records, and checks of each and of their combination. Loads no JAX."""

import itertools
import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import msgspec

from hilbo.errors import InputError
from hilbo.population.rules.registry import DEFAULT, GIVEN, RECOMMENDED, RULES, WITHDRAWN
from hilbo.search.box import Box, Constraint, Mechanics, Parameter
from hilbo.study.file.fields import check_keys, check_present, check_table, missing_keys, read_table, shown
from hilbo.study.file.protocols import PHASES
from hilbo.study.file.reserved_names import TRIAL_COLUMNS, is_reserved
from hilbo.study.file.schema import (
    KEY_NUMBERS,
    NO_DELAY,
    TABLES,
    ConstraintTable,
    GPTable,
    LevelsTable,
    ParameterTable,
    RendererTable,
    StudyTable,
    Tables,
)
from hilbo.study.formats.cell_text import check_text

__all__ = ["box_of", "check_together", "of_material", "read"]

_REQUIRED = ("schema", "study", "parameters")
_KEYS = ("schema", "study", "parameters", "renderer", *list(TABLES)[1:], "constraints", "materials")
_LEARNT = ("theta", "variance", "thresholds", "noise")
_OVERRIDES = ("renderer", "parameters", "session", "report")
_PHASES = tuple(phase.replace("-", "_") for phase in PHASES)
_NUMBERS_KEYS = ("low", "high", "unit", "scale", "integer")
_LEVELS_KEYS = ("correlation", "ordered", "at")
_UNITS = {"K1": "N/mm", "B1": "N.s^alpha/mm", "alpha": ""}


def read(raw: Mapping[str, Any]) -> Tables:
    """Convert a parsed study file to records; checks keys and types, and that gp keys are complete for the aggregation
    method. Lengths of [gp] become theta. Raises `InputError`."""
    check_keys(raw, "", _KEYS)
    _check_complete(raw)
    if raw["schema"] is True or raw["schema"] != 1:
        raise InputError(f"schema is {shown(raw['schema'])}; it must be 1: this hilbo reads no other.")
    tables = {key: read_table(kind, raw[key], key) for key, kind in TABLES.items() if key in raw}
    parameters = {
        name: read_table(_kind_of(table), table, f"parameters.{name}") for name, table in raw["parameters"].items()
    }
    if "gp" in tables:
        tables["gp"] = _with_theta(tables["gp"], parameters.values())
    if "renderer" in raw:
        renderer = read_table(RendererTable, raw["renderer"], "renderer")
        if renderer.delay == 0:  # however it is written, the study is the one without the key
            renderer = msgspec.structs.replace(renderer, delay=NO_DELAY)
        tables["renderer"] = renderer
    if "constraints" in raw:
        tables["constraints"] = _constraints(raw["constraints"])
    materials = check_table(raw.get("materials", {}), "materials")
    for name, table in materials.items():
        check_keys(table, f"materials.{name}", _OVERRIDES)
        check_keys(table.get("parameters", {}), f"materials.{name}.parameters", tuple(raw["parameters"]))
        check_keys(table.get("session", {}), f"materials.{name}.session", _PHASES)
        check_keys(table.get("report", {}), f"materials.{name}.report", ("compare_with",))
    return Tables(parameters=parameters, materials=dict(materials), **tables)


def _constraints(raw: Any) -> tuple[ConstraintTable, ...]:
    """Convert [[constraints]], named by their number from 1 in messages. Raises `InputError`."""
    if not isinstance(raw, list):
        raise InputError(f"constraints is {shown(raw)}; it must be tables; write each as [[constraints]].")
    return tuple(read_table(ConstraintTable, table, f"constraints.{i}") for i, table in enumerate(raw, 1))


def _check_complete(raw: Mapping[str, Any]) -> None:
    """Raise `InputError` that lists all missing keys of the file, also those of [gp] that its aggregation method needs;
    also for a withdrawn method, and for unknown keys."""
    missing = [key for key in _REQUIRED if key not in raw]
    kinds = TABLES | {"renderer": RendererTable}
    missing += (key for name, kind in kinds.items() if name in raw for key in missing_keys(kind, raw[name], name))
    for name, table in check_table(raw.get("parameters", {}), "parameters").items():
        missing += missing_keys(_kind_of(table), _of_one_kind(table, f"parameters.{name}"), f"parameters.{name}")
    rule = raw.get("aggregation", {}).get("rule", DEFAULT)  # one that is none is refused with its value
    if isinstance(rule, str) and rule in WITHDRAWN:
        raise InputError(f"aggregation.rule is {WITHDRAWN[rule]}")
    stated = {"theta" if key == "length" else key for key in raw.get("gp", {})}
    fixed = isinstance(rule, str) and rule in GIVEN
    unstated = [f"gp.{key}" for key in _LEARNT if fixed and key not in stated]
    hint = f'; rule = "{RECOMMENDED}" in [aggregation] learns what [gp] does not state' if unstated else ""
    check_present([*missing, *unstated], hint)


def _kind_of(table: Any) -> type[ParameterTable | LevelsTable]:
    """Record type of a parameter's table: `LevelsTable` if it has the key "levels", otherwise `ParameterTable`."""
    return LevelsTable if isinstance(table, Mapping) and "levels" in table else ParameterTable


def _of_one_kind(table: Any, path: str) -> Any:
    """Return a parameter's parsed table unchanged. Raises `InputError` if it combines levels with keys of numbers, has
    keys of levels without levels, or those of one order with those of the other."""
    if _kind_of(table) is LevelsTable:
        beside, ordered = next((key for key in table if key in _NUMBERS_KEYS), None), table.get("ordered") is True
        if beside is not None:
            lack = "no numbers and no unit" if ordered else "no order and no unit"
            raise InputError(f"{path}.{beside} is not used with levels, which have {lack}; leave it out.")
        if "correlation" in table and ordered:
            raise InputError(f"{path}.correlation is of unordered levels; leave it out, ordered ones have a length.")
        stray = next((key for key in ("at", "natural_ends") if table.get(key)), None)
        if stray is not None and not ordered:
            raise InputError(f"{path}.{stray} is of ordered levels; add ordered = true, or leave it out.")
        return table
    stray = next((key for key in _LEVELS_KEYS if isinstance(table, Mapping) and key in table), None)
    if stray is not None:
        raise InputError(f"{path}.{stray} is of levels, and there are none; leave it out, or give levels.")
    return table


def _with_theta(table: GPTable, parameters: Collection[ParameterTable | LevelsTable]) -> GPTable:
    """The same [gp] with `length` replaced by theta = 1/(2 length^2), so that both notations have one hash. Raises
    `InputError` for both at once, and for lists whose length is not the number of parameters that have a length."""
    ordered = sum(isinstance(p, LevelsTable) and p.ordered for p in parameters)
    dim = ordered + sum(isinstance(p, ParameterTable) for p in parameters)
    for name, values in (("theta", table.theta), ("length", table.length)):
        if isinstance(values, tuple) and len(values) != dim:
            count, which = (
                len(values),
                "" if dim == len(parameters) else f" without {'unordered ' if ordered else ''}levels",
            )
            raise InputError(
                f"gp.{name} has {count} numbers; it must be one number or {dim}, one per parameter{which}."
            )
    if table.length is None:
        return table
    if table.theta is not None:
        raise InputError("gp.length and theta are equivalent (theta = 1/(2 length^2)); keep one of them.")
    each = table.length if isinstance(table.length, tuple) else (table.length,)
    theta = tuple(1 / (2 * length**2) for length in each)
    return msgspec.structs.replace(table, theta=theta if isinstance(table.length, tuple) else theta[0], length=None)


def box_of(tables: Tables) -> Box:
    """Search space of [parameters], [[constraints]] and [renderer]. Raises `InputError`."""
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


def _parameter(name: str, table: ParameterTable | LevelsTable) -> Parameter:
    """The parameter of one table of [parameters]. Raises `InputError` for an invalid range, scale or levels."""
    if isinstance(table, LevelsTable):
        fields = msgspec.structs.asdict(table)
        return Parameter.of_levels(name, **fields)
    return Parameter(name, **msgspec.structs.asdict(table))


def check_together(tables: Tables, parameters: Sequence[Parameter]) -> None:
    """Raise `InputError` for tables that contradict each other or the parameters: responses, selection, reserved names,
    session, stimulus, simulation, [gp] and random effect."""
    labels, selection = tables.study.responses, tables.selection
    _check_labels(tables.study)
    goal = tables.study.goal
    if goal in labels[1:-1] and selection.acquisition == "log_ei":
        raise InputError(
            'selection.acquisition is "log_ei", which has no form for a goal between other responses; use "ucb".'
        )
    if selection.space_filling > selection.trials:
        raise InputError(
            f"selection.space_filling is {selection.space_filling}; it must be at most trials = {selection.trials}."
        )
    unknown = [name for name in tables.plan.people if name not in tables.materials]
    if unknown:
        listed = ", ".join(tables.materials) or "there are none"
        raise InputError(f"plan.people.{unknown[0]} is of no material of the study, its materials: {listed}.")
    check_keys(tables.report.compare_with, "report.compare_with", KEY_NUMBERS)
    for name, value in tables.report.compare_with.items():
        check_text(str(value), name, "report.compare_with")
        if isinstance(value, float) and not math.isfinite(value):
            raise InputError(f"report.compare_with.{name} is {value}; it must be a finite number or a text.")
    rendered = tables.renderer is not None
    reserved = next((p.name for p in parameters if is_reserved(p.name, labels, rendered)), None)
    if reserved is not None:
        raise InputError(
            f"parameters.{reserved}: tables have a column {reserved} already; call the parameter otherwise, for example"
            f" {reserved}_1."
        )
    tables.session.check(labels)
    if tables.stimulus is not None:
        if tables.renderer is not None and tables.stimulus.by == "person":
            raise InputError(
                'stimulus.by is "person" with a renderer; a person cannot render a force by hand: leave one out.'
            )
        tables.stimulus.check(parameters)
    if tables.simulation is not None:
        tables.simulation.check(parameters, len(labels), labels.index(goal) if goal else len(labels) - 1)
    _check_gp(tables.gp, tables.aggregation.rule, len(labels))
    column = "" if tables.random_effect is None else tables.random_effect.column
    if column in TRIAL_COLUMNS or column in {p.name for p in parameters} or column.startswith("_"):
        raise InputError(
            f'random_effect.column is "{column}", which has a fixed meaning; name another column of the'
            " answers' table, such as the clip or the day."
        )


def _check_labels(study: StudyTable) -> None:
    """Raise `InputError` for two responses that are the same, or differ in capitals or blanks only, for a missing
    response that is one, and for a goal that is none."""
    labels = study.responses
    if len(set(labels)) < len(labels):
        raise InputError(f"study.responses is {shown(labels)}; it must not have one label twice.")
    known: dict[str, str] = {}
    for label in labels:
        other = known.setdefault(label.strip().casefold(), label)
        if other != label:
            pair = f"{shown(other)} and {shown(label)}"
            raise InputError(f"study.responses has {pair}, which differ in capitals or blanks only; rename one.")
    for label in study.missing:
        if label.strip().casefold() in known:
            raise InputError(f"study.missing has {shown(label)}, which is a response too; leave it out of one of them.")
    if study.goal and study.goal not in labels:
        raise InputError(f"study.goal is {shown(study.goal)}; it must be one of the responses, {', '.join(labels)}.")


def _check_gp(table: GPTable, rule: str, count: int) -> None:
    """Raise `InputError` for thresholds that do not rise or do not fit `count` responses, and for a method that learns
    with another inference than "laplace"."""
    thresholds = table.thresholds
    if thresholds is not None:
        if len(thresholds) != count - 1:
            raise InputError(
                f"gp.thresholds is {shown(thresholds)}; it must have one number fewer than the {count} responses."
            )
        if any(low >= high for low, high in itertools.pairwise(thresholds)):
            raise InputError(f"gp.thresholds is {shown(thresholds)}; it must rise from each number to the next.")
    if RULES[rule].learns and table.inference != "laplace":
        raise InputError(f'gp.inference is {shown(table.inference)}; it must be "laplace" with rule = "{rule}".')


def of_material(raw: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Parsed file of one material: its overrides applied, [materials] and [plan] removed. `name` must be in
    [materials]."""
    tables = {key: value for key, value in raw.items() if key not in ("materials", "plan")}
    for table, changes in raw["materials"][name].items():
        tables[table] = _merged(tables.get(table, {}), changes)
    return tables


def _merged(base: Any, changes: Any) -> Any:
    """`base` updated by `changes`, recursively for nested tables; neither is modified."""
    if not (isinstance(base, Mapping) and isinstance(changes, Mapping)):
        return changes
    return {**base, **{key: _merged(base.get(key, {}), value) for key, value in changes.items()}}
