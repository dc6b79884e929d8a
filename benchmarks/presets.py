"""The presets' populations on fresh seeds, beside the paper's figures: by the paper's method and by the recipes.

    python benchmarks/presets.py FILE [--studies 8] [--first 5000] [--only paper-03]
    python benchmarks/presets.py FILE --write

FILE (JSON Lines) collects a row for each study; a run that was stopped goes on where it was. What has been run is in
benchmarks/presets.jsonl. Individuals' figures and the classes of the validation were looked at when the populations
were chosen (benchmarks/preset_search.py), on other seeds. All else is a prediction: the preferences, how often the
aggregate's set is preferred to individuals' own, the distance of the optimum from the truth, and the intervals on which
"close" is the likeliest answer. --write puts the tables into docs/methods/simulation.md.
"""

import argparse
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import equinox as eqx  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from preset_search import CROWD, STUDY, distance, individuals, truth_of, validation  # noqa: E402
from rows import Rows  # noqa: E402

from hilbo.population.maps import learnt_map, rule_map  # noqa: E402
from hilbo.population.rules.registry import RECIPES, RECOMMENDED  # noqa: E402
from hilbo.search.candidates import search_points  # noqa: E402
from hilbo.simulation.presets import PRESETS  # noqa: E402
from hilbo.simulation.simulate import people, simulate_study  # noqa: E402
from hilbo.study.analysis.best_mid_worst import best_mid_worst  # noqa: E402
from hilbo.study.analysis.tolerance import slice_through  # noqa: E402
from hilbo.study.cohort import Cohort  # noqa: E402
from hilbo.study.estimate.aggregate import fit_cohort  # noqa: E402
from hilbo.study.estimate.learnt import resolved, that_learns  # noqa: E402
from hilbo.study.estimate.optimum import individual_optima, map_optimum  # noqa: E402

PAGE = Path(__file__).parents[1] / "docs" / "methods" / "simulation.md"
RULES = ("bcm", *RECIPES)
PARAMETERS = ("K1", "B1", "alpha")


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("file", type=Path)
    options.add_argument("--studies", type=int, default=8)
    options.add_argument("--first", type=int, default=5000)
    options.add_argument("--only")
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    rows = Rows(chosen.file)
    if chosen.write:
        write(rows.rows)
        return
    known = {(row["population"], row["seed"]) for row in rows}
    for seed in range(chosen.first, chosen.first + chosen.studies):
        for name in PRESETS:
            if name == "paper" or (name, seed) in known or chosen.only not in (None, name):
                continue
            row = {"population": name, "seed": seed} | one_study(PRESETS[name], seed)
            rows.add(row)
            print(name, seed, {rule: round(row["rules"][rule]["error"], 1) for rule in RULES}, flush=True)


def one_study(population, seed):
    persons = people(STUDY, population, 24, seed)
    trials = simulate_study(STUDY, persons, seed)
    cohort = Cohort(trials, np.zeros((24, 25, 3)), tuple(f"P{j:02d}" for j in range(24)))
    candidates = jnp.asarray(search_points(STUDY.space, 0))
    posteriors = fit_cohort(STUDY, cohort)
    own = np.asarray(individual_optima(STUDY, posteriors, candidates).x)
    maps = {"bcm": (STUDY, rule_map(STUDY.gp, trials, "bcm", posteriors=posteriors))}
    for recipe in RECIPES:
        learns = resolved(that_learns(STUDY, recipe), cohort)
        maps[recipe] = learns, learnt_map(learns.learnt, trials)
    crowd = people(STUDY, population, CROWD, 10**6 + seed)
    rules = {}
    for rule, (study, map_) in maps.items():
        x = np.asarray(map_optimum(study, map_, candidates).x)
        rules[rule] = {
            "error": float(100 * np.sqrt(np.mean((x - truth_of(STUDY)) ** 2))),
            "preferred to individuals": preferred(population, crowd, x, own, seed),
            "intervals": intervals(study, map_, x),
        }
        sets = best_mid_worst(study, map_.predict, candidates, prior=map_.map_prior)
        if sets.second_choice:
            rules[rule] |= {"classes": None, "preferred": None}
        else:
            rules[rule] |= validation(population, np.asarray(sets.x), seed)
    return {"individuals": individuals(STUDY, trials, own), "rules": rules}


def preferred(population, crowd, x, own, seed):
    """How often new people take x for nearer to the reference than an individual's own set."""
    rng = np.random.default_rng([seed, 3])
    optimum, tolerance = np.asarray(crowd.optimum), np.asarray(crowd.tolerance)
    felt = [
        np.sqrt(np.sum(((point - optimum) / tolerance) ** 2, axis=1)) + population.noise * rng.standard_normal(CROWD)
        for point in [x, *own]
    ]
    nearer = np.mean([np.mean(felt[0] < other) for other in felt[1:]])
    return float((1 - population.lapse) * nearer + population.lapse / 2)


