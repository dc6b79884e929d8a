"""Calibration of the probability that a new participant gives the highest answer, in simulated studies.

    python benchmarks/highest_answer.py FILE [--studies 10] [--first 1000] [--only NAME] [--design 24x25]
    python benchmarks/highest_answer.py FILE --write

FILE (JSON Lines) collects a row for each study; a run that was stopped goes on where it was. What has been run is in
benchmarks/highest_answer.jsonl. All methods have the same responses. learnt-3 was chosen on the presets
paper-01, paper-04, ... paper-28, seeds 0 to 2; reported are paper-02, paper-05, ... paper-29 and the other populations,
seeds from 1000. --write puts the table into docs/methods/which_method_tables.md.
"""

import argparse
import os
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402
from pages import put  # noqa: E402
from populations import chance_at, cohort_from, highest, rounded, with_trials  # noqa: E402
from populations_people import POPULATIONS, Places  # noqa: E402
from rows import Rows  # noqa: E402

from hilbo.population.maps import learnt_map, rule_map  # noqa: E402
from hilbo.population.rules.registry import RULES  # noqa: E402
from hilbo.search.candidates import search_points  # noqa: E402
from hilbo.simulation.simulate import simulate_study  # noqa: E402
from hilbo.study.analysis.highest_answer import with_interval  # noqa: E402
from hilbo.study.analysis.region import hyperparameter_draws  # noqa: E402
from hilbo.study.estimate.learnt import resolved, that_learns  # noqa: E402
from hilbo.study.estimate.optimum import map_optimum  # noqa: E402

BY = ("bcm", "hierarchical", "learnt-2", "learnt-3")
PAPER = {f"paper-{i:02d}": Places(preset=f"paper-{i:02d}") for i in range(2, 30, 3)}
OTHERS = [name for name in POPULATIONS if not name.startswith("paper-") or "individuals" in name]


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("file", type=Path)
    options.add_argument("--studies", type=int, default=10)
    options.add_argument("--first", type=int, default=1000)
    options.add_argument("--only", nargs="+")
    options.add_argument("--design", default="24x25")
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    rows = Rows(chosen.file)
    if chosen.write:
        put("methods/which_method_tables.md", "highest answer", "\n".join(table(rows.rows)))
        return
    known = {(row["population"], row["design"], row["seed"]) for row in rows}
    for seed in range(chosen.first, chosen.first + chosen.studies):
        for name in chosen.only or [*PAPER, *OTHERS]:
            if (name, chosen.design, seed) not in known:
                row = {"population": name, "design": chosen.design, "seed": seed}
                rows.add(rounded(row | {"by": one_study(name, chosen.design, seed)}))
                by = rows.rows[-1]["by"].items()
                print(
                    name, seed, {k: [v["regret"], v["predicted"] - v["true"], v.get("low")] for k, v in by}, flush=True
                )


def one_study(name, design, seed):
    """By method: regret, and predicted and true probability of the highest response at the optimum and elsewhere."""
    population = POPULATIONS[name] if name in POPULATIONS else PAPER[name]
    people, trials = map(int, design.split("x"))
    study = with_trials(population.study, trials)
    scene = population.scene(study, people, seed)
    answers = simulate_study(study, scene.persons, seed)
    cohort = cohort_from(answers)
    candidates = search_points(study.space, seed)
    best = float(chance_at(scene.chance, highest(study, scene.chance, candidates)[None, :])[0])
    tested = answers.x.reshape(-1, answers.x.shape[-1])[:: max(1, answers.x[..., 0].size // 64)][:64]
    untested = candidates[-64:]
    return {rule: by_rule(study, cohort, rule, candidates, scene.chance, best, (tested, untested), seed) for rule in BY}


def by_rule(study, cohort, rule, candidates, chance, best, places, seed):
    if RULES[rule].learns:
        study = resolved(that_learns(study, rule), cohort)
        map_ = learnt_map(study.learnt, cohort.trials)
    else:
        map_ = rule_map(study.gp, cohort.trials, rule)
    likelihood = study.gp.likelihood
    optimum = map_optimum(study, map_, candidates).x

    def said(x):
        return np.asarray(map_.class_probabilities(likelihood, x))[:, -1]

    true = float(chance_at(chance, optimum[None, :])[0])
    row = {"regret": best - true, "predicted": float(said(optimum[None, :])[0]), "true": true}
    if RULES[rule].learns:
        drawn = hyperparameter_draws(study, cohort.trials, seed)
        highest = with_interval(study.gp.likelihood, study.goal, map_, optimum, drawn)
        row |= {"low": highest.low, "high": highest.high}
    for where, x in zip(("tested", "untested"), places, strict=True):
        gap = said(x) - np.asarray(chance_at(chance, x))
        row |= {f"{where} bias": float(gap.mean()), f"{where} error": float(np.abs(gap).mean())}
    if RULES[rule].learns:
        learnt = study.learnt
        row |= {
            "spread": float(np.exp(learnt.coordinates.get("spread", -np.inf))),
            "widths": "widths" in learnt.coordinates,
        }
        row |= {f"gain of {name}": float(gain) for name, gain in learnt.gains.items()}
        row |= {"converged": bool(learnt.converged)}
        row |= {"log evidence": float(learnt.log_evidence)}
    return row


def table(rows):
    """Lines of the table: by group of populations and rule."""
    head = "populations", "rule", "studies", "bias at the optimum", "coverage of 95 % intervals"
    yield f"| {' | '.join(head)} | bias at tested, untested points | regret | regret minus learnt-2's |"
    yield "|---|---|---:|---:|---:|---:|---:|---:|"
    groups = {
        "`paper-02`, `paper-05`, … `paper-29`": lambda name: name in PAPER,
        "participants with individual optima": lambda name: name in OTHERS and "functions" not in name,
        "functions drawn": lambda name: "functions" in name,
    }
    for words, is_of in groups.items():
        of = [row["by"] for row in rows if is_of(row["population"])]
        for rule in BY if of else ():
            said = cells([by[rule] for by in of], [by["learnt-2"] for by in of])
            yield f"| {words} | {rule} | {len(of)} | {' | '.join(said)} |"
            words = ""


def cells(said, others):
    """Cells of a row of the table: `said` by a rule in each study, `others` by learnt-2."""
    bias = [each["predicted"] - each["true"] for each in said]
    yield f"{mean_and_error(bias)}"
    held = [each["low"] <= each["true"] <= each["high"] for each in said if "low" in each]
    yield f"{100 * np.mean(held):.0f} %" if len(held) == len(said) else "–"
    yield " ".join(f"{np.mean([each[f'{where} bias'] for each in said]):+.3f}" for where in ("tested", "untested"))
    regret = np.array([each["regret"] for each in said])
    yield mean_and_error(regret, sign="")
    less = regret - np.array([each["regret"] for each in others])
    yield mean_and_error(less) if np.any(less) else ""


def mean_and_error(values, sign="+"):
    """Mean and its standard error."""
    return f"{np.mean(values):{sign}.3f} ± {np.std(values, ddof=1) / np.sqrt(len(values)):.3f}"


if __name__ == "__main__":
    main()
