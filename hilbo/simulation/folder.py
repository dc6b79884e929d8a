"""Simulated study as a folder for `hilbo aggregate` and `hilbo report`: its tables, truth and study file."""

import shutil
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from hilbo.simulation import simulate
from hilbo.simulation.presets import population_of, with_truth
from hilbo.simulation.simulate import Population
from hilbo.study.cohort import Cohort, cohort_of
from hilbo.study.config import Study
from hilbo.study.tables.trials import write_trials

__all__ = ["Simulated", "simulate_folder"]


class Simulated(NamedTuple):
    """Simulated study, its participants' responses, and the true optimum of their population, (d,) in the unit cube."""

    study: Study
    population: Population
    cohort: Cohort
    truth: Float[np.ndarray, " d"]


def simulate_folder(folder: Path, preset: str | None, count: int, seed: int, source: Path | None = None) -> Simulated:
    """Simulate `count` participants and write trials.csv, truth.csv and study.toml to an existing folder, over existing
    files.

    `preset`: name of the population, as in `population_of`. `source`: a study file instead of the paper's. Raises
    InputError for an invalid study file, an unknown preset, and a population that does not fit the study.
    """
    path = Path(str(files("hilbo") / "data" / "paper.toml")) if source is None else source
    study = Study.load(path)
    population = with_truth(study, population_of(study, preset)[1], seed)
    people = simulate.people(study, population, count, seed)
    table = simulate.to_table(study, simulate.simulate_study(study, people, seed))
    write_trials(table, folder / "trials.csv")
    write_trials(simulate.truth_table(study, population, people), folder / "truth.csv")
    shutil.copyfile(path, folder / "study.toml")
    truth = np.asarray(study.space.to_unit(np.array([population.truth[name] for name in study.space.names])))
    return Simulated(study, population, cohort_of(table, study), truth)
