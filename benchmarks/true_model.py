"""How good could an optimum be? The Bayes decision by the very model that the functions were drawn from.

    python benchmarks/true_model.py FILE [--studies 100] [--only NAME]
    python benchmarks/true_model.py FILE --write

Populations *functions* of benchmarks/populations.py, the same answers. Kernel, lengths, variances, noise and thresholds
are known here; only the functions are not. The optimum is where a new person most probably gives the highest answer.
The arithmetic is SciPy's on the covariance of all answers (Laplace), none of it hilbo's. FILE (JSON Lines) collects a
row for each study; a run that was stopped goes on. --write puts the table into docs/methods/which_method_tables.md.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from pages import put
from populations import FIRST, chance_at, highest, interval, with_trials
from populations_people import POPULATIONS, Functions
from rows import Rows
from scipy.linalg import cholesky, solve_triangular
from scipy.special import log_ndtr, ndtr

from hilbo.search.candidates import search_points
from hilbo.simulation.simulate import simulate_study

PEOPLE, TRIALS = 24, 25
VARIANCE, NOISE = 4.0, 1.0  # as populations_people draws them
NAMES = [name for name, population in POPULATIONS.items() if isinstance(population, Functions)]
KNOWN = Path(__file__).with_name("populations.jsonl")


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("file", type=Path)
    options.add_argument("--studies", type=int, default=100)
    options.add_argument("--only")
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    rows = Rows(chosen.file)
    if chosen.write:
        put("methods/which_method_tables.md", "true model", table(list(rows)))
        return
    known = {(row["population"], row["seed"]) for row in rows}
    for seed in range(FIRST, FIRST + chosen.studies):
        for name in NAMES:
            if (name, seed) not in known and chosen.only in (None, name):
                rows.add({"population": name, "seed": seed, "regret": round(regret(POPULATIONS[name], seed), 6)})


def regret(population, seed):
    """What is lost at the optimum by the true model."""
    study = with_trials(population.study, TRIALS)
    scene = population.scene(study, PEOPLE, seed)
    answers = simulate_study(study, scene.persons, seed)
    x, q = np.asarray(answers.x).reshape(-1, study.space.dim), np.asarray(answers.q).ravel()
    chance = predicted(population, x, q, np.asarray(scene.persons.thresholds[0]))
    candidates = np.asarray(search_points(study.space, seed))
    here = best_of(study.space, chance, candidates, np.random.default_rng(seed))
    points = np.stack([np.asarray(highest(study, scene.chance, candidates)), here])
    top, kept = np.asarray(chance_at(scene.chance, points))
    return float(top - kept)


def best_of(space, chance, candidates, rng):
    """The best of the candidates, and then of feasible points ever nearer to the best so far."""
    best = candidates[np.argmax(chance(candidates))]
    for width in (0.05, 0.02, 0.008, 0.003):
        near = np.vstack([best, best + width * rng.standard_normal((400, len(best)))])
        near = near[((near >= 0) & (near <= 1)).all(axis=1)]
        near = near[[bool(space.feasible(point)) for point in near]]
        best = near[np.argmax(chance(near))]
    return best


def predicted(population, x, q, thresholds):
    """The probability of a new person's highest answer, as a function of points (m, d) -> (m,)."""
    person = np.arange(len(q)) // TRIALS
    shared, own = VARIANCE * population.share, VARIANCE * (1 - population.share)
    alike = covariance(population, x, x)
    slope, root, factor = laplace(shared * alike + own * alike * (person[:, None] == person), q, thresholds)

    def chance(points):
        cross = shared * covariance(population, points, x)
        variance = shared - np.sum(solve_triangular(factor, root[:, None] * cross.T, lower=True) ** 2, axis=0)
        return ndtr((cross @ slope - thresholds[-1]) / np.sqrt(NOISE**2 + own + variance))

    return chance


def covariance(population, a, b):
    """Of variance 1: the RBF exp(-theta r^2), or the Matern 5/2 whose waves `Functions.scene` draws."""
    squares = 2 * population.theta * np.sum((a[:, None] - b) ** 2, axis=-1)
    if not population.matern:
        return np.exp(-squares / 2)
    r = np.sqrt(5 * squares)
    return (1 + r + r**2 / 3) * np.exp(-r)


def laplace(k, q, thresholds):
    """The mode's gradient (n,), the square root of the likelihood's curvature there (n,), and the Cholesky factor of
    I + W^1/2 K W^1/2. Newton's steps by Rasmussen & Williams (2006), algorithm 3.1, each halved until it ascends."""
    weights, value = np.zeros(len(q)), -np.inf
    while True:
        latent = k @ weights
        _, slope, curvature = likelihood(latent, q, thresholds)
        root = np.sqrt(curvature)
        factor = cholesky(np.eye(len(q)) + root[:, None] * k * root, lower=True)
        right = curvature * latent + slope
        inner = solve_triangular(factor, root * (k @ right), lower=True)
        step = right - root * solve_triangular(factor.T, inner, lower=False) - weights
        size, reached = 1.0, objective(k, weights + step, q, thresholds)
        while not reached >= value:
            size /= 2
            reached = objective(k, weights + size * step, q, thresholds)
        weights, gained, value = weights + size * step, reached - value, reached
        if gained < 1e-9:
            return slope, root, factor


def objective(k, weights, q, thresholds):
    latent = k @ weights
    return likelihood(latent, q, thresholds)[0] - weights @ latent / 2


def likelihood(latent, q, thresholds):
    """Log likelihood, its slopes (n,) and curvatures (n,), the latter with the sign changed; noise 1."""
    edges = np.concatenate([[-np.inf], thresholds, [np.inf]])
    above, below = edges[q + 1] - latent, edges[q] - latent
    flip = below > 0  # both in the left tail, where log_ndtr is exact
    a, b = log_ndtr(np.where(flip, -below, above)), log_ndtr(np.where(flip, -above, below))
    log_chance = a + np.log1p(-np.exp(b - a))
    upper, lower = (np.exp(-(edge**2) / 2 - log_chance) / np.sqrt(2 * np.pi) for edge in (above, below))
    slope = lower - upper
    finite_above, finite_below = (np.where(np.isfinite(edge), edge, 0.0) for edge in (above, below))
    return log_chance.sum(), slope, slope**2 + finite_above * upper - finite_below * lower


def table(rows):
    other = {(r["population"], r["seed"]): r["rules"] for r in map(json.loads, KNOWN.open()) if r["design"] == "24x25"}
    heads = ("the functions' population", "studies", "true model", "learnt-2", "learnt-1", "bcm")
    heads += ("true model / bcm", "learnt-2 minus true model")
    lines = ["| " + " | ".join(heads) + " |", "|---|" + "---:|" * (len(heads) - 1)]
    for name in NAMES:
        here = {row["seed"]: row["regret"] for row in rows if row["population"] == name}
        seeds = sorted(seed for seed in here if (name, seed) in other)
        columns = {"true model": np.array([here[seed] for seed in seeds])}
        for rule in ("learnt-2", "learnt-1", "bcm"):
            columns[rule] = np.array([other[name, seed][rule]["regret"] for seed in seeds])
        cells = [f"{np.mean(v):.3f} ± {np.std(v, ddof=1) / len(v) ** 0.5:.3f}" for v in columns.values()]
        ratio = np.mean(columns["true model"]) / np.mean(columns["bcm"])
        paired = interval(columns["learnt-2"] - columns["true model"])
        lines.append(f"| `{name}` | {len(seeds)} | {' | '.join(cells)} | {ratio:.2f} | {paired} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
