"""Sessions on published test functions cut into three categories: hilbo's choices, random and Sobol' points.

    python benchmarks/spaces.py FILE [--sessions 8]
    python benchmarks/spaces.py FILE --write

FILE (JSON Lines) collects a row for each function and seed, and one for the time of a step in each number of
dimensions; a run that was stopped goes on where it was. A participant answers "low" below the 60 (or 90) % quantile of
the function over the feasible set, "high" above the 90 (or 99) % one, without noise. All three ways give the same model
as many answers, beginning with the same space-filling trials; what is judged is the rendering with its largest
posterior mean: the share of the feasible set that is better. --write puts the tables into docs/results/spaces.md.

Hartmann 3 and 6: Surjanovic & Bingham, Virtual library of simulation experiments. Func-2C, of two levels and two
numbers: Ru, Alvi, Nguyen, Osborne & Roberts (2020), Bayesian optimisation over multiple continuous and categorical
inputs, ICML; as its authors have it, of the second level's five values the last three are the same function.
"""

import argparse
import functools
import itertools
import time
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402
from rows import Rows  # noqa: E402

from hilbo import Session, Study  # noqa: E402
from hilbo.search.linear import MARGIN  # noqa: E402

PAGE = Path(__file__).parents[1] / "docs" / "results" / "spaces.md"
CUTS = ([60, 90], [90, 99])  # % of the feasible set below "middle" and below "high"
WAYS = ("hilbo", "Sobol'", "chance")
ALPHA = np.array([1.0, 1.2, 3.0, 3.2])
A3 = np.array([[3.0, 10, 30], [0.1, 10, 35], [3.0, 10, 30], [0.1, 10, 35]])
P3 = 1e-4 * np.array([[3689, 1170, 2673], [4699, 4387, 7470], [1091, 8732, 5547], [381, 5743, 8828]])
A6 = np.array(
    [[10, 3, 17, 3.5, 1.7, 8], [0.05, 10, 17, 0.1, 8, 14], [3, 3.5, 1.7, 10, 17, 8], [17, 8, 0.05, 10, 0.1, 14]]
)
P6 = 1e-4 * np.array(
    [
        [1312, 1696, 5569, 124, 8283, 5886],
        [2329, 4135, 8307, 3736, 1004, 9991],
        [2348, 1451, 3522, 2883, 3047, 6650],
        [4047, 8828, 8732, 5743, 1091, 381],
    ]
)


def hartmann(x, slopes, places):
    """Higher is better; x (..., d) in the unit cube."""
    away = (slopes * (x[..., None, :] - places) ** 2).sum(-1)
    return (ALPHA * np.exp(-away)).sum(-1)


def unit_hartmann(slopes, places):
    """Of points (n, d) in physical numbers of a study."""
    return lambda space, physical: hartmann(np.asarray(space.to_unit(physical)), slopes, places)


def func_2c(_, physical):
    """Higher is better; columns x1, x2 in [-2, 2], and the places of the levels."""
    x1, x2, first, second = physical.T
    rosenbrock = (100 * (x2 - x1**2) ** 2 + (x1 - 1) ** 2) / 300
    camel = ((4 - 2.1 * x1**2 + x1**4 / 3) * x1**2 + x1 * x2 + (4 * x2**2 - 4) * x2**2) / 10
    beale = sum((c - x1 + x1 * x2**k) ** 2 for k, c in ((1, 1.5), (2, 2.25), (3, 2.625))) / 50
    terms, rows = np.stack([rosenbrock, camel, beale]), np.arange(len(x1))
    return -terms[first.astype(int), rows] - terms[np.minimum(second, 2).astype(int), rows]


