"""Do the answers of earlier people help to choose the trials of later ones? Simulated studies, person after person.

    python benchmarks/earlier_people.py FILE [--studies 100] [--first 1000] [--design 12x15] [--reversed]
    python benchmarks/earlier_people.py FILE --write

FILE (JSON Lines) collects a row for each study and design; a run that was stopped goes on where it was. Two ways to
choose the trials of the same people, who answer with the same random numbers:

* *independent*: 5 space-filling renderings, then the maximum of UCB by a person's own answers;
* *earlier*: from the fourth person on, of the trials after the space-filling ones the second, fourth, ... is the
  maximum of a draw of the function that people share, given the answers of all earlier people (Thompson sampling);
  these renderings are drawn before the session begins. The model is learnt-2's: with its priors' medians for fewer than
  six earlier people, then learnt, again after every three people.

--reversed: the answers of the first quarter of the people are reversed, as by a scale that was read the wrong way.

Fixed before the first study: 12 people with 15 trials and 24 with 25; people like the paper's (paper-02, paper-03,
paper-05, ... paper-30) and functions drawn, 100 studies each, every study with a seed of its own from 1000. Two looks
at the interval, after 50 and after 100 studies. Earlier people become an option if the lower end of the 95 % interval
of the gain (regret by learnt-2, all answers) is above 0 for both groups together at 12 and at 24 people, and with
reversed people the gain is not below 0 by more than its error. --write puts the table into
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
from populations import by_recipe, chance_at, cohort_from, ends, highest, interval, lined, rounded  # noqa: E402
from populations import with_trials as study_with_trials  # noqa: E402
from populations_people import POPULATIONS  # noqa: E402
from rows import Rows  # noqa: E402

from hilbo import acquisition  # noqa: E402
from hilbo.kernels import gram  # noqa: E402
from hilbo.ordinal_gp import Trials, fit  # noqa: E402
from hilbo.population.learnt.rule import learn, learnt_function, not_learnt  # noqa: E402
from hilbo.population.rules.registry import RECIPES, RECOMMENDED  # noqa: E402
from hilbo.search.candidates import search_points  # noqa: E402
from hilbo.session.choose.selection import Choosing, design, point_after  # noqa: E402

FILLED, ALONE, ENOUGH, AGAIN, POINTS = 5, 3, 6, 3, 512
DESIGNS = ("12x15", "24x25")
WAYS = ("independent", "earlier")
REVERSED = ", reversed"


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("file", type=Path)
    options.add_argument("--studies", type=int, default=100)
    options.add_argument("--first", type=int, default=FIRST)
    options.add_argument("--design", choices=DESIGNS, action="append")
    options.add_argument("--reversed", action="store_true")
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    rows = Rows(chosen.file)
    if chosen.write:
        put("methods/which_method_tables.md", "earlier people", table(rows.rows))
        return
    known = {(row["population"], row["seed"], row["design"]) for row in rows}
    designs = [each + chosen.reversed * REVERSED for each in chosen.design or DESIGNS]
    for name, seed in scheduled(2 * chosen.studies, chosen.first):
        for each in designs:
            if (name, seed, each) not in known:
                began = time.perf_counter()
                row = {"population": name, "seed": seed, "design": each} | one_study(name, seed, each)
                rows.add(rounded(row | {"seconds": time.perf_counter() - began}))
                print(row, flush=True)


def one_study(name, seed, design_of):
    """Regret of both ways: how much less often a new person gives the highest answer than at the best rendering."""
    people, trials = map(int, design_of.removesuffix(REVERSED).split("x"))
    study = study_with_trials(POPULATIONS[name].study, trials)
    scene = POPULATIONS[name].scene(study, people, seed)
    candidates = search_points(study.space, seed)
    best = highest(study, scene.chance, candidates)
    found = {}
    for way in WAYS:
        answers = simulated(study, scene.persons, people, seed, way == "earlier", design_of.endswith(REVERSED))
        optimum = by_recipe(study, cohort_from(answers), RECOMMENDED, candidates)[2].x
        chances = chance_at(scene.chance, jnp.stack([best, optimum]))
        found[way] = float(chances[0] - chances[1])
    return {"regret": found}


def simulated(study, persons, people, seed, from_earlier, with_reversed):
    """All sessions, one after the other; stacked answers (people, trials)."""
    trials, plan = study.file.selection.trials, design(study, seed)
    answering, drawing = (jax.random.split(key, people) for key in (plan.key, jax.random.fold_in(plan.key, 1)))
    points = jnp.asarray(study.space.candidates(POINTS, seed))
    chosen = np.arange(trials) - FILLED
    drawn = (chosen > 0) & (chosen % 2 == 1)
    state = jax.vmap(lambda _: Trials.empty(trials, study.space.dim))(jnp.arange(people))
    learnt, nothing = None, jnp.zeros((trials, study.space.dim))
    for j in range(people):
        use, draws = from_earlier and j >= ALONE, nothing
        if use:
            learnt = of_earlier(learnt, state, len(study.responses), j)
            draws = _draws(learnt_function(learnt, state).function, points, drawing[j], trials)
        hypercube = jnp.asarray(study.space.latin_hypercube(FILLED, 1 + seed * people + j))
        given = (persons_row(persons, j), answering[j], hypercube, draws, jnp.asarray(drawn & use))
        answers = _session(study, plan, *given, with_reversed and j < people // 4)
        state = jax.tree.map(lambda leaf, own, j=j: leaf.at[j].set(own), state, answers)
    return state


def persons_row(persons, j):
    return jax.tree.map(lambda leaf: leaf[j], persons)


def of_earlier(learnt, state, categories, count):
    """The model by the answers of `count` earlier people; the others' rows are empty."""
    recipe = RECIPES[RECOMMENDED]
    if count < ENOUGH:
        return not_learnt(state, categories, recipe=recipe)
    if count % AGAIN == 0:
        return learn(state, categories, recipe=recipe)
    blank = not_learnt(state, categories, recipe=recipe).weights
    return eqx.tree_at(lambda each: each.weights, learnt, blank)  # the mode is searched from there


