"""Coverage of the intervals of `hilbo robustness --pilot`, and regret of studies with its hyperparameters; simulated.

    python benchmarks/pilot.py FILE [--studies 40] [--first 1000]
    python benchmarks/pilot.py FILE --write

FILE (JSON Lines) collects a row for each pilot; a run that was stopped goes on where it was. What has been run is in
benchmarks/pilot.jsonl. The reference is the estimate from 64 people of the same population with 25 trials each; pilots
have 4 or 8 people. After a pilot of 8, 24 other people have 25 trials each, chosen and aggregated by bcm with the
pilot's hyperparameters, and again with the paper's, and by learnt-2. Populations paper-02, paper-05, ... paper-29 in
turn, seeds from 1000. --write puts the tables into docs/methods/aggregation.md.
"""

import argparse
import dataclasses
import os
from functools import cache
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402
from pages import put  # noqa: E402
from populations import chance_at, cohort_from, ends, highest, lined, rounded  # noqa: E402
from populations_people import Places  # noqa: E402
from robustness import FIRST, PEOPLE, POPULATIONS  # noqa: E402
from rows import Rows  # noqa: E402

from hilbo.search.candidates import search_points  # noqa: E402
from hilbo.simulation.simulate import simulate_study  # noqa: E402
from hilbo.study.estimate.aggregate import aggregate_cohort  # noqa: E402
from hilbo.study.estimate.learnt import that_learns  # noqa: E402
from hilbo.study.robustness.optimised import LEARNABLE, fixed_and_optimised  # noqa: E402
from hilbo.study.robustness.pilot import pilot  # noqa: E402

MANY, COUNTS = 64, (4, 8)
OTHERS = 50_000  # between the seeds of a pilot's people and of the study's
VALUES = ("theta", "noise", "first threshold", "second threshold")


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("file", type=Path)
    options.add_argument("--studies", type=int, default=40)
    options.add_argument("--first", type=int, default=FIRST)
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    rows = Rows(chosen.file)
    if chosen.write:
        put("methods/aggregation.md", "pilot", table(rows.rows))
        return
    known = {(row["seed"], row["people"]) for row in rows}
    for seed in range(chosen.first, chosen.first + chosen.studies):
        for count in COUNTS:
            if (seed, count) not in known:
                name = POPULATIONS[seed % len(POPULATIONS)]
                rows.add(rounded({"population": name, "seed": seed, "people": count} | one_pilot(name, seed, count)))
                print(rows.rows[-1], flush=True)


def estimated(name, seed, count):
    """A population's study, a cohort of `count` participants, and their optimised hyperparameters."""
    population = Places(preset=name)
    study = population.study
    cohort = cohort_from(simulate_study(study, population.scene(study, count, seed).persons, seed))
    return study, cohort, fixed_and_optimised(study, cohort)


def values(gp):
    """The hyperparameters of a model, in the order of `VALUES`."""
    return [float(gp.kernel.theta), float(gp.likelihood.noise), *np.asarray(gp.likelihood.thresholds).tolist()]


@cache
def of_many(name):
    """The hyperparameters that many people of a population give."""
    return values(estimated(name, 0, MANY)[2].optimised.gp)


def one_pilot(name, seed, count):
    """Estimates of one pilot with their intervals, and the reference."""
    study, cohort, both = estimated(name, seed, count)
    result = pilot(study, cohort, both)
    intervals = np.concatenate([result.intervals[field] for field in ("theta", "noise", "thresholds")])
    assert tuple(result.intervals) == LEARNABLE
    row = {
        "estimates": values(both.optimised.gp),
        "intervals": intervals.tolist(),
        "reference": of_many(name),
        "unfinished": len(result.unfinished),
    }
    return row | ({"regret": regrets(name, seed, both.optimised.gp)} if count == COUNTS[-1] else {})


def regrets(name, seed, gp):
    """How much less often a new person gives the highest answer at the optimum of a study of other people than at the
    best rendering: by bcm with the hyperparameters of a pilot, with the paper's, and by learnt-2."""
    population = Places(preset=name)
    of = {"paper": population.study, "pilot": dataclasses.replace(population.study, gp=gp)}
    of["learnt-2"] = that_learns(population.study, "learnt-2")
    scene = population.scene(population.study, PEOPLE, seed + OTHERS)
    candidates = search_points(population.study.space, seed)
    top = float(chance_at(scene.chance, highest(population.study, scene.chance, candidates)[None, :])[0])
    found = {}
    for way, study in of.items():
        cohort = cohort_from(simulate_study(study, scene.persons, seed))
        optimum = aggregate_cohort(study, cohort, seed, alternatives=False, individuals=False).optimum
        found[way] = top - float(chance_at(scene.chance, optimum.x[None, :])[0])
    return found


def table(rows):
    """Bias, coverage and width of the intervals of each hyperparameter; and the regrets of studies that use them."""
    lines = []
    for count in COUNTS:
        those = [row for row in rows if row["people"] == count]
        low, high = np.moveaxis(np.array([row["intervals"] for row in those]), 2, 0)
        truth, found = (np.array([row[name] for row in those]) for name in ("reference", "estimates"))
        held = 100 * np.mean((low <= truth) & (truth <= high), axis=0)
        ratios = np.median(found[:, :2] / truth[:, :2], axis=0)
        off = [f"× {ratio:.2f}" for ratio in ratios]
        off += [f"{by:+.2f}" for by in np.median(found[:, 2:] - truth[:, 2:], axis=0)]
        reach = [f"×/÷ {factor:.2g}" for factor in np.median(np.sqrt(high[:, :2] / low[:, :2]), axis=0)]
        reach += [f"± {width:.2g}" for width in np.median((high - low)[:, 2:] / 2, axis=0)]
        for name, *cells in zip(VALUES, off, (f"{h:.0f} %" for h in held), reach, strict=True):
            lines.append([name, str(count), str(len(those)), *cells])
    regret = {way: np.array([row["regret"][way] for row in those]) for way in ("paper", "pilot", "learnt-2")}
    seeds = np.array([row["seed"] for row in those])
    cells = [f"{value.mean():.3f}" for value in regret.values()]
    cells += [ends(regret[way] - regret["paper"], seeds) for way in ("pilot", "learnt-2")]
    heads = ["studies", "bcm, paper", "bcm, pilot", "learnt-2", "pilot minus paper", "learnt-2 minus paper"]
    found = lined(heads, [[str(len(those)), *cells]])
    heads = ["hyperparameter", "participants", "pilots", "median bias", "coverage", "median half-width"]
    return lined(heads, lines) + "\n\n" + found


if __name__ == "__main__":
    main()
