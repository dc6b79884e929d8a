"""Which rule finds a rendering that new people like? Simulated studies of many populations.

All rules have the same answers.

    python benchmarks/populations.py FILE [--studies 100] [--regions 100] [--first 1000] [--only NAME] [--design 12x15]
        [--chance | --medians]
    python benchmarks/populations.py FILE --write

FILE (JSON Lines) collects a row for each study and design; a run that was stopped goes on where it was. What has been
run with this recipe is in benchmarks/populations.jsonl. *Regret* is how much less often a new person of the population
gives the highest answer at the optimum found than at the best feasible rendering. Choices of method were made on seeds
0 to 99; what is reported begins at 1000. --regions: of how many studies of each population the region is made,
which is half of the work. --chance: points by chance in place of sessions. --medians: sessions choose by the medians of
the recipes' priors, as those of a study file that `hilbo init` writes; else by the paper's hyperparameters. --write
puts the tables into docs/methods/which_method_tables.md.
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
from pages import put  # noqa: E402
from populations_people import POPULATIONS  # noqa: E402
from rows import Rows  # noqa: E402

from hilbo import acquisition  # noqa: E402
from hilbo.ordinal_gp import Trials  # noqa: E402
from hilbo.population.judged.leave_one_out import clustered  # noqa: E402
from hilbo.population.maps import learnt_map, rule_map  # noqa: E402
from hilbo.population.rules.registry import RECIPES, RECOMMENDED  # noqa: E402
from hilbo.search.candidates import search_points  # noqa: E402
from hilbo.simulation.simulate import simulate_study  # noqa: E402
from hilbo.study.analysis.region import hyperparameter_draws, optimum_region  # noqa: E402
from hilbo.study.cohort import Cohort  # noqa: E402
from hilbo.study.config import Study  # noqa: E402
from hilbo.study.estimate.aggregate import fit_cohort  # noqa: E402
from hilbo.study.estimate.learnt import resolved, that_learns  # noqa: E402
from hilbo.study.estimate.optimum import individual_optima, map_optimum  # noqa: E402

FIRST = 1000  # seed of what is reported
MEDIANS = " by medians"
RULES = ("learnt-2", "learnt-1", "bcm", "average", "mean of the individual optima")


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("file", type=Path)
    options.add_argument("--studies", type=int, default=100)
    options.add_argument("--regions", type=int, default=100)
    options.add_argument("--first", type=int, default=FIRST)
    options.add_argument("--only")
    options.add_argument("--design", default="24x25")
    asked = options.add_mutually_exclusive_group()
    asked.add_argument("--chance", dest="asked", action="store_const", const=" by chance", default="")
    asked.add_argument("--medians", dest="asked", action="store_const", const=MEDIANS)
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    rows = Rows(chosen.file)
    if chosen.write:
        write(rows.rows)
        return
    known = {(row["population"], row["design"], row["seed"]) for row in rows}
    design = chosen.design + chosen.asked
    for seed in range(chosen.first, chosen.first + chosen.studies):
        for name in POPULATIONS:
            if (name, design, seed) in known or chosen.only not in (None, name):
                continue
            region = seed < chosen.first + chosen.regions
            row = {"population": name, "design": design, "seed": seed} | one_study(name, design, seed, region)
            rows.add(rounded(row))
            print(name, seed, {rule: round(row["rules"][rule]["regret"], 3) for rule in RULES}, flush=True)


def rounded(row):
    """Numbers with six digits after the point: a hundredth of what anybody reads."""
    if isinstance(row, dict):
        return {name: rounded(value) for name, value in row.items()}
    return round(row, 6) if isinstance(row, float) else row


def one_study(name, design, seed, with_region=True):
    """Regret and distances of every rule's optimum, and what the recommended recipe says of its own."""
    people, trials = map(int, design.split()[0].split("x"))
    study = with_trials(POPULATIONS[name].study, trials)
    scene = POPULATIONS[name].scene(study, people, seed)
    if "chance" in design:
        answers = by_chance(study, scene.persons, people, trials, seed)
    else:
        asking = without_gp(study) if MEDIANS in design else study
        answers = simulate_study(asking, scene.persons, seed)
    cohort = cohort_from(answers)
    candidates = search_points(study.space, seed)
    best = highest(study, scene.chance, candidates)
    top = float(chance_at(scene.chance, best[None, :])[0])
    median = float(jnp.median(chance_at(scene.chance, candidates[:512])))
    posteriors = fit_cohort(study, cohort)
    individual = jnp.mean(individual_optima(study, posteriors, candidates).x, axis=0)
    learnt = {recipe: by_recipe(study, cohort, recipe, candidates) for recipe in RECIPES}
    resolved_study, map_, optimum = learnt[RECOMMENDED]
    places = {recipe: each.x for recipe, (_, _, each) in learnt.items()} | {
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
    if with_region:
        region = optimum_region(resolved_study, map_, hyperparameter_draws(resolved_study, answers, seed), seed)
        held = region.holds(np.asarray(best), resolved_study.gp.kernel)
        content["region"] = {"holds": held, "volume": region.volume}
    return content | {"converged": bool(resolved_study.learnt.converged)}


def cohort_from(trials):
    """The cohort P0, P1, ... of stacked trials."""
    return Cohort(trials, np.zeros(trials.x.shape), tuple(f"P{j}" for j in range(len(trials.x))))


def by_recipe(study, cohort, recipe, candidates):
    """The study with what a recipe learns of the answers, its map, and the optimum."""
    learns = resolved(that_learns(study, recipe), cohort)
    map_ = learnt_map(learns.learnt, cohort.trials)
    return learns, map_, map_optimum(learns, map_, candidates)


def with_trials(study, trials):
    raw = {"schema": 1} | json.loads(study.file.content)
    raw["selection"] |= {"space_filling": min(5, trials), "trials": trials}
    return Study.from_dict(raw)


def without_gp(study):
    """Its sessions choose by the medians of the recipes' priors."""
    raw = {"schema": 1} | json.loads(study.file.content)
    del raw["gp"]
    return Study.from_dict(raw | {"aggregation": {"rule": RECOMMENDED}})


def by_chance(study, persons, people, trials, seed):
    """Answers at feasible points drawn evenly."""
    rng = np.random.default_rng([seed, 11])
    pool = np.asarray(study.space.candidates(4096, seed % 97))
    x = jnp.asarray(pool[rng.integers(len(pool), size=(people, trials))])
    keys = jax.random.split(jax.random.key(seed), (people, trials))
    progress = jnp.arange(trials) / trials
    each = jax.vmap(lambda p, ks, xs: jax.vmap(p.answer)(ks, xs, progress))
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


GROUPS = {
    "`paper-01` to `paper-30`": lambda name: name[6:].isdigit(),
    "`paper-individuals` and its variants": lambda name: not name[6:].isdigit() and not name.startswith("functions"),
    "functions drawn": lambda name: name.startswith("functions"),
    "all": lambda name: True,
}
ENOUGH, MANY = 10, 100  # studies for a row of a population's own among the regrets, and in the other tables
EVEN = {"24x25": 100, "12x15": 10}  # studies of each population that a group counts, whatever more one has


def interval(values, seeds=None, digits=3):
    """The mean with its standard error over seeds; without them, each value has its own."""
    mean, error = clustered(values, np.arange(len(values)) if seeds is None else seeds)
    return f"{mean:.{digits}f} ± {error:.{digits}f}"


def ends(gain, seeds):
    """The mean with its 95 % interval over seeds."""
    mean, error = clustered(gain, seeds)
    return f"{mean:+.3f} [{mean - 1.96 * error:+.3f}, {mean + 1.96 * error:+.3f}]"


def seeds_of(rows):
    """One seed draws related people in every population."""
    return np.array([row["seed"] for row in rows])


def values_of(rows, rule, measure="regret"):
    return np.array([row["rules"][rule][measure] for row in rows])


def tables(rows, even):
    """Of the rows of one design: regret by rule, paired differences, and what the recommended recipe says of itself."""
    even = [row for row in rows if row["seed"] < FIRST + even]
    parts = {group: [row for row in even if belongs(row["population"])] for group, belongs in GROUPS.items()}
    own = {name: [row for row in rows if row["population"] == name] for name in POPULATIONS}
    parts = {name: part for name, part in parts.items() if len(part) > 1}
    enough, many = (
        parts | {f"`{name}`": part for name, part in own.items() if len(part) >= count} for count in (ENOUGH, MANY)
    )
    located = {
        name: part for name, part in many.items() if sum("region" in row for row in part) >= MANY or name in parts
    }
    return "\n\n".join((regrets(enough), differences(many), itself(located)))


def lined(heads, lines):
    marks = "|---|" + "---:|" * (len(heads) - 1)
    return "\n".join(["| " + " | ".join(heads) + " |", marks, *("| " + " | ".join(line) + " |" for line in lines)])


def regrets(parts):
    heads = ["regret: populations", "studies", *RULES, f"{RECOMMENDED} / bcm"]
    lines = []
    for name, part in parts.items():
        mean = {rule: values_of(part, rule).mean() for rule in (RECOMMENDED, "bcm")}
        of_rules = [interval(values_of(part, rule), seeds_of(part)) for rule in RULES]
        lines.append([name, str(len(part)), *of_rules, f"{mean[RECOMMENDED] / mean['bcm']:.2f}"])
    return lined(heads, lines)


def differences(parts):
    """Paired: what the recommended recipe loses less, with its 95 % interval, and distances."""
    others = ("learnt-1", "bcm", "average")
    heads = ["studies of", *(f"{other} minus {RECOMMENDED}, 95 %" for other in others), "NRMSE to the best, median"]
    lines = []
    for name, part in parts.items():
        cells = [name]
        for other in others:
            cells.append(ends(values_of(part, other) - values_of(part, RECOMMENDED), seeds_of(part)))
        far = {rule: 100 * np.median(values_of(part, rule, "nrmse")) for rule in (RECOMMENDED, "bcm")}
        lines.append([*cells, f"{far[RECOMMENDED]:.1f} % (bcm {far['bcm']:.1f} %)"])
    return lined(heads, lines)


def itself(parts):
    """Coverage of the 95 % region, its volume, and the predicted minus the true probability."""
    heads = [
        "studies of",
        "coverage of the region",
        "its volume, mean",
        "predicted minus true P(highest)",
        "not converged",
    ]
    lines = []
    for name, part in parts.items():
        regions = [row["region"] for row in part if "region" in row]
        held = [region["holds"] for region in regions]
        volume = np.mean([region["volume"] for region in regions])
        promised = np.array([row["said"] - row["is"] for row in part])
        failed = sum(not row["converged"] for row in part)
        share = f"{sum(held)} of {len(held)} ({100 * np.mean(held):.0f} %)"
        lines.append([name, share, f"{100 * volume:.0f} %", interval(promised, seeds_of(part)), str(failed)])
    return lined(heads, lines)


def sessions(rows, design):
    """learnt-2 from sessions that choose by the medians of its priors, beside sessions of the same people that choose
    by the paper's hyperparameters."""
    other = {(row["population"], row["seed"]): row for row in rows if row["design"] == design}
    pairs = [
        (row, other[row["population"], row["seed"]])
        for row in rows
        if row["design"] == design + MEDIANS and (row["population"], row["seed"]) in other
    ]
    heads = ["trials selected with", "studies", "the medians", "the paper's", "medians minus the paper's, 95 %"]
    lines = []
    for name, belongs in GROUPS.items():
        part = [pair for pair in pairs if belongs(pair[0]["population"])]
        by_medians, by_paper = (values_of(of, RECOMMENDED) for of in zip(*part, strict=True))
        seeds = seeds_of([row for row, _ in part])
        cells = interval(by_medians, seeds), interval(by_paper, seeds), ends(by_medians - by_paper, seeds)
        lines.append([name, str(len(part)), *cells])
    return lined(heads, lines)


def write(rows):
    for design, even in EVEN.items():
        part = [row for row in rows if row["design"] == design]
        if part:
            put("methods/which_method_tables.md", f"populations {design}", tables(part, even))
    if any(row["design"] == "24x25" + MEDIANS for row in rows):
        put("methods/which_method_tables.md", "populations by medians", sessions(rows, "24x25"))


if __name__ == "__main__":
    main()
