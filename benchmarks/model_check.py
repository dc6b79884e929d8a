"""How often does a right model seem not to fit? Simulated sessions, whose renderings follow from earlier answers.

    python benchmarks/model_check.py FILE [--studies 4] [--only NAME]
    python benchmarks/model_check.py FILE --write

Each participant is left out and predicted in two ways: from the others' responses alone, and also from the earlier
ones. FILE (JSON Lines) collects a row for each study; a run that was stopped goes on. --write puts the table into
docs/methods/which_method_tables.md.
"""

import argparse
from pathlib import Path

import numpy as np
from pages import put
from populations import by_recipe, chance_at, with_trials
from populations_people import POPULATIONS
from rows import Rows

from hilbo.population.judged.baselines import quadratic
from hilbo.population.judged.leave_one_out import clustered, leave_one_out_learnt
from hilbo.population.rules.registry import RECOMMENDED
from hilbo.search.candidates import search_points
from hilbo.simulation.simulate import simulate_study
from hilbo.study.analysis.model_check import _compared, _differs, _limits
from hilbo.study.cohort import Cohort

PEOPLE, TRIALS, FIRST, GROUPS = 24, 25, 50, 12
NAMES = (
    *("paper-individuals", "paper-individuals, differences × 2", "functions, RBF, theta 4"),
    *("functions, Matérn 5/2, theta 12", "paper-04", "paper-11", "paper-18", "paper-24", "paper-29", "paper-14"),
)


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("file", type=Path)
    options.add_argument("--studies", type=int, default=4)
    options.add_argument("--only")
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    rows = Rows(chosen.file)
    if chosen.write:
        put("methods/which_method_tables.md", "model check", table(list(rows)))
        return
    known = {(row["population"], row["seed"]) for row in rows}
    for seed in range(FIRST, FIRST + chosen.studies):
        for name in NAMES:
            if (name, seed) not in known and chosen.only in (None, name):
                rows.add({"population": name, "seed": seed} | one_study(name, seed))
                print(name, seed, flush=True)


def one_study(name, seed):
    study = with_trials(POPULATIONS[name].study, TRIALS)
    scene = POPULATIONS[name].scene(study, PEOPLE, seed)
    answers = simulate_study(study, scene.persons, seed)
    x, q = np.asarray(answers.x), np.asarray(answers.q)
    cohort = Cohort(answers, np.zeros_like(x), tuple(f"P{j}" for j in range(PEOPLE)))
    learns, _, _ = by_recipe(study, cohort, RECOMMENDED, search_points(study.space, seed))
    left, maps = leave_one_out_learnt(learns.learnt, answers, learns.stated, again=False)
    alone = np.concatenate(
        [np.asarray(map_.class_probabilities(learns.gp.likelihood, answers.x[j])) for j, map_ in enumerate(maps)]
    )
    baseline, group = np.empty(q.size), left.person % GROUPS
    for k in range(GROUPS):
        out = group == k
        by_others = quadratic(x.reshape(q.size, -1), left.q, alone.shape[1], ~out)
        baseline[out] = -np.log(by_others[out, left.q[out]])
    content = {"given": float(np.mean(left.q == alone.shape[1] - 1))}
    content["new person"] = float(np.mean(chance_at(scene.chance, answers.x.reshape(q.size, -1))))
    limits = _limits(alone.shape[1], PEOPLE)
    for way, predicted in (("alone", alone), ("in turn", left.probabilities)):
        cost = -np.log(predicted[np.arange(q.size), left.q])
        shares = [_compared((left.q == c).astype(float), predicted[:, c], left.person) for c in range(alone.shape[1])]
        gain, error = clustered(baseline - cost, left.person)
        content[way] = {
            "highest": float(predicted[:, -1].mean()),
            "a share differs": any(_differs(share, limits) for share in shares),
            "the quadratic is better": gain < 0.0,
            "beyond two errors": gain < -2.0 * error,
        }
    return content


def table(rows):
    heads = ("predicted", "the highest response", "a proportion differs", "a quadratic is better", "by two errors")
    lines = ["| " + " | ".join(heads) + " |", "|---|" + "---:|" * (len(heads) - 1)]
    ways = {"alone": "from the others alone", "in turn": "also from the participant's earlier responses"}
    for way, words in ways.items():
        each = [row[way] for row in rows]
        counts = (sum(e[k] for e in each) for k in ("a share differs", "the quadratic is better", "beyond two errors"))
        cells = " | ".join(f"{count} of {len(rows)}" for count in counts)
        lines.append(f"| {words} | {100 * np.mean([e['highest'] for e in each]):.1f} % | {cells} |")
    given, new = (100 * np.mean([row[key] for row in rows]) for key in ("given", "new person"))
    lines.append(f"\nObserved: {given:.1f} %; expected of new participants at the same stimuli: {new:.1f} %.")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
