"""What a recipe costs, and how much it depends on its priors.

    python benchmarks/learning.py [--people 24 100 1000] [--write]   times on one core, warm, and the low rank's error
    python benchmarks/learning.py --priors [--recipe learnt-2] [--seeds 10] [--write]

Studies of the population `paper-individuals` (benchmarks/populations_people.py), sessions of 25 trials. --priors: every
prior's standard deviation halved and doubled, seeds from 0; how far the optimum moves (NRMSE), and what that does to
how often new people give the highest answer there. --write puts the tables into
docs/methods/which_method_models.md and docs/methods/which_method_tables.md.
"""

import argparse
import dataclasses
import itertools
import os
import resource
import time

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[variable] = "1"
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false " + os.environ.get("XLA_FLAGS", "")
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:1])

import jax  # noqa: E402

jax.config.update("jax_enable_x64", True)

import equinox as eqx  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from pages import put  # noqa: E402
from populations import chance_at  # noqa: E402
from populations_people import POPULATIONS  # noqa: E402

from hilbo.population.learnt.posterior import LEFT  # noqa: E402
from hilbo.population.learnt.rule import learn  # noqa: E402
from hilbo.population.maps import learnt_map  # noqa: E402
from hilbo.population.rules.recipes import LEARNT_1  # noqa: E402
from hilbo.population.rules.registry import RECIPES  # noqa: E402
from hilbo.population.shared.features import pivots_of  # noqa: E402
from hilbo.population.shared.low_rank import shared_evidence  # noqa: E402
from hilbo.population.shared.tallies import tallied  # noqa: E402
from hilbo.search.candidates import search_points  # noqa: E402
from hilbo.simulation.simulate import simulate_study  # noqa: E402
from hilbo.study.config import Study  # noqa: E402
from hilbo.study.estimate.learnt import that_learns  # noqa: E402
from hilbo.study.estimate.optimum import map_optimum  # noqa: E402

POPULATION = POPULATIONS["paper-individuals"]
EXACT = 2500  # features: one for each point of 100 people
CATEGORIES = 3


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--priors", action="store_true")
    options.add_argument("--people", type=int, nargs="+", default=[24, 100, 1000])
    options.add_argument("--seeds", type=int, default=10)
    options.add_argument("--recipe", choices=RECIPES, default=LEARNT_1.name)
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    if chosen.priors:
        page, name, lines = (
            "methods/which_method_tables.md",
            "priors",
            sensitivity(RECIPES[chosen.recipe], chosen.seeds),
        )
    else:
        page, name, lines = "methods/which_method_models.md", "times", times(chosen.people)
    print("\n".join(lines))
    if chosen.write:
        put(page, name, "\n".join(lines))


def answers(people, seed):
    """A simulated study's answers, and what a new person thinks of renderings."""
    study: Study = POPULATION.study
    scene = POPULATION.scene(study, people, seed)
    return simulate_study(study, scene.persons, seed), scene.chance


def times(sizes):
    lines = [
        "| recipe | people × trials | seconds | L-BFGS steps | features | error of the log evidence by the low rank |",
        "|---|---|---:|---:|---:|---:|",
    ]
    for recipe, people in itertools.product(RECIPES.values(), sizes):
        trials, _ = answers(people, 1)
        learn(trials, CATEGORIES, recipe=recipe)  # compiles what it needs
        begun = time.perf_counter()
        learnt = jax.block_until_ready(learn(trials, CATEGORIES, recipe=recipe))
        seconds = time.perf_counter() - begun
        error = abs(evidence(learnt, trials, int(learnt.rank), LEFT) - evidence(learnt, trials, EXACT, 1e-12))
        cells = recipe.name, f"{people} × 25", f"{seconds:.1f}", int(learnt.steps), int(learnt.rank), f"{error:.1e}"
        lines.append("| " + " | ".join(map(str, cells)) + " |")
        print(lines[-1], flush=True)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    how = f"One core, one BLAS thread, in 64 bits, second call; peak memory of all {peak:.1f} GB. The error is against"
    return [*lines, "", f"{how}\n{EXACT} features, or one for each point where there are fewer."]


def evidence(learnt, trials, rank, tolerance):
    """The log evidence by so many features at most, of which the last leave this share of the prior variance."""
    given = tallied(trials, CATEGORIES)
    pivots = eqx.filter_jit(pivots_of)(learnt.model.unit, given, min(rank, int(given.asked.sum())), tolerance)
    return float(eqx.filter_jit(shared_evidence)(learnt.model, given, learnt.weights, pivots).value)


def sensitivity(recipe, seeds):
    study = that_learns(POPULATION.study, recipe.name)
    moved = {(name, factor): [] for name in recipe.priors if name != "effect" for factor in (0.5, 2.0)}
    for seed in range(seeds):
        trials, chance = answers(24, seed)
        candidates = search_points(study.space, seed)

        def best(priors, near=None, trials=trials, candidates=candidates, chance=chance):
            traced = jax.tree.map(jnp.asarray, priors)  # numbers, not constants: one compilation for all
            learnt = learn(trials, CATEGORIES, recipe=recipe._replace(priors=traced), near=near)
            x = _optimum(study, learnt, trials, candidates)
            return learnt, np.asarray(x), float(chance_at(chance, x[None, :])[0])

        learnt, x, value = best(recipe.priors)
        for name, factor in moved:
            changed = recipe.priors | {name: recipe.priors[name]._replace(sd=factor * recipe.priors[name].sd)}
            _, other, its_value = best(changed, learnt)
            moved[name, factor].append((100 * np.sqrt(np.mean((other - x) ** 2)), its_value - value))
        print(seed, flush=True)
    lines = [
        "| prior | sd | optimum moves, median (largest), % of the ranges | change of P(highest) of a new participant |",
        "|---|---|---:|---:|",
    ]
    for (name, factor), rows in moved.items():
        ways, gains = np.array(rows).T
        error = gains.std(ddof=1) / np.sqrt(len(gains))
        lines.append(
            f"| {name} | × {factor:g} | {np.median(ways):.2f} ({ways.max():.2f}) | {gains.mean():+.4f} ± {error:.4f} |"
        )
    return [*lines, "", f"{seeds} studies, seeds from 0."]


def _optimum(study, learnt, trials, candidates):
    own = dataclasses.replace(study, gp=learnt.model.gp, learnt=learnt)
    return map_optimum(own, learnt_map(learnt, trials), jnp.asarray(candidates)).x


if __name__ == "__main__":
    main()
