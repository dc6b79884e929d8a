"""Table I of the paper re-enacted: the error of every aggregation rule, with people who differ more or less.

    python benchmarks/rules.py FOLDER --seeds 100 --write

FOLDER holds simulated studies (benchmarks/rules_sessions.py FOLDER --seeds 100 makes them first). For every study, 24
people x 25 trials under the study file's hyperparameters: the NRMSE to the truth of each rule's optimum, of the
individuals' optima and of their mean; the share of a rule's 95 % intervals that hold the true map; and the share that
people have in common, as learnt (from --share-answers answers of an even choice of people) and as it is.

The true map at x is the latent value under which the population's own probabilities of the answers there are likeliest:
what infinitely many answers at x would lead to. For the hierarchical rule the noise includes how people differ. A
person's true function likewise; the true share is the mean square of the functions' mean over their mean square.
Optima are the best of 2,048 feasible points, refined three times among 256 around the best. --write puts table and
figure into docs/methods/aggregation.md and docs/methods/aggregation.svg.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from rules_sessions import LEVELS, PEOPLE, ROOT, path_of, population
from scipy.special import ndtr

jax.config.update("jax_enable_x64", True)

import equinox as eqx  # noqa: E402
from pages import DOCS, put  # noqa: E402

from hilbo.errors import InputError  # noqa: E402
from hilbo.ordinal_gp import Trials, fit  # noqa: E402
from hilbo.population.maps import rule_map, share_of  # noqa: E402
from hilbo.population.rules.registry import GIVEN  # noqa: E402
from hilbo.simulation import simulate  # noqa: E402
from hilbo.study.config import Study  # noqa: E402

STUDY = Study.load(ROOT / "hilbo" / "data" / "paper.toml")
NAMES = ("hierarchical, by points", *GIVEN)
GRID = np.linspace(-3.0, 3.0, 601)
AROUND = (0.05, 0.02, 0.01)


@eqx.filter_jit
def fitted(trials):
    return jax.vmap(lambda person: fit(STUDY.gp, person, throw=False))(trials)


@eqx.filter_jit
def predict(map_, x):
    return map_.predict(x)


@eqx.filter_jit
def own_means(posteriors, x):
    return jax.vmap(lambda person: person.mean(x))(posteriors)


@jax.jit
def feasible(x):
    return STUDY.space.feasible(x)


def optimum(mean_of, points, rng):
    """The best of the points, and of others around it."""
    values = np.asarray(mean_of(points))
    best, height = points[values.argmax()], values.max()
    for width in AROUND:
        near = np.clip(best + width * rng.standard_normal((256, points.shape[1])), 0.0, 1.0)
        values = np.where(np.asarray(feasible(near)), np.asarray(mean_of(near)), -np.inf)
        if values.max() > height:
            best, height = near[values.argmax()], values.max()
    return best


def answers_of(persons, x):
    """Probabilities (persons, m, C) of the answers at x in the middle of a session, lapses included."""
    way = (x[None] - np.asarray(persons.optimum)[:, None]) / np.asarray(persons.tolerance)[:, None]
    felt = np.sqrt((way**2).sum(-1)) + 0.5 * np.asarray(persons.drift)[:, None]
    criteria = np.asarray(persons.criteria)[0]  # decreasing
    below = ndtr((criteria[:, None, None] - felt) / np.asarray(persons.noise)[:, None])
    edges = np.concatenate([np.ones((1, *felt.shape)), below, np.zeros((1, *felt.shape))])
    sharp = np.moveaxis(edges[:-1] - edges[1:], 0, -1)
    lapse = np.asarray(persons.lapse)[:, None, None]
    return (1 - lapse) * sharp + lapse / sharp.shape[-1]


def likeliest(chances, own_variance=0.0):
    """The latent value under which answers of these probabilities (..., C) are likeliest."""
    likelihood = STUDY.gp.likelihood
    spread = np.sqrt(float(likelihood.noise) ** 2 + own_variance)
    edges = np.concatenate([[-np.inf], np.asarray(likelihood.thresholds), [np.inf]])
    below = ndtr((edges[:, None] - GRID[None]) / spread)
    return GRID[(chances @ np.log(np.diff(below, axis=0))).argmax(axis=-1)]


def one_study(folder, level, seed, points, truth, chances, share_answers):
    stored = np.load(path_of(folder, level, seed))
    mask = jnp.ones(stored["q"].shape, bool)
    trials = Trials(jnp.asarray(stored["x"]), jnp.asarray(stored["q"]), mask)
    rng, gp = np.random.default_rng(seed), STUDY.gp
    posteriors = fitted(trials)
    learnt = share_of(gp, trials, largest=share_answers)
    row = {"share": float(learnt.mean), "low": float(learnt.interval[0]), "high": float(learnt.interval[1])}
    for name in NAMES:
        rule = name.partition(",")[0]
        largest = 0 if "by points" in name else 1500
        try:
            map_ = rule_map(gp, trials, rule, posteriors=posteriors, share=learnt.mean, largest=largest)
        except InputError:
            continue
        best = optimum(lambda x, map_=map_: predict(map_, jnp.asarray(x))[0], points, rng)
        row[f"miss {name}"] = np.sqrt(np.mean((best - truth) ** 2))
        mean, variance = (np.asarray(part) for part in predict(map_, jnp.asarray(points)))
        goal = likeliest(chances, float(1 - map_.share) * float(gp.kernel.variance))
        row[f"cover {name}"] = np.mean(np.abs(mean[:300] - goal) < 1.96 * np.sqrt(variance[:300]))
    means = np.asarray(own_means(posteriors, jnp.asarray(points)))
    own = points[means.argmax(axis=1)]
    row["miss individuals"] = np.median(np.sqrt(np.mean((own - truth) ** 2, axis=1)))
    row["miss mean of optima"] = np.sqrt(np.mean((own.mean(axis=0) - truth) ** 2))
    return row


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("folder", type=Path)
    options.add_argument("--seeds", type=int, default=100)
    options.add_argument("--share-answers", type=int, default=600)
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    points = np.asarray(STUDY.space.candidates(2048, 0))
    rows = {level: [] for level in LEVELS}
    true_share = {}
    for seed in range(chosen.seeds):
        for level in LEVELS:
            if not path_of(chosen.folder, level, seed).exists():
                continue
            people = population(level)
            truth = np.asarray(STUDY.space.to_unit(np.array([people.truth[name] for name in STUDY.space.names])))
            if level not in true_share:
                many = answers_of(simulate.people(STUDY, people, 1000, 10_000), points[:300])
                own = likeliest(many)
                true_share[level] = many.mean(axis=0), float(np.mean(own.mean(axis=0) ** 2) / np.mean(own**2))
            rows[level].append(
                one_study(chosen.folder, level, seed, points, truth, true_share[level][0], chosen.share_answers)
            )
            print(level, seed, {k: round(float(v), 3) for k, v in rows[level][-1].items()}, flush=True)
        if chosen.write:
            write(rows, {level: part[1] for level, part in true_share.items()}, chosen)


def table(rows, true_share, chosen):
    done = min(len(studies) for studies in rows.values())
    several = done > 1  # one study has no quartiles, and no coverage
    lines = [
        f"Made by `python benchmarks/rules.py FOLDER --seeds {done}"
        f" --share-answers {chosen.share_answers} --write`: {done} {'studies' if several else 'study'} of {PEOPLE} x 25"
        " at each level of differences between participants (0: all the same, 1: the preset `paper-individuals`).",
        "",
        f"| NRMSE to the truth in %{', median [quartiles]' if several else ''} | "
        + " | ".join(f"{level:g}" for level in LEVELS)
        + " |",
        "|---|" + "---:|" * len(LEVELS),
    ]
    for name in (*NAMES, "individuals", "mean of optima"):
        cells = []
        for level in LEVELS:
            q = 100 * np.percentile([row[f"miss {name}"] for row in rows[level]], [25, 50, 75])
            cells.append(f"{q[1]:.1f} [{q[0]:.1f}, {q[2]:.1f}]" if several else f"{q[1]:.1f}")
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    lines += ["", "| true map within the 95 % interval, % | " + " | ".join(f"{v:g}" for v in LEVELS) + " |"]
    lines.append("|---|" + "---:|" * len(LEVELS))
    for name in NAMES:
        cells = [f"{100 * np.mean([row[f'cover {name}'] for row in rows[level]]):.0f}" for level in LEVELS]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    lines += ["", "| share in common | " + " | ".join(f"{v:g}" for v in LEVELS) + " |"]
    lines.append("|---|" + "---:|" * len(LEVELS))
    lines.append("| true | " + " | ".join(f"{true_share[level]:.2f}" for level in LEVELS) + " |")
    mean = [f"{np.mean([row['share'] for row in rows[level]]):.2f}" for level in LEVELS]
    lines.append(f"| fitted{', mean over studies' if several else ''} | " + " | ".join(mean) + " |")
    if not several:
        return "\n".join(lines) + "\n"
    held = [100 * np.mean([row["low"] <= true_share[v] <= row["high"] for row in rows[v]]) for v in LEVELS]
    lines.append("| true within the 95 % interval, % | " + " | ".join(f"{v:.0f}" for v in held) + " |")
    return "\n".join(lines) + "\n"


def figure(rows):
    from matplotlib.figure import Figure

    colours = ("#0072B2", "#56B4E9", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#999999", "#000000", "#882255")
    markers = "osv^D<>PX"
    drawn = Figure(figsize=(7.2, 3.4), layout="constrained")
    left, right = drawn.subplots(1, 2)
    at = np.arange(len(LEVELS))
    for name, colour, marker in zip(NAMES, colours, markers, strict=True):
        miss = [100 * np.median([row[f"miss {name}"] for row in rows[level]]) for level in LEVELS]
        cover = [100 * np.mean([row[f"cover {name}"] for row in rows[level]]) for level in LEVELS]
        left.plot(at, miss, color=colour, marker=marker, markersize=4, linewidth=1, label=name)
        right.plot(at, cover, color=colour, marker=marker, markersize=4, linewidth=1)
    for name, style in (("individuals", ":"), ("mean of optima", "--")):
        miss = [100 * np.median([row[f"miss {name}"] for row in rows[level]]) for level in LEVELS]
        left.plot(at, miss, color="black", linestyle=style, linewidth=1, label=name)
    right.axhline(95, color="black", linewidth=0.6)
    for axes in (left, right):
        axes.set_xticks(at, [f"{level:g}" for level in LEVELS])
    drawn.supxlabel("differences between people (1: the preset)", fontsize="medium")
    left.set(ylabel="NRMSE of the optimum, median (%)", ylim=(0, None))
    right.set(ylabel="true map within the 95 % interval (%)", ylim=(0, 102))
    drawn.legend(loc="outside right upper", frameon=False, fontsize=7)
    return drawn


def write(rows, true_share, chosen):
    if not all(rows.values()):
        return
    put("methods/aggregation.md", "rules", table(rows, true_share, chosen))
    figure(rows).savefig(DOCS / "methods" / "aggregation.svg")


if __name__ == "__main__":
    main()
