"""Which rule finds a rendering that new people like? Simulated studies of many populations.

All rules have the same answers.

    python benchmarks/populations.py FILE [--studies 100] [--first 1000] [--only NAME] [--design 12x15] [--chance]
    python benchmarks/populations.py FILE --write

FILE (JSON Lines) collects a row for each study and design; a run that was stopped goes on where it was. What has been
run with this recipe is in benchmarks/populations.jsonl. *Regret* is how much less often a new person of the population
gives the highest answer at the optimum found than at the best feasible rendering. Choices of method were made on seeds
0 to 99; what is reported begins at 1000. --chance: points by chance in place of sessions. --write puts the tables into
docs/methods/which_method.md.
"""

import argparse
import json
import os
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax

jax.config.update("jax_enable_x64", True)

import equinox as eqx  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from populations_people import POPULATIONS  # noqa: E402
from rows import Rows  # noqa: E402

from hilbo import acquisition  # noqa: E402
from hilbo.ordinal_gp import Trials  # noqa: E402
from hilbo.population.maps import learnt_map, rule_map  # noqa: E402
from hilbo.population.recipes import LEARNT_1, RECIPES, RECOMMENDED  # noqa: E402
from hilbo.search.candidates import search_points  # noqa: E402
from hilbo.simulation.simulate import simulate_study  # noqa: E402
from hilbo.study.aggregate import fit_cohort  # noqa: E402
from hilbo.study.cohort import Cohort  # noqa: E402
from hilbo.study.config import Study  # noqa: E402
from hilbo.study.learnt_study import resolved, that_learns  # noqa: E402
from hilbo.study.optima import individual_optima, map_optimum  # noqa: E402
from hilbo.study.optimum_region import optimum_region  # noqa: E402

ROOT = Path(__file__).parents[1]
RULES = ("learnt-2", "learnt-1", "centre of its hill", "bcm", "average", "mean of the individual optima")
LARGE = 0.05  # a regret of the committee machine that is worth fixing


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("file", type=Path)
    options.add_argument("--studies", type=int, default=100)
    options.add_argument("--first", type=int, default=1000)
    options.add_argument("--only")
    options.add_argument("--design", default="24x25")
    options.add_argument("--chance", action="store_true")
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    rows = Rows(chosen.file)
    if chosen.write:
        write(rows.rows)
        return
    known = {(row["population"], row["design"], row["seed"]) for row in rows}
    design = chosen.design + (" by chance" if chosen.chance else "")
    for seed in range(chosen.first, chosen.first + chosen.studies):
        for name in POPULATIONS:
            if (name, design, seed) in known or chosen.only not in (None, name):
                continue
            row = {"population": name, "design": design, "seed": seed} | one_study(name, design, seed)
            rows.add(rounded(row))
            print(name, seed, {rule: round(row["rules"][rule]["regret"], 3) for rule in RULES}, flush=True)


def rounded(row):
    """Numbers with six digits after the point: a hundredth of what anybody reads."""
    if isinstance(row, dict):
        return {name: rounded(value) for name, value in row.items()}
    return round(row, 6) if isinstance(row, float) else row


def one_study(name, design, seed):
    """Regret and distances of every rule's optimum, and what the recommended recipe says of its own; the hill is
    that of learnt-1's optimum."""
    people, trials = map(int, design.split()[0].split("x"))
    study = with_trials(POPULATIONS[name].study, trials)
    scene = POPULATIONS[name].scene(study, people, seed)
    if "chance" in design:
        answers = by_chance(study, scene.persons, people, trials, seed)
    else:
        answers = simulate_study(study, scene.persons, seed)
    cohort = Cohort(answers, np.zeros((people, trials, study.space.dim)), tuple(f"P{j}" for j in range(people)))
    candidates = search_points(study.space, seed)
    best = highest(study, scene.chance, candidates)
    top = float(chance_at(scene.chance, best[None, :])[0])
    median = float(jnp.median(chance_at(scene.chance, candidates[:512])))
    posteriors = fit_cohort(study, cohort)
    individual = jnp.mean(individual_optima(study, posteriors, candidates).x, axis=0)
    learnt = {recipe: by_recipe(study, cohort, recipe, candidates, seed) for recipe in RECIPES}
    resolved_study, optimum, region = learnt[RECOMMENDED]
    held = region.holds(np.asarray(best), resolved_study.gp.kernel)
    _, of_learnt_1, hills = learnt[LEARNT_1.name]
    places = {recipe: optimum.x for recipe, (_, optimum, _) in learnt.items()} | {
        "centre of its hill": centre_of_hill(study.space, hills, of_learnt_1.x),
        "bcm": map_optimum(study, rule_map(study.gp, answers, "bcm", posteriors=posteriors), candidates).x,
        "average": map_optimum(study, rule_map(study.gp, answers, "average", posteriors=posteriors), candidates).x,
        "mean of the individual optima": study.space.from_box(jnp.clip(study.space.to_box(individual), 0, 1)),
    }
    rules = {
        rule: {
            "regret": top - float(chance_at(scene.chance, x[None, :])[0]),
            "nrmse": float(jnp.sqrt(jnp.mean((x - best) ** 2))),
        }
        for rule, x in places.items()
    }
    said = float(optimum.class_probabilities[-1])
    content = {"best": top, "median": median, "rules": rules, "said": said, "is": top - rules[RECOMMENDED]["regret"]}
    return content | {
        "region": {"holds": held, "volume": region.volume},
        "converged": bool(resolved_study.learnt.converged),
    }


