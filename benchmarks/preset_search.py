"""Populations that agree with the paper's individuals and with its validation: a search, by simulated studies.

    python benchmarks/preset_search.py FILE [--first 500] [--rounds 3] [--per-round 150] [--again 3]
    python benchmarks/preset_search.py FILE --write

FILE (JSON Lines) collects a row for each simulated study; a run that was stopped goes on where it was. The first round
draws populations from wide ranges; each later one draws near the best so far (population Monte Carlo); then the best 60
are simulated again, on other seeds. --write puts the best 30 into hilbo/data/populations.toml. Compared are what
individuals of 24 x 25 trials by the paper's method did (answers "close", their optima, how far these are from the
truth) and the classes of best, mid and worst in the validation. The preferences of the validation, the comparison of
the aggregate with individuals' sets and the close-dominant intervals are held out; benchmarks/presets.py reports them
on fresh seeds.
"""

import argparse
import re
from itertools import combinations
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from rows import Rows  # noqa: E402

from hilbo.population.maps import rule_map  # noqa: E402
from hilbo.search.candidates import search_points  # noqa: E402
from hilbo.simulation.simulate import Population, people, simulate_study  # noqa: E402
from hilbo.study.analysis.best_mid_worst import best_mid_worst  # noqa: E402
from hilbo.study.cohort import Cohort  # noqa: E402
from hilbo.study.config import Study  # noqa: E402
from hilbo.study.estimate.aggregate import fit_cohort  # noqa: E402
from hilbo.study.estimate.optimum import individual_optima  # noqa: E402

DATA = Path(__file__).parents[1] / "hilbo" / "data"
FILE, STUDY = DATA / "populations.toml", Study.load(DATA / "paper.toml")
TRUTH = {"K1": 5.70, "B1": 5.89, "alpha": 0.203}
CROWD = 1000  # new people who validate
AGAIN = 101  # the first of the seeds on which the best are simulated again
BEST, KEPT = 60, 30  # populations that a round is drawn near, and that become presets

RANGES = {  # from, to; all but `contrast` and `lapse` on a logarithmic scale
    "spread K1": (0.08, 0.5),
    "spread B1": (0.02, 0.25),
    "spread alpha": (0.02, 0.25),
    "tolerance K1": (0.04, 0.6),
    "tolerance B1": (0.04, 0.6),
    "tolerance alpha": (0.02, 0.3),
    "tolerance sd": (0.05, 0.9),
    "similar to close": (1.2, 7.0),
    "noise": (0.05, 1.2),
    "drift": (0.05, 1.0),
    "lapse": (0.0, 0.12),
    "contrast": (0.0, 1.0),
}
LINEAR = ("lapse", "contrast")
NAMES = tuple(RANGES)

# What the paper says, and how far chance alone takes a study of 24 people, or 20 in the validation, from its mean.
PAPER = {
    "close": (5.96, 0.91),
    "close sd": (4.47, 0.65),
    "nrmse 25": (13.0, 2.5),
    "nrmse 50": (24.0, 4.0),
    "nrmse 75": (41.0, 6.0),
    "K1": (8.44, 1.68),
    "B1": (10.28, 1.76),
    "alpha": (0.282, 0.029),
    "K1 sd": (8.25, 1.19),
    "B1 sd": (8.64, 1.25),
    "alpha sd": (0.140, 0.020),
}
CLASSES = {"best": (2, 11, 147), "mid": (22, 114, 24), "worst": (121, 39, 0)}  # different, similar, close; of 160
CLUSTERED = 3.0  # 8 answers of one person are worth fewer: their variance is about so much larger


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("file", type=Path)
    options.add_argument("--first", type=int, default=500)
    options.add_argument("--rounds", type=int, default=3)
    options.add_argument("--per-round", type=int, default=150)
    options.add_argument("--again", type=int, default=3)
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    search = Search(chosen.file)
    if chosen.write:
        write([place for number, place in search.ranked() if search.studies(number) > 1][:KEPT])
        return
    rng = np.random.default_rng(18)
    for number in range(chosen.first):
        search.study(number, rng.uniform(size=len(NAMES)), seed=0)
    for round_ in range(chosen.rounds):
        rng = np.random.default_rng([18, 1 + round_])
        begin = chosen.first + round_ * chosen.per_round
        best = np.array([place for _, place in search.best(begin)])
        spread = 1.4 * np.linalg.cholesky(np.cov(best.T) + 1e-4 * np.eye(len(NAMES)))
        for k in range(chosen.per_round):
            near = reflected(best[rng.integers(len(best))] + spread @ rng.standard_normal(len(NAMES)))
            search.study(begin + k, near, seed=1 + round_)
    for number, place in search.best(chosen.first + chosen.rounds * chosen.per_round):
        for seed in range(AGAIN, AGAIN + chosen.again):
            search.study(number, place, seed)


