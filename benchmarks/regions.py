"""How often the region of the recommended recipe holds the best rendering, where answers come from its own model.

    python benchmarks/regions.py FILE [--studies 400] [--first 1000] [--design 24x25]
    python benchmarks/regions.py FILE --write

The shared function and everybody's own part are drawn from the recipe's kernel on the paper's three parameters, by
random waves. Lengths, variances and thresholds are drawn anew for each study, so that they are learnt with an error:
from the priors of learnt-1, whose values leave no category empty in most studies (those of learnt-2 reach from no
differences at all to noise-free answers). People answer at feasible points drawn evenly. FILE (JSON Lines) collects a
row for each study. --write puts the table into docs/methods/which_method_tables.md.
"""

import argparse
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from pages import put
from populations import by_chance, by_recipe, cohort_from, highest, rounded, with_trials
from populations_people import FEATURES, PAPER, ChanceOfFunctions, Drawn, Scene
from rows import Rows

from hilbo.population.rules.recipes import LEARNT_1
from hilbo.population.rules.registry import RECOMMENDED
from hilbo.search.candidates import search_points
from hilbo.study.analysis.region import hyperparameter_draws, optimum_region

CATEGORIES, FREEDOM = 3, 3  # Matern 3/2: waves are Student's, with 3 degrees of freedom


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("file", type=Path)
    options.add_argument("--studies", type=int, default=400)
    options.add_argument("--first", type=int, default=1000)
    options.add_argument("--design", default="24x25")
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    rows = Rows(chosen.file)
    if chosen.write:
        put("methods/which_method_tables.md", "regions", table(rows.rows))
        return
    known = {(row["design"], row["seed"]) for row in rows}
    for seed in range(chosen.first, chosen.first + chosen.studies):
        if (chosen.design, seed) not in known:
            row = {"design": chosen.design, "seed": seed} | one_study(chosen.design, seed)
            rows.add(rounded(row))
            print(row, flush=True)


def one_study(design, seed):
    """Coverage of the region, its volume, the regret, and the proportion of each response."""
    people, trials = map(int, design.split("x"))
    study = with_trials(PAPER, trials)
    scene = drawn_scene(study, people, seed)
    answers = by_chance(study, scene.persons, people, trials, seed)
    cohort = cohort_from(answers)
    candidates = search_points(study.space, seed)
    learns, map_, optimum = by_recipe(study, cohort, RECOMMENDED, candidates)
    region = optimum_region(learns, map_, hyperparameter_draws(learns, answers, seed), seed)
    best = highest(study, scene.chance, candidates)
    top, got = (float(scene.chance(x[None, :])[0]) for x in (best, optimum.x))
    return {
        "holds": region.holds(np.asarray(best), learns.gp.kernel),
        "volume": region.volume,
        "regret": top - got,
        "answers": np.bincount(np.asarray(answers.q).ravel(), minlength=CATEGORIES).tolist(),
        "converged": bool(learns.learnt.converged),
    }


def drawn_scene(study, people, seed):
    """People whose functions, variances, lengths and thresholds are drawn from the model."""
    rng, d = np.random.default_rng([seed, 13]), study.space.dim

    def drawn(name, size=None):
        prior = LEARNT_1.priors[name]
        return rng.normal(prior.mean - (np.log(d) if name == "theta" else 0.0), prior.sd, size)

    theta, shared, own = np.exp(drawn("theta", d)), np.exp(drawn("shared")), np.exp(drawn("own"))
    distances = np.exp(drawn("gaps", CATEGORIES - 2))
    thresholds = drawn("middle") + np.concatenate([[0.0], np.cumsum(distances)]) - distances.sum() / 2
    student = np.sqrt(rng.chisquare(FREEDOM, (FEATURES, 1)) / FREEDOM)
    waves = jnp.asarray(np.sqrt(2.0 * theta) * rng.standard_normal((FEATURES, d)) / student)
    phases = jnp.asarray(rng.uniform(0, 2 * np.pi, FEATURES))
    common = np.sqrt(2.0 * shared / FEATURES) * rng.standard_normal(FEATURES)
    parts = np.sqrt(2.0 * own / FEATURES) * rng.standard_normal((people, FEATURES))
    shape = [jnp.broadcast_to(leaf, (people, *leaf.shape)) for leaf in (waves, phases, jnp.asarray(thresholds))]
    persons = Drawn(jnp.asarray(common + parts), *shape, jnp.ones(people))
    spread = jnp.asarray(np.sqrt(1.0 + own))
    return Scene(persons, ChanceOfFunctions(jnp.asarray(common), waves, phases, jnp.asarray(thresholds[-1]), spread))


def table(rows):
    """By design: the coverage of the region with its 95 % interval, and its volume."""
    heads = "| studies | | coverage, 95 % interval | volume, mean | regret, mean |"
    lines = [heads, "|---|---:|---:|---:|---:|"]
    for design in sorted({row["design"] for row in rows}):
        some = [row for row in rows if row["design"] == design]
        located = [row for row in some if row["volume"] <= 0.25]
        for name, part in ((design, some), (f"{design}, where it locates it (volume ≤ 25 %)", located)):
            lines.append(f"| {name} | {len(part)} | {share(part)} | {mean(part, 'volume')} | {mean(part, 'regret')} |")
    return "\n".join(lines)


def share(rows):
    """Wilson's interval, in percent."""
    n, k, z = len(rows), sum(row["holds"] for row in rows), 1.96
    middle, half = (k + z * z / 2) / (n + z * z), z * np.sqrt(k * (n - k) / n + z * z / 4) / (n + z * z)
    return f"{100 * k / n:.1f} % [{100 * (middle - half):.1f}, {100 * (middle + half):.1f}]"


def mean(rows, name):
    values = np.array([row[name] for row in rows])
    return f"{values.mean():.3f} ± {values.std(ddof=1) / np.sqrt(len(values)):.3f}"


if __name__ == "__main__":
    main()