def by_recipe(study, cohort, recipe, candidates, seed):
    """The study with what a recipe learns of the answers, the optimum, and the region of the best rendering."""
    learns = resolved(that_learns(study, recipe), cohort)
    map_ = learnt_map(learns.learnt, cohort.trials)
    return learns, map_optimum(learns, map_, candidates), optimum_region(learns, map_, seed)


def centre_of_hill(space, region, x):
    """Of the hill whose top is nearest to the optimum."""
    box = np.asarray(space.to_box(x))
    hill = min(region.hills, key=lambda hill: np.sum((hill.top - box) ** 2))
    return space.from_box(jnp.asarray(hill.centre))


def with_trials(study, trials):
    raw = {"schema": 1} | json.loads(study.content)
    raw["selection"] |= {"space_filling": min(5, trials), "trials": trials}
    return Study.from_dict(raw)


def by_chance(study, persons, people, trials, seed):
    """Answers at feasible points drawn evenly."""
    rng = np.random.default_rng([seed, 11])
    pool = np.asarray(study.space.candidates(4096, seed % 97))
    x = jnp.asarray(pool[rng.integers(len(pool), size=(people, trials))])
    keys = jax.random.split(jax.random.key(seed), (people, trials))
    each = jax.vmap(lambda p, ks, xs: jax.vmap(lambda k, x: p.answer(k, x, jnp.zeros(())))(ks, xs))
    return Trials(x, each(persons, keys, x).astype(jnp.int32), jnp.ones((people, trials), bool))


@eqx.filter_jit
def chance_at(chance, x):
    return chance(x)


@eqx.filter_jit
def highest(study, chance, candidates):
    """The feasible point at which a function (m, d) -> (m,) is highest."""
    space = study.space
    return acquisition.maximise(
        chance(candidates),
        candidates,
        lambda x: chance(x[None, :])[0],
        from_box=space.from_box,
        to_box=space.to_box,
        feasible=space.feasible,
        steps=300,
    ).x


def paired(rows, rule, measure="regret"):
    values = np.array([row["rules"][rule][measure] for row in rows])
    return values, np.array([row["rules"]["bcm"][measure] for row in rows]) - values


def error(values):
    return values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else float("nan")


def table(rows, design):
    """A row for each population: regret of every rule, and what learnt-2 gains on the committee, with its interval."""
    lines = [
        "| population | studies | " + " | ".join(RULES) + " | bcm less learnt-2, 95 % | learnt-2: NRMSE to the best |",
        "|---|---:|" + "---:|" * (len(RULES) + 2),
    ]
    for name in POPULATIONS:
        some = [
            row for row in rows if row["population"] == name and row["design"] == design and RECOMMENDED in row["rules"]
        ]
        if len(some) < 2:
            continue
        cells = []
        for rule in RULES:
            values = np.array([row["rules"][rule]["regret"] for row in some if rule in row["rules"]])
            cells.append(f"{values.mean():.3f} ± {error(values):.3f}" if len(values) > 1 else "–")
        _, gain = paired(some, RECOMMENDED)
        low, high = gain.mean() - 1.96 * error(gain), gain.mean() + 1.96 * error(gain)
        nrmse = 100 * np.median([row["rules"][RECOMMENDED]["nrmse"] for row in some])
        of_bcm = 100 * np.median([row["rules"]["bcm"]["nrmse"] for row in some])
        ends = f"{gain.mean():.3f} [{low:.3f}, {high:.3f}]"
        lines.append(f"| {name} | {len(some)} | {' | '.join(cells)} | {ends} | {nrmse:.1f} % (bcm {of_bcm:.1f} %) |")
    return "\n".join(lines)


def write(rows):
    page = ROOT / "docs" / "methods" / "which_method.md"
    text = page.read_text()
    for design in sorted({row["design"] for row in rows}, reverse=True):
        mark = f"<!-- {design} -->"
        if mark not in text:
            text = text.rstrip("\n") + f"\n\n### {design}\n\n{mark}\n<!-- end -->\n"
        before, _, rest = text.partition(mark)
        _, _, after = rest.partition("<!-- end -->")
        text = f"{before}{mark}\n{table(rows, design)}\n<!-- end -->{after}"
    page.write_text(text)


if __name__ == "__main__":
    main()