class Search:
    """Rows of a file: a population's number, its place in the unit cube of RANGES, a seed, and what came out."""

    def __init__(self, path):
        self._rows = Rows(path)
        self._known = {(row["number"], row["seed"]) for row in self._rows}

    def study(self, number, place, seed):
        if (number, seed) in self._known:
            return
        came = one_study(population_at(place), seed, number)
        row = {"number": number, "seed": seed, "place": [round(float(p), 6) for p in place], "came": came}
        row["distance"] = distance([came])
        self._rows.add(row)
        self._known.add((number, seed))
        print(number, seed, round(row["distance"], 1), flush=True)

    def studies(self, number):
        return sum(row["number"] == number for row in self._rows)

    def ranked(self, rows=None):
        """Numbers and places of all populations, by the distance of what their studies had in the mean."""
        by_number = {}
        for row in self._rows if rows is None else rows:
            by_number.setdefault(row["number"], []).append(row)
        each = [
            (distance([row["came"] for row in rows]), number, np.array(rows[0]["place"]))
            for number, rows in by_number.items()
        ]
        return [(number, place) for _, number, place in sorted(each, key=lambda row: row[:2])]

    def best(self, before):
        """Of the populations with smaller numbers, by their first study alone: the same for a run that goes on."""
        return self.ranked([row for row in self._rows if row["number"] < before and row["seed"] < AGAIN])[:BEST]


def write(places):
    """The presets in the order of their distance from the paper; `paper` is nearest to their middle."""
    middle = np.mean(places, axis=0)
    nearest = int(np.argmin([np.sum((place - middle) ** 2) for place in places]))
    head, _, _ = FILE.read_text().partition("[populations.paper-0")
    lines = [re.sub(r'(?m)^paper = "[^"]*"', f'paper = "paper-{nearest + 1:02d}"', head.rstrip())]
    for k, place in enumerate(places):
        p = population_at(place)
        truth = ", ".join(f"{name} = {value}" for name, value in p.truth.items())
        lines += ["", f"[populations.paper-{k + 1:02d}]", f"truth = {{{truth}}}"]
        for name in ("spread", "tolerance", "tolerance_sd", "criteria", "noise", "lapse", "drift_sd", "contrast"):
            value = getattr(p, name)
            shown = f"[{', '.join(map(three_digits, value))}]" if isinstance(value, tuple) else three_digits(value)
            lines.append(f"{name} = {shown}")
    FILE.write_text("\n".join(lines) + "\n")


def three_digits(value):
    return repr(float(f"{value:.3g}"))


def reflected(place):
    """Into the unit cube: what passes a wall comes back by as much."""
    place = np.abs(place) % 2.0
    return np.where(place > 1.0, 2.0 - place, place)


def population_at(place):
    """The population at a point of the unit cube."""
    value = {}
    for (name, (low, high)), u in zip(RANGES.items(), place, strict=True):
        value[name] = low + u * (high - low) if name in LINEAR else float(low * (high / low) ** u)
    triple = lambda kind: tuple(float(value[f"{kind} {name}"]) for name in STUDY.space.names)  # noqa: E731
    return Population(
        truth=TRUTH,
        spread=triple("spread"),
        tolerance=triple("tolerance"),
        tolerance_sd=float(value["tolerance sd"]),
        criteria=(float(value["similar to close"]), 1.0),
        noise=float(value["noise"]),
        lapse=float(value["lapse"]),
        drift_sd=float(value["drift"]),
        contrast=float(value["contrast"]),
    )