@eqx.filter_jit
def _draws(function, points, key, count):
    """Maxima (count, d) of as many draws of the shared function over the points."""
    cross = gram(function.gp.kernel, points, function.trials.x)
    covariance = gram(function.gp.kernel, points, points) - cross @ function.latent.inverse @ cross.T
    one = jax.vmap(lambda key: acquisition.thompson(key, cross @ function.latent.weights, covariance)[0])
    return points[one(jax.random.split(key, count))]


@eqx.filter_jit
def _session(study, plan, person, key, hypercube, draws, drawn, is_reversed):
    """Answers of one person; where `drawn` (trials,) is set, at the rows of `draws` (trials, d)."""
    trials, choosing, weight = study.file.selection.trials, Choosing.of(study), study.file.selection.weight

    def answered(data, x, trial):
        q = person.answer(jax.random.fold_in(key, trial), x, (trial / trials).astype(x.dtype))
        return data.append(x, jnp.where(is_reversed, len(study.responses) - 1 - q, q))

    def choose(data, trial):
        own = point_after(choosing, plan, fit(study.gp, data, throw=False), trial, weight)
        return answered(data, jnp.where(drawn[trial], draws[trial], own), trial), None

    data = Trials.empty(trials, study.space.dim)
    for trial in range(FILLED):
        data = answered(data, hypercube[trial], jnp.asarray(trial))
    return jax.lax.scan(choose, data, jnp.arange(FILLED, trials))[0]


def table(rows):
    """Regret of both ways, and the gain by earlier people with its 95 % interval, in the same people."""
    heads = ["people × trials", "studies of", "studies", *WAYS, "gain, 95 %"]
    lines = []
    for each in [size + more for more in ("", REVERSED) for size in DESIGNS]:
        for words, begins in GROUPS.items():
            part = [row for row in rows if row["design"] == each and row["population"].startswith(begins)]
            if len(part) > 1:
                by = {way: np.array([row["regret"][way] for row in part]) for way in WAYS}
                gain = ends(by["independent"] - by["earlier"], np.arange(len(part)))
                lines.append([each, words, str(len(part)), *map(interval, by.values()), gain])
    return lined(heads, lines)


if __name__ == "__main__":
    main()
