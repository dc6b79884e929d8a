"""Does the optimum stay if the hyperparameters are optimised? By criterion, on simulated studies of many populations.

    python benchmarks/robustness.py FILE [--studies 10] [--first 1000] [--pooled]
    python benchmarks/robustness.py FILE --write

FILE (JSON Lines) collects a row for each study; a run that was stopped goes on where it was. What has been run is in
benchmarks/robustness.jsonl. All criteria have the same answers, of 24 people with 25 trials each; weak priors about the
paper's hyperparameters. The criterion of committees was chosen on the presets paper-01, paper-04, ... paper-28, seeds 0
to 5; what is reported is of paper-02, paper-05, ... paper-29, seeds from 1000. --pooled: also the evidence of one model
of all answers, which takes a minute a study. --write puts the table into docs/methods/aggregation.md.
"""

import argparse
import os
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax

jax.config.update("jax_enable_x64", True)

import dataclasses  # noqa: E402

import numpy as np  # noqa: E402
from pages import put  # noqa: E402
from populations import chance_at, cohort_from, highest, rounded  # noqa: E402
from populations_people import Places  # noqa: E402
from rows import Rows  # noqa: E402

from hilbo.hyperparameters.judged_evidence import maximise_judged  # noqa: E402
from hilbo.search.apart import nrmse  # noqa: E402
from hilbo.search.candidates import search_points  # noqa: E402
from hilbo.simulation.simulate import simulate_study  # noqa: E402
from hilbo.study.estimate.aggregate import aggregate_cohort  # noqa: E402
from hilbo.study.estimate.learnt import that_learns  # noqa: E402
from hilbo.study.robustness.optimised import LEARNABLE, fixed_and_optimised  # noqa: E402

POPULATIONS = [f"paper-{i:02d}" for i in range(2, 30, 3)]
PEOPLE, FIRST, LIMIT = 24, 1000, 0.03
FIXED = "fixed hyperparameters"
CRITERIA = {
    FIXED: ("bcm", ""),
    "individual": ("bcm", "individual evidences, summed"),
    "left out": ("bcm", "evidence of participants left out"),
    "one model, bcm": ("bcm", "evidence of one model of all responses"),
    FIXED + ", pooled": ("pooled", ""),
    "one model, pooled": ("pooled", "evidence of one model of all responses"),
    FIXED + ", learnt-2": ("learnt-2", ""),
    "learnt-2": ("learnt-2", "its own evidence"),
}


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("file", type=Path)
    options.add_argument("--studies", type=int, default=10)
    options.add_argument("--first", type=int, default=FIRST)
    options.add_argument("--pooled", action="store_true")
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    rows = Rows(chosen.file)
    if chosen.write:
        put("methods/aggregation.md", "robustness", table(rows.rows))
        return
    known = {(row["population"], row["seed"], row["pooled"]) for row in rows}
    for seed in range(chosen.first, chosen.first + chosen.studies):
        for name in POPULATIONS:
            if (name, seed, chosen.pooled) not in known:
                row = {"population": name, "seed": seed, "pooled": chosen.pooled}
                rows.add(rounded(row | {"by": one_study(name, seed, chosen.pooled)}))
                print(name, seed, {k: (v["regret"], v["moved"]) for k, v in rows.rows[-1]["by"].items()}, flush=True)


def one_study(name, seed, pooled):
    """By criterion: regret of the optimum, its distance from the fixed one, and the answers that are promised there."""
    population = Places(preset=name)
    study = population.study
    scene = population.scene(study, PEOPLE, seed)
    cohort = cohort_from(simulate_study(study, scene.persons, seed))
    candidates = search_points(study.space, seed)
    top = float(chance_at(scene.chance, highest(study, scene.chance, candidates)[None, :])[0])

    def said(of, fixed=None):
        optimum = aggregate_cohort(of, cohort, seed, alternatives=False, individuals=False).optimum
        chances = np.asarray(optimum.class_probabilities)
        return {
            "x": np.asarray(optimum.x).tolist(),
            "regret": top - float(chance_at(scene.chance, optimum.x[None, :])[0]),
            "moved": 0.0 if fixed is None else float(nrmse(optimum.x, np.array(fixed["x"]))),
            "said": float(chances[-1]),
            "likeliest": bool(np.argmax(chances) == len(chances) - 1),
        }

    def both(of, key):
        compared = fixed_and_optimised(of, cohort)
        fixed = said(compared.fixed)
        return {FIXED + (f", {of.rule}" if of.rule != "bcm" else ""): fixed, key: said(compared.optimised, fixed)}

    if pooled:
        as_one = dataclasses.replace(study, rule="pooled")
        compared = fixed_and_optimised(as_one, cohort)
        fixed = said(compared.fixed)
        by = {FIXED + ", pooled": fixed, "one model, pooled": said(compared.optimised, fixed)}
        committee = dataclasses.replace(study, gp=compared.optimised.gp)
        of_committee = said(study)
        return by | {FIXED: of_committee, "one model, bcm": said(committee, of_committee)}
    by = both(study, "left out")
    gp = maximise_judged(study.gp, cohort.trials, LEARNABLE).maximum.gp
    by["individual"] = said(dataclasses.replace(study, gp=gp), by[FIXED])
    return by | both(that_learns(study), "learnt-2")


def table(rows):
    lines = [
        "| rule | hyperparameters maximise | studies | optimum moves, median (quartiles) | below 3 % | regret |"
        """ minus the fixed one's | "close" most probable there |""",
        "|---|---|---:|---:|---:|---:|---:|---:|",
    ]
    for key, (rule, criterion) in CRITERIA.items():
        of = [row["by"] for row in rows if key in row["by"] and (key != FIXED or not row["pooled"])]
        if of:
            fixed = FIXED if rule == "bcm" else f"{FIXED}, {rule}"
            lines.append("| " + " | ".join(cells(of, key, fixed, rule, criterion)) + " |")
    return "\n".join(lines)


def cells(of, key, fixed, rule, criterion):
    regret, moved = (np.array([by[key][what] for by in of]) for what in ("regret", "moved"))
    likeliest = sum(by[key]["likeliest"] for by in of)
    head = [rule, criterion or "– (fixed)", str(len(of))]
    tail = f"{100 * likeliest / len(of):.0f} %"
    if not criterion:
        return [*head, "–", "–", with_error(regret), "–", tail]
    low, middle, high = 100 * np.percentile(moved, [25, 50, 75])
    share = f"{100 * np.mean(moved < LIMIT):.0f} %"
    pairs = [(by[key]["regret"], by[fixed]["regret"]) for by in of if fixed in by]
    less = with_error(np.array([a - b for a, b in pairs]), "+") if pairs else ""
    return [*head, f"{middle:.1f} % ({low:.1f} to {high:.1f})", share, with_error(regret), less, tail]


def with_error(values, sign=""):
    return f"{values.mean():{sign}.3f} ± {values.std(ddof=1) / np.sqrt(len(values)):.3f}"


if __name__ == "__main__":
    main()
