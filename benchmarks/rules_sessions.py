"""Simulated studies for benchmarks/rules.py, made once and kept: people who differ more or less.

    python benchmarks/rules_sessions.py FOLDER [--seeds 100]

A level multiplies what makes people differ in the preset (the spread of their optima, of their tolerances, and their
drift); 0 are people who are all the same, 1 is the preset. One file of FOLDER for each study of 24 people x 25 trials.
"""

import argparse
import dataclasses
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
LEVELS = (0.0, 0.5, 1.0, 2.0)
PEOPLE = 24


def population(level):
    """The preset with `level` times the differences between people."""
    from hilbo.simulation.presets import PRESETS

    preset = PRESETS["paper-individuals"]
    return dataclasses.replace(
        preset,
        spread=tuple(level * s for s in preset.spread),
        tolerance_sd=level * preset.tolerance_sd,
        drift_sd=level * preset.drift_sd,
    )


def path_of(folder, level, seed):
    return Path(folder) / f"level{level:g}_seed{seed:03d}.npz"


def simulate(study, folder, level, seed):
    """Simulate a study, unless it is there already."""
    from hilbo.simulation.simulate import people, simulate_study

    path = path_of(folder, level, seed)
    if path.exists():
        return
    persons = people(study, population(level), PEOPLE, seed)
    trials = simulate_study(study, persons, seed)
    part = path.with_suffix(".part.npz")
    np.savez_compressed(part, x=np.asarray(trials.x), q=np.asarray(trials.q), optimum=np.asarray(persons.optimum))
    part.replace(path)


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("folder", type=Path)
    options.add_argument("--seeds", type=int, default=100)
    chosen = options.parse_args()
    import jax

    jax.config.update("jax_enable_x64", True)
    from hilbo.study.config import Study

    study = Study.load(ROOT / "hilbo" / "data" / "paper.toml")
    chosen.folder.mkdir(parents=True, exist_ok=True)
    for seed in range(chosen.seeds):
        for level in LEVELS:
            simulate(study, chosen.folder, level, seed)


if __name__ == "__main__":
    main()