@eqx.filter_jit
def chances(likelihood, map_, x):
    return map_.class_probabilities(likelihood, x)


def intervals(study, map_, x):
    """Of each parameter, in its unit, where "close" is the likeliest answer about x; None if another is at x."""
    ends = {}
    for i, parameter in enumerate(study.space.parameters):
        values = np.sort(np.append(np.linspace(0, 1, 101), x[i]))
        points, feasible = slice_through(study, jnp.asarray(x), parameter.name, jnp.asarray(values))
        close = np.asarray(jnp.argmax(chances(study.gp.likelihood, map_, points), axis=1) == 2) & np.asarray(feasible)
        low = high = int(np.searchsorted(values, x[i]))
        if not close[low]:
            ends[parameter.name] = None
            continue
        while low > 0 and close[low - 1]:
            low -= 1
        while high < len(values) - 1 and close[high + 1]:
            high += 1
        ends[parameter.name] = [float(parameter.to_physical(jnp.asarray(values[k]))) for k in (low, high)]
    return ends


# --- the page


def write(rows):
    before, mark, rest = PAGE.read_text().partition("<!-- presets -->\n")
    _, end, after = rest.partition("<!-- end of presets -->")
    PAGE.write_text(before + mark + "\n".join(page(rows)) + "\n" + end + after)


def page(rows):
    names = [name for name in PRESETS if name != "paper" and any(row["population"] == name for row in rows)]
    some = {name: [row for row in rows if row["population"] == name] for name in names}
    thirty = [row for name, each in some.items() if name != "paper-individuals" for row in each]
    count, some = min(map(len, some.values())), {"**all thirty**": thirty} | some
    lines = [
        f"Made by `python benchmarks/presets.py FILE --studies {count} --write`: studies of 24 x 25, {count} of each,"
        " seeds from 5000. Figures of people and classes are means over studies.",
        "",
        '| population | "close" of 25 | individuals\' NRMSE, quartiles | "close" at best / mid / worst, bcm'
        f" | the same, {RECOMMENDED} | distance from the paper |",
        "|---|---|---|---|---|---:|",
        "| *the paper* | 5.96 ± 4.47 | 13, 24, 41 % | 92 / 15 / 0 % | | |",
    ]
    for name, each in some.items():
        own = {key: np.mean([row["individuals"][key] for row in each]) for key in each[0]["individuals"]}
        q = ", ".join(f"{own[f'nrmse {k}']:.0f}" for k in (25, 50, 75))
        came = [row["individuals"] | row["rules"]["bcm"] for row in each]
        cells = [
            f"{own['close']:.1f} ± {own['close sd']:.1f}",
            f"{q} %",
            *(shares(each, rule) for rule in ("bcm", RECOMMENDED)),
        ]
        lines.append(f"| {name} | {' | '.join(cells)} | {distance([c for c in came if c['classes']]):.0f} |")
    lines += [
        "",
        "Predicted, and not used to choose the populations (medians over studies; shares of preferences):",
        "",
        "| population | rule | optimum to the truth, quartiles | best to mid, best to worst, mid to worst"
        ' | preferred to individual sets | "close" most probable for K1, B1, alpha in |',
        "|---|---|---|---|---:|---|",
        "| *the paper* | bcm | 4 % | 95, 100, 90 % | 73 % | 4.6 to 6.1, 4.3 to 15.1, 0.13 to 0.33 |",
    ]
    few = ("**all thirty**", "paper-individuals")
    lines += [predicted(name, rule, some[name]) for name in few for rule in RULES]
    return lines


def shares(each, rule):
    classes = [row["rules"][rule]["classes"] for row in each if row["rules"][rule]["classes"]]
    return " / ".join(f"{100 * share:.0f}" for share in np.mean(classes, axis=0)[:, 2]) + " %"


def predicted(name, rule, each):
    q = np.percentile([row["rules"][rule]["error"] for row in each], [25, 50, 75])
    prefer = np.mean([row["rules"][rule]["preferred"] for row in each if row["rules"][rule]["preferred"]], axis=0)
    own = np.median([row["rules"][rule]["preferred to individuals"] for row in each])
    words = []
    for parameter in PARAMETERS:
        ends = [e for row in each if (e := row["rules"][rule]["intervals"][parameter]) is not None]
        words.append("–" if 2 * len(ends) < len(each) else "{:.2g} to {:.2g}".format(*np.median(ends, axis=0)))
    return (
        f"| {name} | {rule} | {q[1]:.1f} % [{q[0]:.1f}, {q[2]:.1f}] | {', '.join(f'{100 * p:.0f}' for p in prefer)} %"
        f" | {100 * own:.0f} % | {', '.join(words)} |"
    )


if __name__ == "__main__":
    main()
