"""Is the population's optimum better where later people begin from the map of the earlier ones? Simulated studies.

    python benchmarks/warm_waves.py FILE [--studies 4] [--first 1000]
    python benchmarks/warm_waves.py FILE --write      into docs/guides/sessions.md

24 people with 25 trials each, by learnt-2. *cold*: everybody's session begins without a map. *waves*: so do those of
the first eight; their map chooses for the next eight, as `hilbo session --warm-start` does, and that of sixteen for the
last. *Regret* is that of benchmarks/populations.py: how much less often a new person gives the highest answer at the
optimum than at the best feasible rendering. The table has a third way beside these, from benchmarks/populations.jsonl:
learnt-2 of sessions whose renderings the model of paper.toml chose. FILE (JSON Lines) collects a row for each study;
what has been run is in benchmarks/warm_waves.jsonl.
"""

import argparse
import os
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax

jax.config.update("jax_enable_x64", True)

import equinox as eqx  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from pages import put  # noqa: E402
from populations import by_recipe, chance_at, cohort_from, highest, interval, lined, rounded, with_trials  # noqa: E402
from populations_people import POPULATIONS  # noqa: E402
from rows import Rows  # noqa: E402

from hilbo.ordinal_gp import Trials, fit  # noqa: E402
from hilbo.population.maps import learnt_map  # noqa: E402
from hilbo.population.rules.registry import RECOMMENDED  # noqa: E402
from hilbo.search.candidates import search_points  # noqa: E402
from hilbo.session.choose.warm_start import warm_point, warm_start  # noqa: E402
from hilbo.simulation.simulate import simulate_study  # noqa: E402
from hilbo.study.estimate.learnt import resolved, that_learns  # noqa: E402
from hilbo.study.estimate.optimum import predict_map  # noqa: E402

NAMES = (
    "paper-individuals",
    "paper-individuals, differences × 0",
    "truth anywhere, a third at a wall",
    "paper-04",
    "paper-18",
    "functions, RBF, theta 4",
)
PEOPLE, TRIALS, WAVE = 24, 25, 8


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("file", type=Path)
    options.add_argument("--studies", type=int, default=4)
    options.add_argument("--first", type=int, default=1000)
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    rows = Rows(chosen.file)
    if chosen.write:
        put("guides/sessions.md", "warm waves", table(list(rows)))
        return
    known = {(row["population"], row["seed"]) for row in rows}
    for seed in range(chosen.first, chosen.first + chosen.studies):
        for name in NAMES:
            if (name, seed) not in known:
                row = {"population": name, "seed": seed} | one_study(name, seed)
                rows.add(rounded(row))
                print(row, flush=True)


def one_study(name, seed):
    """The regret of both ways."""
    study = with_trials(POPULATIONS[name].study, TRIALS)
    scene, learns = POPULATIONS[name].scene(study, PEOPLE, seed), that_learns(study)
    candidates = search_points(study.space, seed)
    cold = simulate_study(learns, scene.persons, seed)
    ways = {"cold": cold, "waves": in_waves(learns, scene.persons, cold, seed, candidates)}
    top = chance_at(scene.chance, highest(study, scene.chance, candidates)[None, :])[0]
    regret = {}
    for way, trials in ways.items():
        optimum = by_recipe(study, cohort_from(trials), RECOMMENDED, candidates)[2]
        regret[way] = float(top - chance_at(scene.chance, optimum.x[None, :])[0])
    return regret


def in_waves(learns, persons, cold, seed, candidates):
    """Everybody's trials; the first wave's are the cold ones."""
    trials = jax.tree.map(lambda leaf: leaf[:WAVE], cold)
    for begun in range(WAVE, PEOPLE, WAVE):
        learnt = resolved(learns, cohort_from(trials)).learnt
        warm = warm_start(learns, candidates, *predict_map(learnt_map(learnt, trials), candidates), "simulated")
        wave = jax.tree.map(lambda leaf, begun=begun: leaf[begun : begun + WAVE], eqx.filter(persons, eqx.is_array))
        keys = jax.random.split(jax.random.key(5000 + seed + begun), WAVE)
        more = from_map(learns, eqx.combine(wave, persons), keys, warm)
        trials = jax.tree.map(lambda *parts: jnp.concatenate(parts), trials, more)
    return trials


@eqx.filter_jit
def from_map(learns, persons, keys, warm):
    """Sessions of new people, whose every trial the map and their own answers choose."""

    def one(person, key):
        def step(trials, trial):
            x = warm_point(learns, warm, fit(learns.gp, trials, throw=False))
            answer = person.answer(jax.random.fold_in(key, trial), x, (trial / TRIALS).astype(x.dtype))
            return trials.append(x, answer), None

        return jax.lax.scan(step, Trials.empty(TRIALS, learns.space.dim), jnp.arange(TRIALS))[0]

    return jax.lax.map(lambda args: one(*args), (persons, keys))


def table(rows):
    fixed = {
        (row["population"], row["seed"]): row["rules"][RECOMMENDED]["regret"]
        for row in Rows(Path(__file__).with_name("populations.jsonl"))
        if row["design"] == f"{PEOPLE}x{TRIALS}"
    }
    rows = [row | {"fixed": fixed[row["population"], row["seed"]]} for row in rows]
    lines = []
    for name in (*NAMES, "all"):
        part = [row for row in rows if name in (row["population"], "all")]
        given, cold, waves = (np.array([row[way] for row in part]) for way in ("fixed", "cold", "waves"))
        cells = map(interval, (given, cold, waves, waves - given, waves - cold))
        lines.append([name if name == "all" else f"`{name}`", str(len(part)), *cells])
    return lined(
        ["regret: populations", "studies", "fixed", "cold", "waves", "waves minus fixed", "waves minus cold"], lines
    )


if __name__ == "__main__":
    main()
