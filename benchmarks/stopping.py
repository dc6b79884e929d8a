"""May a study stop once the best rendering is located? Coverage of the 95 % region after stopping; simulated studies.

    python benchmarks/stopping.py FILE [--studies 400] [--first 1000]
    python benchmarks/stopping.py FILE --write

FILE (JSON Lines) collects a row for each study; a run that was stopped goes on where it was. At most 24 people with 25
trials each; after each person, from the eighth on, learnt-2's 95 % region of all answers so far is made, and the study
ends when it is smaller than a tenth of the feasible set.

Fixed before the first study: the eighth person and the tenth; paper-02, paper-03, paper-05, ... paper-30 and the
functions drawn in turn, seeds from 1000, 400 studies or half of them. A study may stop if the region after stopping
holds the best rendering in at least 93 % of the studies. --write puts the table into
docs/methods/which_method_tables.md.
"""

import argparse
import os
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax

jax.config.update("jax_enable_x64", True)

import time  # noqa: E402

import equinox as eqx  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from pages import put  # noqa: E402
from pairs import FIRST, GROUPS, scheduled  # noqa: E402
from populations import by_recipe, chance_at, cohort_from, ends, highest, lined, rounded  # noqa: E402
from populations_people import POPULATIONS  # noqa: E402
from rows import Rows  # noqa: E402

from hilbo.population.rules.registry import RECOMMENDED  # noqa: E402
from hilbo.search.candidates import search_points  # noqa: E402
from hilbo.simulation.simulate import simulate_study  # noqa: E402
from hilbo.study.analysis.region import hyperparameter_draws, optimum_region  # noqa: E402

FEWEST, PEOPLE, SHARE = 8, 24, 0.1


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("file", type=Path)
    options.add_argument("--studies", type=int, default=400)
    options.add_argument("--first", type=int, default=FIRST)
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    rows = Rows(chosen.file)
    if chosen.write:
        put("methods/which_method_tables.md", "stopping", table(rows.rows))
        return
    known = {(row["population"], row["seed"]) for row in rows}
    for name, seed in scheduled(chosen.studies, chosen.first):
        if (name, seed) not in known:
            began = time.perf_counter()
            row = {"population": name, "seed": seed} | one_study(name, seed)
            rows.add(rounded(row | {"seconds": time.perf_counter() - began}))
            print(row, flush=True)


def one_study(name, seed):
    """Number of people when the study ended, and for that moment and the last person: whether the region held the best
    rendering, its volume, and the regret."""
    study = POPULATIONS[name].study
    scene = POPULATIONS[name].scene(study, PEOPLE, seed)
    every = simulate_study(study, scene.persons, seed)
    candidates = search_points(study.space, seed)
    best = highest(study, scene.chance, candidates)

    def after(people):
        answers = eqx.tree_at(lambda t: t.mask, every, every.mask & (jnp.arange(PEOPLE) < people)[:, None])
        learns, map_, optimum = by_recipe(study, cohort_from(answers), RECOMMENDED, candidates)
        region = optimum_region(learns, map_, hyperparameter_draws(learns, answers, seed), seed)
        chances = chance_at(scene.chance, jnp.stack([best, optimum.x]))
        held = region.holds(np.asarray(best), learns.gp.kernel)
        return {"holds": held, "volume": region.volume, "regret": float(chances[0] - chances[1])}

    for people in range(FEWEST, PEOPLE + 1):
        stopped = after(people)
        if stopped["volume"] < SHARE:
            break
    return {"people": people, "stopped": stopped, "whole": stopped if people == PEOPLE else after(PEOPLE)}


def table(rows):
    """People needed, coverage after stopping and of whole studies, and the regret that stopping costs."""
    heads = ["studies of", "studies", "stopped before the last person", "people, mean", "answers saved"]
    heads += ["held after stopping", "held with all people", "regret less that of all people, 95 %"]
    lines = []
    for words, begins in GROUPS.items():
        part = [row for row in rows if row["population"].startswith(begins)]
        if len(part) < 2:
            continue
        people = np.array([row["people"] for row in part])
        held = {way: [row[way]["holds"] for row in part] for way in ("stopped", "whole")}
        cost = np.array([row["stopped"]["regret"] - row["whole"]["regret"] for row in part])
        cells = [words, str(len(part)), f"{100 * np.mean(people < PEOPLE):.0f} %", f"{people.mean():.1f}"]
        cells.append(f"{100 * (1 - people.mean() / PEOPLE):.0f} %")
        cells += [f"{100 * np.mean(each):.1f} % ({sum(each)} of {len(each)})" for each in held.values()]
        lines.append([*cells, ends(cost, np.arange(len(part)))])
    return lined(heads, lines)


if __name__ == "__main__":
    main()
