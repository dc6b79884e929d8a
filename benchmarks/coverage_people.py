"""How often the 95 % intervals of lapse rate and drift hold the truth, for simulated people who are what is fitted.

    python benchmarks/coverage_people.py [--people 400] [--write]

People have a latent function drawn from the prior plus a level of their own (sd 1), answer through the ordinal probit,
lapse at a rate and drift over the session. Renderings are of the paper's feasible set, by chance or as hilbo's session
chooses them: where people said "close" it asks again, and no answer is then independent of the others. --write puts the
table into docs/guides/report.md.
"""

import argparse
import json

import jax

jax.config.update("jax_enable_x64", True)

import equinox as eqx  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from pages import put  # noqa: E402
from populations import by_chance  # noqa: E402
from populations_people import FEATURES, PAPER  # noqa: E402

from hilbo.population.judged.response_quality import measure_people  # noqa: E402
from hilbo.simulation.simulate import simulate_study  # noqa: E402
from hilbo.study.config import Study  # noqa: E402

THETA = 5.0
CASES = [
    *((25, lapse, 0.0) for lapse in (0.0, 0.1, 0.3, 0.5)),
    *((25, lapse, drift) for lapse in (0.0, 0.1) for drift in (-1.0, -3.0, 2.0)),
    (100, 0.1, -1.0),
]
CHOICES = {
    "chance": by_chance,
    "session": lambda study, crowd, people, trials, seed: simulate_study(study, crowd, seed),
}


class Fitted(eqx.Module):
    """People whose functions are drawn from the model that is fitted; leading axis for several."""

    weights: jax.Array
    waves: jax.Array
    phases: jax.Array
    level: jax.Array
    thresholds: jax.Array
    noise: jax.Array
    lapse: jax.Array
    drift: jax.Array

    def answer(self, key, x, progress):
        feel, lapse, guess = jax.random.split(key, 3)
        score = jnp.cos(self.waves @ x + self.phases) @ self.weights + self.level + self.drift * (progress - 0.5)
        judged = jnp.sum(score + self.noise * jax.random.normal(feel, (), x.dtype) > self.thresholds)
        guessed = jax.random.randint(guess, (), 0, len(self.thresholds) + 1, judged.dtype)
        return jnp.where(jax.random.uniform(lapse, (), x.dtype) < self.lapse, guessed, judged)


def study_of(trials):
    """The paper's, with a smooth prior."""
    raw = {"schema": 1} | json.loads(PAPER.file.content)
    raw["gp"] |= {"theta": THETA, "variance": 1.0, "thresholds": [-0.5, 0.5], "noise": 0.5}
    raw["selection"] |= {"trials": trials}
    return Study.from_dict(raw)


def crowd(study, people, lapse, drift, seed):
    """Functions by random waves, with the prior's covariance up to their number."""
    rng = np.random.default_rng([seed, int(100 * lapse), int(10 * (6 + drift))])
    thresholds = np.asarray(study.gp.likelihood.thresholds)
    arrays = (
        np.sqrt(2.0 / FEATURES) * rng.standard_normal((people, FEATURES)),
        np.sqrt(2.0 * THETA) * rng.standard_normal((people, FEATURES, study.space.dim)),
        rng.uniform(0, 2 * np.pi, (people, FEATURES)),
        rng.standard_normal(people),
        np.tile(thresholds, (people, 1)),
        np.full(people, float(study.gp.likelihood.noise)),
        np.full(people, lapse),
        np.full(people, drift),
    )
    return Fitted(*map(jnp.asarray, arrays))


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--people", type=int, default=400)
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    lines = [
        f"Made by `python benchmarks/coverage_people.py --write`: {chosen.people} simulated participants a row.",
        "",
        "| trials | selection | lapse rate | drift | lapse: coverage, too high, median width"
        " | drift: coverage, median width |",
        "|---:|---|---:|---:|---:|---:|",
    ]
    for case in CASES:
        for choice in CHOICES:
            lines.append(row(*case, choice, chosen.people))
            print(lines[-1], flush=True)
    if chosen.write:
        put("guides/report.md", "coverage", "\n".join(lines))


def row(trials, lapse, drift, choice, people):
    """Shares of the intervals that hold the truth, and of the lapse rate's that are above it."""
    study = study_of(trials)
    answers = CHOICES[choice](study, crowd(study, people, lapse, drift, 0), people, trials, 0)
    table = measure_people(study.gp, answers, tuple(map(str, range(people))))
    rate, shift = ((table[f"{name}_low"], table[f"{name}_high"]) for name in ("lapse", "drift"))
    above = rate[0] > lapse + 1e-4
    held = ~above & (lapse <= rate[1])
    of_rate = f"{100 * held.mean():.1f} %, {100 * above.mean():.1f} %, {np.median(rate[1] - rate[0]):.2f}"
    held = (shift[0] <= drift) & (drift <= shift[1])
    of_shift = f"{100 * held.mean():.1f} %, {np.median(shift[1] - shift[0]):.2f}"
    return f"| {trials} | {choice} | {lapse:g} | {drift:g} | {of_rate} | {of_shift} |"


if __name__ == "__main__":
    main()
