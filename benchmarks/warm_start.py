"""How many trials a warm start saves: new simulated participants with and without the map of an earlier study.

    python benchmarks/warm_start.py [--people 100] [--markdown]

A map is made from 24 simulated participants of the preset `paper`; as many new people as asked for, drawn from the same
population, then answer the study's trials, chosen cold (5 space-filling trials, then UCB) or from the map (after some
space-filling trials or none). After every trial each person's best rendering is read from their own answers under the
study's prior, as aggregation does: the candidate with the highest posterior mean. It is judged by the truth that was
simulated: the probability that this person would answer "close" to it, and its distance from their optimum.
"""

import argparse
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from hilbo import Study
from hilbo.ordinal_gp import Trials, fit
from hilbo.session import design, next_point, search_points
from hilbo.simulate import PRESETS, Person, people, simulate_study
from hilbo.study import population
from hilbo.warm_start import warm_point, warm_start

TRIALS = 25


@eqx.filter_jit
def sessions(study: Study, persons: Person, initial, keys, plan, points, warm):
    """Everybody's trials (M, ...) and, after each, the point they would choose: (M, trials, d)."""

    def one(person, first, key):
        def step(trials, trial):
            chosen = next_point(study, plan, trials, trial) if warm is None else warm_point(study, warm, trials)
            count = first.shape[0]
            x = jnp.where(trial < count, first[jnp.minimum(trial, count - 1)], chosen) if count else chosen
            progress = (trial / TRIALS).astype(x.dtype)
            trials = trials.append(x, person.answer(jax.random.fold_in(key, trial), x, progress))
            own = fit(study.gp, trials, inference=study.inference, throw=False)
            return trials, points[jnp.argmax(own.astype(jnp.float32).mean(points.astype(jnp.float32)))]

        empty = Trials.empty(TRIALS, study.space.dim)
        return jax.lax.scan(step, empty, jnp.arange(TRIALS))

    return jax.lax.map(lambda args: one(*args), (persons, initial, keys))


def judged(persons: Person, best) -> dict[str, np.ndarray]:
    """(M, trials) each: probability of "close", and NRMSE from the own optimum."""
    apart = (np.asarray(best) - np.asarray(persons.optimum)[:, None]) / np.asarray(persons.tolerance)[:, None]
    felt = np.sqrt((apart**2).sum(-1))
    criterion = np.asarray(persons.criteria)[:, -1:]
    z = (criterion - felt) / np.asarray(persons.noise)[:, None]
    lapse = np.asarray(persons.lapse)[:, None]
    close = (1 - lapse) * np.asarray(jax.scipy.special.ndtr(z)) + lapse / 3
    miss = np.sqrt(((np.asarray(best) - np.asarray(persons.optimum)[:, None]) ** 2).mean(-1))
    return {"close": close, "nrmse": miss}


def reached(curve, target):
    """The first trial after which the curve stays at or above the target; None if never."""
    below = np.flatnonzero(curve < target)
    first = 0 if not len(below) else int(below[-1]) + 1
    return None if first >= len(curve) else first + 1


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--people", type=int, default=100)
    parser.add_argument("--earlier", type=int, default=24)
    parser.add_argument("--share", type=float, nargs="*", default=[0.5])
    parser.add_argument("--filling", type=int, nargs="*", default=[0, 2, 5])
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    study = Study.load(Path(__file__).parents[1] / "hilbo" / "data" / "paper.toml")
    preset = PRESETS["paper"]
    earlier = simulate_study(study, people(study, preset, args.earlier, args.seed), args.seed)
    posteriors = jax.vmap(lambda t: fit(study.gp, t, inference=study.inference, throw=False))(earlier)
    points = search_points(study.space, args.seed)
    mean, variance = population(posteriors, points)
    new = people(study, preset, args.people, args.seed + 1)
    keys = jax.random.split(jax.random.key(args.seed + 2), args.people)
    plan = design(study, args.seed)
    filling = np.stack([study.space.latin_hypercube(5, 1000 + i) for i in range(args.people)])
    _, best = sessions(study, new, jnp.asarray(filling), keys, plan, points, None)
    cold = judged(new, best)
    target = cold["close"].mean(0)[-1]
    print(f"cold, 25 trials: P(close) {target:.3f}, NRMSE {np.median(cold['nrmse'][:, -1]):.3f} (median)")
    heads = ("start", "space-filling", "P(close) after 5", "10", "15", "25", "median NRMSE", "trials to the cold 25's")
    print("| " + " | ".join((*heads, "gain there, paired")) + " |")
    print("|---|---|---|---|---|---|---|---|---|")
    row("cold", 5, cold, cold)
    everybody = jnp.broadcast_to(points[jnp.argmax(mean)], (args.people, 1, study.space.dim))
    same = judged(new, everybody)
    print(
        f"the map's own best, felt by nobody: P(close) {same['close'].mean():.3f}, NRMSE {np.median(same['nrmse']):.3f}"
    )
    for share in args.share:
        warm = warm_start(study, points, mean, variance, "simulated", share)
        for count in args.filling:
            _, best = sessions(study, new, jnp.asarray(filling[:, :count]), keys, plan, points, warm)
            row(f"map, p = {share:g}", count, judged(new, best), cold)
            sys.stdout.flush()


def row(name, count, found, cold):
    target = cold["close"].mean(0)[-1]
    curve = found["close"].mean(0)
    error = found["close"].std(0, ddof=1) / np.sqrt(len(found["close"]))
    cells = [f"{curve[n - 1]:.3f}" for n in (5, 10, 15)] + [f"{curve[24]:.3f} ± {error[24]:.3f}"]
    when = reached(curve, target)
    miss = np.median(found["nrmse"][:, -1])
    gain = found["close"][:, (when or TRIALS) - 1] - cold["close"][:, -1]
    paired = f"{gain.mean():+.3f} ± {gain.std(ddof=1) / np.sqrt(len(gain)):.3f}"
    print(f"| {name} | {count} | " + " | ".join(cells) + f" | {miss:.3f} | {when or '> 25'} | {paired} |")


if __name__ == "__main__":
    main()