def study_of(dim, trials, length, whole=(), constraints=(), parameters=None):
    parameters = parameters or {f"x{i + 1}": {"low": 0, "high": 1} for i in range(dim)}
    parameters |= {f"x{i + 1}": {"low": 0, "high": 10, "integer": True} for i in whole}
    return Study.from_dict(
        {
            "schema": 1,
            "study": {"name": "spaces", "responses": ["low", "middle", "high"]},
            "parameters": parameters,
            "gp": {"length": length, "variance": 1.0, "thresholds": [-0.5, 0.5], "noise": 0.3},
            "selection": {"trials": trials, "space_filling": 2 * dim},
            "constraints": list(constraints),
        }
    )


SUM = {"terms": {f"x{i}": 1.0 for i in range(1, 7)}, "most": 1.8}
PAIR = {"terms": {"x6": 1.0, "x3": -1.0}, "most": 0.1}
MIXED = {f"x{i}": {"low": -2, "high": 2} for i in (1, 2)}
MIXED |= {f"h{i}": {"levels": list("abcde"[:count])} for i, count in ((1, 3), (2, 5))}
FUNCTIONS = {
    "Hartmann 3": (study_of(3, 30, 0.3), unit_hartmann(A3, P3)),
    "Hartmann 6": (study_of(6, 50, 0.5), unit_hartmann(A6, P6)),
    "Hartmann 3, two parameters of 11 steps": (study_of(3, 30, 0.3, whole=(1, 2)), unit_hartmann(A3, P3)),
    "Hartmann 6, two linear constraints": (study_of(6, 50, 0.5, constraints=(SUM, PAIR)), unit_hartmann(A6, P6)),
    "Func-2C, levels of 3 and 5 and two numbers": (study_of(4, 40, 0.3, parameters=MIXED), func_2c),
}


def feasible(study, physical):
    """By plain arithmetic."""
    inside = np.ones(len(physical), bool)
    for constraint in study.space.constraints:
        total = sum(weight * physical[:, study.space.names.index(name)] for name, weight in constraint.terms)
        inside &= total <= constraint.most
    for i, p in enumerate(study.space.parameters):
        inside &= (p.low <= physical[:, i]) & (physical[:, i] <= p.high)
        inside &= (physical[:, i] % 1 == 0) | (not p.discrete)
    return inside


def numbers(space, at):
    """A rendering as a row (1, d) of physical numbers."""
    return np.array([[p.number(at[p.name]) for p in space.parameters]])


def one(name, seed, cut):
    """For each way the share of the feasible set that is better than its best, after every fifth trial."""
    study, function = FUNCTIONS[name]
    space = study.space
    value = functools.partial(function, space)
    crowd = value(np.asarray(space.to_physical(space.candidates(4096, 10**6))))
    edges = np.quantile(crowd, np.array(cut) / 100)
    chance = space.candidates(2048, 7 + seed)[np.random.default_rng(seed).permutation(2048)]
    others = {"Sobol'": space.candidates(study.file.selection.trials, seed), "chance": chance}
    curves, outside = {}, 0
    for way in WAYS:
        session, curve = Session.start(study, seed), {}
        for trial in range(study.file.selection.trials):
            if way == "hilbo" or trial < study.file.selection.space_filling:
                at = session.ask()
            else:
                values = np.asarray(space.to_physical(others[way][trial])).tolist()
                at = {p.name: p.shown(value) for p, value in zip(space.parameters, values, strict=True)}
            point = numbers(space, at)
            outside += int(not feasible(study, point)[0])
            session = session.tell(study.responses[int((value(point)[0] > edges).sum())], at=at)
            if (trial + 1) % 10 == 0:
                best = numbers(space, session.best())
                curve[str(trial + 1)] = float(np.mean(crowd > value(best)[0]))
        curves[way] = curve
    return {"function": name, "seed": seed, "cut": cut, "better": curves, "outside": outside}