def one_study(population, seed, number):
    """What came of one study of 24 x 25 trials and its validation; no classes if its map has no three sets."""
    start = 10_000 * seed + number
    trials = simulate_study(STUDY, people(STUDY, population, 24, start), start)
    cohort = Cohort(trials, np.zeros((24, 25, 3)), tuple(f"P{j:02d}" for j in range(24)))
    candidates = jnp.asarray(search_points(STUDY.space, 0))
    posteriors = fit_cohort(STUDY, cohort)
    came = individuals(STUDY, trials, np.asarray(individual_optima(STUDY, posteriors, candidates).x))
    rule = rule_map(STUDY.gp, trials, "bcm", posteriors=posteriors)
    three = best_mid_worst(STUDY, rule.predict, candidates)
    if three.second_choice:
        return came | {"classes": None}
    sets = np.asarray(three.x)
    came["error"] = float(100 * np.sqrt(np.mean((sets[0] - truth_of(STUDY)) ** 2)))
    return came | validation(population, sets, start)


def truth_of(study):
    """The truth of all populations, in the unit cube."""
    return np.asarray(study.space.to_unit(np.array([TRUTH[name] for name in study.space.names])))


def individuals(study, trials, own):
    """What the paper says of its individuals: answers "close", and their optima (M, d), in physical units and to the
    truth."""
    close = np.asarray((trials.q == 2).sum(axis=1))
    came = {"close": float(close.mean()), "close sd": float(close.std(ddof=1))}
    nrmse = 100 * np.sqrt(np.mean((own - truth_of(study)) ** 2, axis=1))
    came |= {f"nrmse {q}": float(np.percentile(nrmse, q)) for q in (25, 50, 75)}
    for name, values in zip(study.space.names, np.asarray(study.space.to_physical(own)).T, strict=True):
        came |= {name: float(values.mean()), f"{name} sd": float(values.std(ddof=1))}
    return came


def validation(population, sets, seed):
    """Shares of classes of best, mid and worst among new people, and of preferences, each pair as often."""
    crowd = people(STUDY, population, CROWD, seed + 7_919)
    rng = np.random.default_rng([seed, 2])
    optimum, tolerance = np.asarray(crowd.optimum), np.asarray(crowd.tolerance)
    unlike = np.sqrt(np.sum(((sets[:, None] - optimum) / tolerance) ** 2, axis=-1))  # (3, crowd)
    counts, preferred = np.zeros((3, 3)), []
    lapse = np.asarray(crowd.lapse)
    for pair in combinations(range(3), 2):
        felt = unlike[list(pair)] + population.noise * rng.standard_normal((2, CROWD))
        shown = felt + population.contrast * (felt - felt[::-1])
        judged = (shown[..., None] < np.array(population.criteria)).sum(axis=-1)
        for place, q in zip(pair, judged, strict=True):
            counts[place] += (1 - lapse).mean() * np.bincount(q, minlength=3) / CROWD + lapse.mean() / 3
        preferred.append(float((1 - lapse.mean()) * np.mean(felt[0] < felt[1]) + lapse.mean() / 2))
    return {"classes": (counts / 2).tolist(), "preferred": preferred}


def distance(all_that_came):
    """Half of the squared distances from the paper in units of chance, and the deviance of the classes."""
    if any(came["classes"] is None for came in all_that_came):
        return float("inf")
    total = 0.0
    for name, (value, sd) in PAPER.items():
        total += 0.5 * ((np.mean([came[name] for came in all_that_came]) - value) / sd) ** 2
    shares = np.mean([came["classes"] for came in all_that_came], axis=0)
    for count, share in zip(CLASSES.values(), shares, strict=True):
        count = np.array(count)
        said = count > 0
        total -= np.sum(count[said] * np.log(160 * share[said] / count[said])) / CLUSTERED
    return float(total)


if __name__ == "__main__":
    main()
