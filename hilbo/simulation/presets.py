"""Named populations, from hilbo/data/populations.toml; docs/methods/simulation.md describes how they were made.

`paper-01` to `paper-30` agree with the paper's individuals and with its validation as well as possible; `paper` is the
one of them nearest to their mean. `paper-individuals` agrees with the individuals alone.
"""

import dataclasses
import tomllib
from importlib.resources import files
from typing import Any

import numpy as np

from hilbo.errors import InputError
from hilbo.likelihoods import Goal
from hilbo.search.equality import unbalanced
from hilbo.search.rendering import Rendering
from hilbo.simulation.simulate import Population
from hilbo.study.config import Study
from hilbo.study.file.simulated_people import SimulationTable, each

__all__ = ["PRESETS", "population_of", "preset_of", "with_truth"]

_STEP = 1.5  # from one criterion to the next, in tolerances, where a study states none


def _read() -> dict[str, Population]:
    """Read hilbo/data/populations.toml: name -> population, with "paper" as a second name of one of them."""
    content = tomllib.loads((files("hilbo") / "data" / "populations.toml").read_text(encoding="utf-8"))
    populations = {name: _population(table) for name, table in content["populations"].items()}
    return {"paper": populations[content["paper"]]} | populations


def _population(table: dict[str, Any]) -> Population:
    """Population of one table of the file."""
    values: dict[str, Any] = {key: tuple(v) if isinstance(v, list) else v for key, v in table.items()}
    return Population(**values)


PRESETS: dict[str, Population] = _read()


def preset_of(name: str) -> Population:
    """Population with this name. Raises InputError, which lists the names, if there is none."""
    if name not in PRESETS:
        raise InputError(f'--preset is "{name}"; there are {", ".join(PRESETS)}.')
    return PRESETS[name]


def population_of(study: Study, preset: str | None = None) -> tuple[str, Population]:
    """Label and population of a study's simulated participants.

    The population is the preset if one is given, else the study's [simulation], else `paper` if it fits the study, else
    the defaults of [simulation]. Its truth may be missing: see `with_truth`. Raises `InputError` for an unknown preset,
    and for one with other parameters.
    """
    paper = PRESETS["paper"]
    fits = study.goal.is_highest and _of_these_ranges(study, paper) and len(study.responses) == 1 + len(paper.criteria)
    if preset is None and not (study.file.simulation is None and fits):
        stated = study.file.simulation
        words = "the study's [simulation]" if stated else "people of no preset, with the defaults of [simulation]"
        return words, _stated(study, stated or SimulationTable())
    name = preset or "paper"
    if not study.goal.is_highest:
        raise InputError(
            f'--preset is "{name}", whose people search for the highest answer, and the goal of this study is'
            f' "{study.file.goal}"; leave --preset out.'
        )
    population = preset_of(name)
    if not _of_these_ranges(study, population):
        truth = ", ".join(f"{key} = {value:g}" for key, value in population.truth.items())
        ranges = ", ".join(
            f"{p.name} of levels" if p.levels else f"{p.name} from {p.low:g} to {p.high:g}"
            for p in study.space.parameters
        )
        raise InputError(
            f'--preset is "{name}", whose people like {truth}, and the study has {ranges}; leave --preset out, and'
            " state [simulation] in the study file."
        )
    return name, population


def _of_these_ranges(study: Study, population: Population) -> bool:
    """Whether the population's truth names exactly the study's parameters and lies within their ranges."""
    parameters, truth = study.space.parameters, population.truth
    return {p.name for p in parameters} == set(truth) and all(p.low <= truth[p.name] <= p.high for p in parameters)


def _stated(study: Study, table: SimulationTable) -> Population:
    """Population specified in a [simulation] table; its truth is {} if the table has none. Raises `InputError` for a
    truth that violates an equality of the study."""
    dim = study.space.dim
    for constraint in (c for c in study.space.constraints if c.equality and table.truth):
        (total,), (wrong,) = unbalanced(constraint, {k: np.array([v]) for k, v in table.truth.items()}, np.zeros(1))
        if wrong:
            raise InputError(
                f"simulation.truth: {constraint.sum_words} is {total:g}; it must be {constraint.least:g} in this study."
            )
    return Population(
        truth={p.name: p.number(table.truth[p.name]) for p in study.space.parameters} if table.truth else {},
        spread=each(table.spread, dim),
        tolerance=each(table.tolerance, dim),
        tolerance_sd=table.tolerance_sd,
        criteria=table.criteria or _criteria(study.goal),
        noise=table.noise,
        lapse=table.lapse,
        drift_sd=table.drift_sd,
    )


def _criteria(goal: Goal) -> tuple[float, ...]:
    """Criteria at even steps, of which the innermost are 1 and -1."""
    below, above = range(goal.category), range(goal.categories - 1 - goal.category)
    return (*(1 + _STEP * k for k in reversed(below)), *(-1 - _STEP * k for k in above))


def with_truth(study: Study, population: Population, seed: int) -> Population:
    """The same population if it has a truth; otherwise a copy with one drawn by `seed` from 256 even points of the
    feasible set."""
    if population.truth:
        return population
    points = np.asarray(study.space.to_physical(study.space.candidates(256, 0)))
    drawn = points[np.random.default_rng([seed, 17]).integers(len(points))]
    return dataclasses.replace(population, truth=Rendering.of(study.space, drawn).values)
