"""How many trials a warm start saves: new simulated participants with and without the map of an earlier study.

    python benchmarks/warm_start.py [--people 100] [--studies 10]

Each of some earlier studies makes a map from 24 simulated participants of the preset `paper-individuals`; new people,
drawn from the same population and dealt among the studies, then answer 25 trials, chosen cold (5 space-filling trials,
then UCB) or from the map (after some space-filling trials or none). After every trial each person's best rendering is
read from their own answers under the study's prior, as aggregation does: the candidate with the highest posterior mean.
It is judged by the truth that was simulated: the probability that this person would answer "close" to it, and its
distance from their optimum.
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
from hilbo.search.candidates import search_points
from hilbo.session.choose.selection import Choosing, design, point_after
from hilbo.session.choose.warm_start import warm_point, warm_start
from hilbo.simulation.presets import PRESETS
from hilbo.simulation.simulate import Person, people, simulate_study
from hilbo.study.estimate.optimum import predict_people

TRIALS = 25


@eqx.filter_jit
def sessions(study: Study, persons: Person, initial, keys, plan, points, warm):
    """Everybody's trials (M, ...) and, after each, the point they would choose: (M, trials, d)."""

    def one(person, first, key):
        def step(trials, trial):
            before = fit(study.gp, trials, inference=study.inference, throw=False)
            if warm is None:
                chosen = point_after(Choosing.of(study), plan, before, trial, study.file.selection.weight)
            else:
                chosen = warm_point(study, warm, before)
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


def studied(study, seed, count, fillings, share):
    """One earlier study and the new people after it: start -> what `judged` says of them."""
    preset, points = PRESETS["paper-individuals"], search_points(study.space, seed)
    earlier = simulate_study(study, people(study, preset, 24, seed), seed)
    posteriors = jax.vmap(lambda t: fit(study.gp, t, inference=study.inference, throw=False))(earlier)
    mean, variance = predict_people(posteriors, points)
    new = people(study, preset, count, 1000 + seed)
    keys = jax.random.split(jax.random.key(2000 + seed), count)
    filling = np.stack([study.space.latin_hypercube(5, 3000 + seed * count + i) for i in range(count)])
    plan = design(study, seed)
    everybody = jnp.broadcast_to(points[jnp.argmax(mean)], (count, 1, study.space.dim))
    judgements = {"the map's own best": judged(new, everybody)}
    judgements["cold"] = judged(new, sessions(study, new, jnp.asarray(filling), keys, plan, points, None)[1])
    warm = warm_start(study, points, mean, variance, "simulated", share)
    for number in fillings:
        best = sessions(study, new, jnp.asarray(filling[:, :number]), keys, plan, points, warm)[1]
        judgements[f"map, {number} space-filling trials"] = judged(new, best)
    return judgements


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--people", type=int, default=100)
    parser.add_argument("--studies", type=int, default=10, help="earlier studies, among which the people are dealt")
    parser.add_argument("--share", type=float, default=0.5)
    parser.add_argument("--filling", type=int, nargs="*", default=[0, 2])
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    study = Study.load(Path(__file__).parents[1] / "hilbo" / "data" / "paper.toml")
    parts = []
    for k in range(args.studies):
        parts.append(studied(study, args.seed + k, args.people // args.studies, args.filling, args.share))
        print(f"study {k + 1} of {args.studies}", file=sys.stderr, flush=True)
    merged = {
        name: {key: np.concatenate([part[name][key] for part in parts]) for key in ("close", "nrmse")}
        for name in parts[0]
    }
    alone = merged.pop("the map's own best")
    close, miss = alone["close"].mean(), np.median(alone["nrmse"])
    print(f"The maps' own bests, felt by nobody: P(close) {close:.3f}, median NRMSE {miss:.3f}.\n")
    heads = (
        "start",
        "P(close) after 5",
        "10",
        "15",
        "25",
        "median NRMSE",
        "trials to the cold 25's",
        "gain there, paired",
    )
    print("| " + " | ".join(heads) + " |\n|" + "---|" * len(heads))
    for name, judgement in merged.items():
        row(name, judgement, merged["cold"])


def row(name, judgement, cold):
    target = cold["close"].mean(0)[-1]
    curve = judgement["close"].mean(0)
    error = judgement["close"].std(0, ddof=1) / np.sqrt(len(judgement["close"]))
    cells = [f"{curve[n - 1]:.3f}" for n in (5, 10, 15)] + [f"{curve[24]:.3f} ± {error[24]:.3f}"]
    when = reached(curve, target)
    miss = np.median(judgement["nrmse"][:, -1])
    gain = judgement["close"][:, (when or TRIALS) - 1] - cold["close"][:, -1]
    paired = f"{gain.mean():+.3f} ± {gain.std(ddof=1) / np.sqrt(len(gain)):.3f}"
    print(f"| {name} | " + " | ".join(cells) + f" | {miss:.3f} | {when or '> 25'} | {paired} |")


if __name__ == "__main__":
    main()
