"""How often does the model check name a misfit where there is none? Studies that are drawn from the model itself.

    python benchmarks/model_check_calibrated.py FILE [--people 3 8 24] [--studies 1000] [--rule pooled]
    python benchmarks/model_check_calibrated.py FILE --write

Functions, answers and hyperparameters are those of the rule: one function for all by "pooled", a shared one and
individual ones by "hierarchical" (which learns the share). Each person answers 25 times, seven times at an earlier
point. FILE (JSON Lines) collects the check of each study; a run that was stopped goes on. --write puts the table into
docs/methods/which_method_tables.md; what has been run is in benchmarks/model_check_calibrated.jsonl.
"""

import argparse
import os
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402
from pages import put  # noqa: E402
from rows import Rows  # noqa: E402

from hilbo.ordinal_gp import Trials  # noqa: E402
from hilbo.study.analysis.model_check import check_sentences, model_check  # noqa: E402
from hilbo.study.cohort import Cohort  # noqa: E402
from hilbo.study.config import Study  # noqa: E402
from hilbo.study.estimate.aggregate import aggregate_cohort  # noqa: E402

THETA, NOISE, THRESHOLDS, SHARE = 4.0, 0.5, (-0.5, 0.5), 0.6
TRIALS, PLACES = 25, 18
KEPT = ("shares", "repeats", "negative_log_density")


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("file", type=Path)
    options.add_argument("--people", type=int, nargs="+", default=[3, 8, 24])
    options.add_argument("--studies", type=int, default=1000)
    options.add_argument("--rule", choices=("pooled", "hierarchical"), default="pooled")
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    rows = Rows(chosen.file)
    if chosen.write:
        put("methods/which_method_tables.md", "calibrated check", table(rows.rows))
        return
    known = {(row["rule"], row["people"], row["seed"]) for row in rows}
    for people in chosen.people:
        for seed in range(chosen.studies):
            if (chosen.rule, people, seed) not in known:
                content = one_study(chosen.rule, people, seed)
                rows.add({"rule": chosen.rule, "people": people, "seed": seed} | content)
        print(table(rows.rows), flush=True)


def study_of(rule):
    parameters = {name: {"low": 0.0, "high": 1.0, "unit": ""} for name in ("u", "v")}
    gp = {"theta": THETA, "variance": 1.0, "thresholds": list(THRESHOLDS), "noise": NOISE}
    named = {"name": "drawn", "attribute": "realism", "responses": ["different", "similar", "close"]}
    raw = {"schema": 1, "study": named, "parameters": parameters, "gp": gp, "aggregation": {"rule": rule}}
    return Study.from_dict(raw)


def one_study(rule, people, seed):
    study = study_of(rule)
    x, q = drawn(people, seed, 1.0 if rule == "pooled" else SHARE)
    trials = jax.tree.map(
        lambda *a: np.stack(a), *[Trials.from_arrays(*each, TRIALS) for each in zip(x, q, strict=True)]
    )
    cohort = Cohort(jax.tree.map(jax.numpy.asarray, trials), np.zeros(x.shape), tuple(f"P{j}" for j in range(people)))
    aggregate = aggregate_cohort(study, cohort, alternatives=False, individuals=False)
    content = model_check(study, aggregate)
    return rounded({name: content[name] for name in KEPT})


def rounded(row):
    """Numbers with four digits after the point."""
    if isinstance(row, dict):
        return {name: rounded(value) for name, value in row.items()}
    return round(row, 4) if isinstance(row, float) else row


def content_of(row):
    """What the sentences of a check are made of."""
    return row | {"by_person": dict.fromkeys(range(row["people"])), "hyperparameters": "as stated"}


def drawn(people, seed, share):
    """Points (M, n, 2) and answers (M, n) of people whose functions are drawn; some points come twice."""
    rng = np.random.default_rng([seed, people])
    places = rng.uniform(size=(people, PLACES, 2))
    order = np.stack([rng.permutation(np.r_[:PLACES, rng.choice(PLACES, TRIALS - PLACES, False)]) for _ in places])
    flat = places.reshape(-1, 2)
    covariance = np.exp(-THETA * np.sum((flat[:, None] - flat[None]) ** 2, axis=-1))
    alike = np.kron(np.eye(people), np.ones((PLACES, PLACES)))
    values, vectors = np.linalg.eigh(covariance * (share + (1.0 - share) * alike))
    f = (vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(len(flat)))).reshape(people, PLACES)
    felt = np.take_along_axis(f, order, 1) + NOISE * rng.standard_normal(order.shape)
    return np.take_along_axis(places, order[..., None], 1), np.sum(felt[..., None] > np.array(THRESHOLDS), axis=-1)


def table(rows):
    lines = ["| drawn from | participants | studies | misfit reported |", "|---|---:|---:|---:|"]
    for rule, people in sorted({(row["rule"], row["people"]) for row in rows}):
        said = [
            bool(check_sentences(content_of(row))) for row in rows if (row["rule"], row["people"]) == (rule, people)
        ]
        share, error = np.mean(said), np.std(said) / np.sqrt(len(said))
        lines.append(f"| {rule} | {people} | {len(said)} | {100 * share:.1f} ± {100 * error:.1f} % |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
