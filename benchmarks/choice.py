"""What sessions choose, against exhaustive searches, in random states of simulated sessions of the preset
`paper-individuals`.

    python benchmarks/choice.py --states 1000 --write      into docs/results/accuracy.md

A state is what somebody answered to the first n of 25 trials, n from 5 to 24. In each one the acquisition's value (UCB,
float64) at the session's choice is compared with that of the best of 20,000 points that fill the feasible set evenly,
of the same after polishing, and of the best point known: Newton's method from 24 places of 25,000 points, of which
5,000 are on walls, and from the session's choice.
"""

import argparse
from pathlib import Path

import numpy as np
from pages import put

ROOT = Path(__file__).parents[1]
POINTS, WALLS, PLACES = 20_000, 5_000, 24
TOLERANCE = 1e-6


def states(study, count, seed=0):
    """`count` random states: stacked trials."""
    import jax

    from hilbo.simulation import simulate
    from hilbo.simulation.presets import PRESETS

    studies = -(-count // 400)
    sessions = []
    for k in range(studies):
        persons = simulate.people(study, PRESETS["paper-individuals"], 24, seed + k)
        sessions.append(simulate.simulate_study(study, persons, seed + k))
    everybody = jax.tree.map(lambda *leaves: np.concatenate(leaves), *sessions)
    rng = np.random.default_rng(seed)
    first = study.file.selection.space_filling
    cases = rng.permutation(24 * studies * (study.file.selection.trials - first))[:count]
    person, answers = np.divmod(cases, study.file.selection.trials - first)
    chosen = jax.tree.map(lambda leaf: leaf[person], everybody)
    return jax.vmap(lambda t, n: t.first(n))(chosen, answers + first), answers + first


def compare(study, trials):
    """Values (states,) of the session's choice, the best of 20,000, that polished, and the best known."""
    import equinox as eqx
    import jax
    import jax.numpy as jnp

    from hilbo import acquisition
    from hilbo.numerics import climbing
    from hilbo.ordinal_gp import fit
    from hilbo.session.choose import selection

    space, plan = study.space, selection.design(study, 0)
    many = jnp.asarray(space.candidates(POINTS, 0))
    every = jnp.concatenate([many, jnp.asarray(space.walls(WALLS, 0))])
    score = acquisition.UCB(study.file.selection.weight)
    box = {"from_box": space.from_box, "to_box": space.to_box, "feasible": space.feasible}

    @eqx.filter_jit
    def all_states(trials):
        def one(data):
            posterior = fit(study.gp, data, inference=study.inference, throw=False)

            def at(x):
                mean, variance = posterior.predict(x[None, :])
                return score(mean[0], variance[0])

            own = selection.point_after(selection.Choosing.of(study), plan, posterior, 0, study.file.selection.weight)
            values = score(*posterior.predict(every))
            inside = values[:POINTS]
            polished = acquisition.maximise(inside, many, at, **box, starts=1)
            rows = climbing.spread(values, every, PLACES, 0.05)
            starts = jnp.concatenate([own[None, :], every[rows]])
            usable = jnp.concatenate([jnp.ones(1, bool), values[rows] > -jnp.inf])
            known = climbing.climb(starts, usable, at, **box, steps=100)
            return jnp.stack([at(own), jnp.max(inside), polished.value, known.value])

        return jax.lax.map(one, trials)

    return np.asarray(all_states(trials))


def report(values, count):
    own = values[:, 0]
    lines = [
        f"Made by `python benchmarks/choice.py --states {count} --write`: {count} random states of simulated sessions",
        "of the preset `paper-individuals` (after 5 to 24 answers); differences of UCB, whose scale is the prior's sd,"
        " 1.",
        "",
        "| the session's choice against | states where lower by more than 1e-6 | lower by at most |"
        " higher on average | higher by at most |",
        "|---|---:|---:|---:|---:|",
    ]
    names = ("the best of 20,000 points", "the same, polished", "the best known point")
    for name, other in zip(names, values[:, 1:].T, strict=True):
        gain = own - other
        lower, least = np.sum(gain < -TOLERANCE), max(-gain.min(), 0)
        lines.append(f"| {name} | {lower} | {least:.1e} | {gain.mean():.1e} | {gain.max():.1e} |")
    return "\n".join(lines) + "\n"


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--states", type=int, default=1000)
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    import jax

    jax.config.update("jax_enable_x64", True)
    from hilbo.study.config import Study

    study = Study.load(ROOT / "hilbo" / "data" / "paper.toml")
    trials, _ = states(study, chosen.states, chosen.seed)
    text = report(compare(study, trials), chosen.states)
    print(text)
    if chosen.write:
        put("results/accuracy.md", "choice", text)


if __name__ == "__main__":
    main()
