"""Do trials with two renderings, both classified, find a better rendering in the same minutes? Simulated studies.

    python benchmarks/pairs.py FILE [--studies 100] [--first 1000] [--noise 1.2] [--second variance]
    python benchmarks/pairs.py FILE --write

FILE (JSON Lines) collects a row for each study and design; a run that was stopped goes on where it was. 24 people. From
the paper's durations a trial with one rendering takes 26 s, and one with two renderings after one reference 30 s: 25
trials with one rendering (650 s) are compared with 21 trials with two (630 s, 42 answers), in the same people. The
first 5 renderings, of pairs the first 6, are space-filling. The first rendering of a later pair maximises UCB; the
second does so given that the first is answered, by one of

* *variance*: the variance of the posterior that follows the first one's most probable response, and the mean before it
  (GP-BUCB, Desautels, Krause & Burdick 2014, JMLR 15:4053);
* *believer*: that posterior.

Which of a pair is presented first is random. --noise: the standard deviation of the response noise of the rendering
presented second, over that of the first. The aggregation, learnt-2, does not know of it.

Fixed before the first study that is reported: the second rendering is chosen by *variance*; on paper-01, paper-04, ...
paper-16 and five populations of functions, seed 0, --noise 1.2, the regret of *believer* was .005 ± .008 higher, and
the published method was preferred. Reported: 100 studies of paper-02, paper-03, paper-05, ... paper-30, and 100 of the
functions drawn, every study with a seed of its own from 1000; half of them at 1.0 and 1.4. Two looks at the interval,
after 50 and after 100 studies. Two renderings a trial are recommended if the lower end of the 95 % interval of the gain
at 1.2 is above 0 for both groups. --write puts the table into docs/methods/which_method_tables.md.
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
from populations import by_recipe, chance_at, cohort_from, ends, highest, interval, lined, rounded  # noqa: E402
from populations_people import POPULATIONS  # noqa: E402
from rows import Rows  # noqa: E402

from hilbo.ordinal_gp import Trials, fit  # noqa: E402
from hilbo.population.rules.registry import RECOMMENDED  # noqa: E402
from hilbo.search.candidates import search_points  # noqa: E402
from hilbo.session.choose.selection import Choosing, design, point_after  # noqa: E402
from hilbo.simulation.simulate import simulate_study  # noqa: E402

PEOPLE, PAIRS, FILLED, FIRST = 24, 21, 3, 1000
NOISES = (1.0, 1.2, 1.4)
SINGLE = "one rendering"
PAPER = [name for name in POPULATIONS if name[6:].isdigit()]
FUNCTIONS = [name for name in POPULATIONS if name.startswith("functions")]
GROUPS = {"people like the paper's": "paper", "functions drawn": "functions", "both": ""}


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("file", type=Path)
    options.add_argument("--studies", type=int, default=100)
    options.add_argument("--first", type=int, default=FIRST)
    options.add_argument("--noise", type=float, action="append")
    options.add_argument("--second", choices=("variance", "believer"), action="append")
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    rows = Rows(chosen.file)
    if chosen.write:
        put("methods/which_method_tables.md", "pairs", table(rows.rows))
        return
    known = {(row["population"], row["seed"], row["design"]) for row in rows}
    designs = [
        SINGLE,
        *(f"{way}, {noise}" for noise in chosen.noise or NOISES for way in chosen.second or ["variance"]),
    ]
    for name, seed in scheduled(2 * chosen.studies, chosen.first):
        for each in designs:
            if (name, seed, each) in known:
                continue
            began = time.perf_counter()
            row = {"population": name, "seed": seed, "design": each, "regret": regret(name, seed, each)}
            rows.add(rounded(row | {"seconds": time.perf_counter() - began}))
            print(row, flush=True)


def scheduled(studies, first):
    """Population and seed of each study: people like the paper's and functions in turn, no seed twice. Seeds below 1000
    are for choices, which have presets of their own."""
    paper = [name for name in PAPER if (int(name[6:]) % 3 != 1) == (first >= FIRST)]
    for number in range(studies):
        group = (paper, FUNCTIONS)[number % 2]
        yield group[number // 2 % len(group)], first + number


def regret(name, seed, design_of):
    """How much less often a new person gives the highest answer at the optimum found than at the best rendering."""
    study = POPULATIONS[name].study
    scene = POPULATIONS[name].scene(study, PEOPLE, seed)
    if design_of == SINGLE:
        answers = simulate_study(study, scene.persons, seed)
    else:
        way, noise = design_of.split(", ")
        answers = simulate_pairs(study, scene.persons, seed, float(noise), way)
    candidates = search_points(study.space, seed)
    optimum = by_recipe(study, cohort_from(answers), RECOMMENDED, candidates)[2].x
    best = highest(study, scene.chance, candidates)
    chances = chance_at(scene.chance, jnp.stack([best, optimum]))
    return float(chances[0] - chances[1])


def simulate_pairs(study, persons, seed, noise, way):
    """All sessions with two renderings a trial; stacked answers (24, 42), a trial's two in the order presented."""
    count, filled = PEOPLE, 2 * FILLED
    plan = design(study, seed)
    hypercubes = [study.space.latin_hypercube(filled, 1 + seed * count + i) for i in range(count)]
    answering, drawing = (jax.random.split(key, count) for key in (plan.key, jax.random.fold_in(plan.key, 1)))
    return _simulate(study, plan, jnp.asarray(np.stack(hypercubes)), persons, answering, drawing, noise, way)