def step_times(dim, constrained):
    """Milliseconds of the steps after 41 to 50 answers."""
    terms = {f"x{i + 1}": 1.0 for i in range(dim)}
    study = study_of(dim, 60, 0.5, constraints=({"terms": terms, "most": dim / 4},) if constrained else ())
    session, rng, times = Session.start(study, 0), np.random.default_rng(0), []
    for _ in range(50):
        begin = time.perf_counter()
        session = session.tell(study.responses[int(rng.integers(3))])
        times.append(1000 * (time.perf_counter() - begin))
    return {"dim": dim, "constrained": constrained, "median": float(np.median(times[-10:])), "most": max(times[-10:])}


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("file", type=Path)
    options.add_argument("--sessions", type=int, default=8)
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    rows = Rows(chosen.file)
    if chosen.write:
        PAGE.write_text("\n".join(page(rows.rows)) + "\n")
        return
    known = [(row.get("function"), row.get("seed"), row.get("cut")) for row in rows]
    timed = {(row.get("dim"), row.get("constrained")) for row in rows}
    for dim in (2, 4, 6, 8):
        for constrained in (False, True):
            if (dim, constrained) not in timed:
                rows.add(step_times(dim, constrained))
    for seed in range(chosen.sessions):
        for name, cut in itertools.product(FUNCTIONS, CUTS):
            if (name, seed, cut) not in known:
                rows.add(one(name, seed, cut))


def page(rows):
    judged = [row for row in rows if "function" in row]
    times = {(row["dim"], row["constrained"]): row for row in rows if "dim" in row}
    cases = list(itertools.product(FUNCTIONS, CUTS))
    count = min(sum(row["function"] == name and row["cut"] == cut for row in judged) for name, cut in cases)
    lines = [
        "# Sessions in other spaces",
        "",
        f"Made by `python benchmarks/spaces.py FILE --sessions {count}`, then `--write`. Published test functions are",
        "cut into three categories at two of their quantiles over the feasible set. After so many answers the",
        "stimulus with the largest posterior mean is evaluated. The table has the proportion of the feasible set",
        "that is better than it: the median over sessions (upper quartile).",
        "All ways have the same model and first trials.",
        "",
        "| function | cut at | trials | " + " | ".join(WAYS) + " |",
        "|---|---|---:|" + "---:|" * len(WAYS),
    ]
    ranks = []
    for name, cut in cases:
        some = [row["better"] for row in judged if row["function"] == name and row["cut"] == cut]
        for trials in (20, FUNCTIONS[name][0].selection.trials):
            cells = [np.percentile([100 * row[way][str(trials)] for row in some], [50, 75]) for way in WAYS]
            ranks.append([round(a, 1) for a, _ in cells])
            head = f"| {name} | {cut[0]} and {cut[1]} % | {trials} | "
            lines.append(head + " | ".join(f"{a:.1f} % ({b:.1f})" for a, b in cells) + " |")
    first, last = (sum(row[0] == end(row) for row in ranks) for end in (min, max))
    lines += [
        "",
        f"In {first} of {len(ranks)} rows hilbo's median is the lowest of three, in {last} the highest; there are"
        " few sessions.",
        "",
        "Within the highest category all responses are equal: once it is found a session stays there, and no response",
        "distinguishes a good stimulus from a better one. Uniform points also sample the slopes around it. If nearly",
        "all responses are the lowest, the largest posterior mean is at an untested point: no maximum is found yet.",
    ]
    outside = sum(row["outside"] for row in judged)
    lines += [
        "",
        f"Of all tested stimuli, {outside} were outside the specified constraints, ranges or steps, by plain"
        f" arithmetic (walls are {MARGIN:g} of the ranges inside).",
        "",
        "## Time of a step",
        "",
        "From a response to the next stimulus after 41 to 50 responses, in ms, on two cores shared with other work:",
        "the median, and the longest of ten. The constraint: the parameters' sum is at most a quarter of its largest.",
        "",
        "| parameters | a box | with a linear constraint |",
        "|---:|---:|---:|",
    ]
    for dim in (2, 4, 6, 8):
        cells = [f"{times[dim, c]['median']:.1f} ({times[dim, c]['most']:.0f})" for c in (False, True)]
        lines.append(f"| {dim} | {' | '.join(cells)} |")
    return lines


if __name__ == "__main__":
    main()
