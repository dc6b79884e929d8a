"""Simulated study as a folder for `hilbo aggregate` and `hilbo report`: its tables, truth and study file."""

import shutil
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float

from hilbo.simulation import simulate
from hilbo.simulation.presets import population_of, with_truth
from hilbo.simulation.simulate import Population
from hilbo.study.cohort import Cohort, cohort_of
from hilbo.study.config import Study
from hilbo.study.tables.trials import write_trials

__all__ = ["Simulated", "simulate_folder"]

_NEXT = 100_003  # between the seeds of two materials: far more than seeds that a user tries


class Simulated(NamedTuple):
    """Simulated responses to one material (its name; "" if the study has none), and the true optimum of the population,
    (d,) in the unit cube."""

    material: str
    study: Study
    population: Population
    cohort: Cohort
    truth: Float[np.ndarray, " d"]
    trials: pd.DataFrame
    truths: pd.DataFrame
    """As in truth.csv."""


def simulate_folder(
    folder: Path, preset: str | None, count: int, seed: int, source: Path | None = None
) -> tuple[Simulated, ...]:
    """Simulate `count` participants and write trials.csv, truth.csv and study.toml to an existing folder, over existing
    files. Of a study with materials each has `count` separate participants (P01 of one is not P01 of another), and
    the tables have a column `material`.

    `preset`: name of the population, as in `population_of`. `source`: a study file instead of the paper's. Raises
    InputError for an invalid study file, an unknown preset, and a population that does not fit the study.
    """
    path = Path(str(files("hilbo") / "data" / "paper.toml")) if source is None else source
    whole = Study.load(path)
    simulated = [
        _simulated(whole.material(name) if name else whole, name, preset, count, seed + _NEXT * number)
        for number, name in enumerate(whole.file.materials or ("",))
    ]
    write_trials(_together([(each.material, each.trials) for each in simulated]), folder / "trials.csv")
    write_trials(_together([(each.material, each.truths) for each in simulated]), folder / "truth.csv")
    shutil.copyfile(path, folder / "study.toml")
    return tuple(simulated)


def _simulated(study: Study, material: str, preset: str | None, count: int, seed: int) -> Simulated:
    """Simulate the sessions of `count` participants with one material, "" for a study without materials. Raises
    `InputError` for a preset that is unknown or of other parameters."""
    population = with_truth(study, population_of(study, preset)[1], seed)
    people = simulate.people(study, population, count, seed)
    table = simulate.to_table(study, simulate.simulate_study(study, people, seed))
    truth = np.asarray(study.space.to_unit(np.array([population.truth[name] for name in study.space.names])))
    truths = simulate.truth_table(study, population, people)
    return Simulated(material, study, population, cohort_of(table, study), truth, table, truths)


def _together(tables: list[tuple[str, pd.DataFrame]]) -> pd.DataFrame:
    """The tables of all materials as one, with a column `material` if these have names."""
    named = [table.assign(material=name) if name else table for name, table in tables]
    return pd.concat(named, ignore_index=True)