@eqx.filter_jit
def _simulate(study, plan, hypercubes, persons, answering, drawing, noise, way):
    later = eqx.tree_at(lambda p: p.noise, persons, persons.noise * noise)
    choosing, weight = Choosing.of(study), study.file.selection.weight

    def second_of(data, posterior, first, trial):
        likely = jnp.argmax(posterior.class_probabilities(first[None, :])[0])
        after = fit(study.gp, data.append(first, likely), throw=False)
        if way == "variance":
            after = eqx.tree_at(lambda p: p.latent.weights, after, posterior.latent.weights)
        return point_after(choosing, plan, after, trial, weight)

    def chosen(data, key, trial):
        posterior = fit(study.gp, data, throw=False)
        first = point_after(choosing, plan, posterior, trial, weight)
        pair = jnp.stack([first, second_of(data, posterior, first, trial)])
        return jnp.where(jax.random.bernoulli(jax.random.fold_in(key, trial)), pair, pair[::-1])

    def answered(data, person, and_later, key, pair, trial):
        progress = (trial / PAIRS).astype(pair.dtype)
        for position, (x, who) in enumerate(zip(pair, (person, and_later), strict=True)):
            data = data.append(x, who.answer(jax.random.fold_in(key, 2 * trial + position), x, progress))
        return data

    def of_all(state, pairs, trial):
        each = jax.vmap(answered, in_axes=(0, 0, 0, 0, 0, None))
        return each(state, persons, later, answering, pairs, trial), None

    def filling(state, trial):
        return of_all(state, jax.lax.dynamic_slice_in_dim(hypercubes, 2 * trial, 2, axis=1), trial)

    def choose(state, trial):
        return of_all(state, jax.vmap(chosen, in_axes=(0, 0, None))(state, drawing, trial), trial)

    empty = jax.vmap(lambda _: Trials.empty(2 * PAIRS, study.space.dim))(jnp.arange(PEOPLE))
    state, _ = jax.lax.scan(filling, empty, jnp.arange(FILLED))
    return jax.lax.scan(choose, state, jnp.arange(FILLED, PAIRS))[0]


def table(rows):
    """Regret of both designs, and the gain by two renderings a trial with its 95 % interval, in the same people."""
    heads = ["studies of", "studies", "one rendering a trial"]
    heads += [f"gain by two, {noise:g} × noise, 95 %" for noise in NOISES]
    known = {(row["population"], row["seed"], row["design"]): row["regret"] for row in rows if row["seed"] >= FIRST}
    lines = []
    for words, begins in GROUPS.items():
        of = [key[:2] for key in known if key[2] == SINGLE and key[0].startswith(begins)]
        cells = [words, str(len(of)), interval(np.array([known[*key, SINGLE] for key in of]))]
        for noise in NOISES:
            both = [key for key in of if (*key, f"variance, {noise}") in known]
            if len(both) < 2:
                cells.append("–")
                continue
            gains = np.array([known[*key, SINGLE] - known[*key, f"variance, {noise}"] for key in both])
            cells.append(ends(gains, np.arange(len(both))) + ("" if len(both) == len(of) else f" ({len(both)})"))
        lines.append(cells)
    return lined(heads, lines)


if __name__ == "__main__":
    main()
