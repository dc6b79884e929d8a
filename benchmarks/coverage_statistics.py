"""How often the 95 % intervals of tables II to IV hold the truth, in simulated studies whose participants differ.

    python benchmarks/coverage_statistics.py [--studies 1000] [--people 4 6 8 24] [--cases differ unequal alike]
                                             [--write]

Classes: a logistic variable with the set's level, a participant's effect and a participant's effect on the set; 12
comparisons each. Preferences: effects of participants and of 24 individual sets, each pair of them shown twice. The
truth is what endless participants would give: the logit of the mean probability, or the ordered logit that is nearest
to the mean probabilities, by Gauss-Hermite quadrature. Cases: people differ; they differ and answer unequally often,
person i of G the first i/G of the plan; they are alike. --write puts the table into
docs/methods/statistics.md; ten minutes.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.polynomial.hermite_e import hermegauss
from scipy.optimize import minimize
from scipy.special import expit, logit

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))
from pages import put  # noqa: E402

from hilbo.statistics.logits import binary_logit, ordered_logit  # noqa: E402
from hilbo.statistics.preferences import rate  # noqa: E402

# Levels of best, mid, worst, and edges between close, similar, different: with these effects, shares like the paper's.
LEVELS, EDGES = np.array([-4.8, 0.0, 3.4]), np.array([-2.0, 2.1])
PERSON, PERSON_SET = 0.8, 0.6  # sd in logits
JUDGE, SET, EFFECT = 0.6, 0.4, 1.05  # table IV: sd of participants and of sets, and the preference
SHOWN, SETS, TWICE = 8, 24, 2
CASES = {"differ": (1.0, False), "unequal": (1.0, True), "alike": (0.0, False)}  # scale of effects; unequal
PERSONS = ["iid", "clustered by participant", "jackknife by participant"]
KINDS = {"II": PERSONS, "III": PERSONS, "rate": ["Wilson", "exact"]}
KINDS["IV"] = [*PERSONS, "clustered by set", "clustered by participant and set", "jackknife by set"]
NODES, WEIGHTS = hermegauss(60)
WEIGHTS = WEIGHTS / WEIGHTS.sum()


def class_truth(scale):
    """Mean class probabilities of each set, and the coefficients of tables II and III that they mean."""
    sd = scale * np.hypot(PERSON, PERSON_SET)
    below = expit(EDGES[None, None, :] - LEVELS[:, None, None] - sd * NODES[None, :, None])
    below = np.einsum("n,snc->sc", WEIGHTS, below)
    shares = np.diff(np.hstack([np.zeros((3, 1)), below, np.ones((3, 1))]), axis=1)
    close = shares[:, 0]
    others = logit(close[1:].mean())

    def loss(theta):
        shift = np.array([theta[0], 0.0, theta[1]])
        inner = expit(theta[None, 2:] - shift[:, None])
        probabilities = np.diff(np.hstack([np.zeros((3, 1)), inner, np.ones((3, 1))]), axis=1)
        return -np.sum(shares * np.log(probabilities))

    near = minimize(
        loss, [-4.0, 3.0, *EDGES], method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-13, "maxiter": 9999}
    )
    return {"Intercept": others, "Best": logit(close[0]) - others}, {"Best": near.x[0], "Worst": near.x[1]}


def classes(rng, participants, scale, unequal):
    person = scale * PERSON * rng.standard_normal(participants)[:, None, None]
    both = scale * PERSON_SET * rng.standard_normal((participants, 3))[:, :, None]
    latent = LEVELS[None, :, None] + person + both + rng.logistic(size=(participants, 3, SHOWN))
    who, which, _ = np.indices(latent.shape)
    asked = there(who, participants, np.indices(latent.shape)[2], SHOWN, unequal)
    return np.searchsorted(EDGES, latent[asked]), which[asked], pd.DataFrame({"participant": who[asked]})


def preferences(rng, participants, scale, unequal):
    judge = scale * JUDGE * rng.standard_normal(participants)[:, None, None]
    item = scale * SET * rng.standard_normal(SETS)[None, :, None]
    won = EFFECT + judge + item + rng.logistic(size=(participants, SETS, TWICE)) > 0
    who, which, _ = np.indices(won.shape)
    asked = there(who, participants, which, SETS, unequal)
    return won[asked], pd.DataFrame({"participant": who[asked], "set": which[asked]})


def there(who, participants, turn, turns, unequal):
    """Which answers were given: all, or a person's share of the turns."""
    return turn * participants < (who + 1) * turns if unequal else np.full(who.shape, True)


def study(rng, participants, case, truths):
    """Every interval of one study: table, term, errors, whether it holds the truth, its width, whether separated."""
    scale, unequal = CASES[case]
    category, shown, people = classes(rng, participants, scale, unequal)
    best, worst = (shown == 0).astype(float), (shown == 2).astype(float)
    won, pairs = preferences(rng, participants, scale, unequal)
    tables = {
        "II": binary_logit(category == 0, {"Best": best}, people).table,
        "III": ordered_logit(category, {"Best": best, "Worst": worst}, people).table,
        "IV": binary_logit(won, None, pairs, intercept="Aggregate-Best").table,
        "rate": rate(won, pairs).query("errors in ('Wilson', 'exact')").assign(term="rate"),
    }
    return [row for name, table in tables.items() for row in intervals(name, table, truths[name])]


def intervals(name, table, truths):
    """The rows of a table, a separated coefficient's under every kind of error, and the largest of the plain ones."""
    rows = []
    for term, truth in truths.items():
        mine = table[table["term"] == term].set_index("errors")
        separated = "profile likelihood" in mine.index
        ends = {
            kind: mine.loc["profile likelihood" if separated else kind, ["low", "high"]]
            for kind in KINDS[name]
            if separated or kind in mine.index
        }
        if "iid" in ends:
            ends["the widest"] = max(ends.values(), key=lambda pair: np.nan_to_num(np.ptp(pair)))
        for kind, (low, high) in ends.items():
            rows.append((name, term, kind, bool(low <= truth <= high), high - low, separated))
    return rows


def truths_of(scale):
    two, three = class_truth(scale)
    mean = WEIGHTS @ expit(EFFECT + scale * np.hypot(JUDGE, SET) * NODES)
    return {"II": two, "III": three, "IV": {"Aggregate-Best": logit(mean)}, "rate": {"rate": mean}}


def measure(participants, case, studies):
    scale = CASES[case][0]
    truths, begin, blocks = truths_of(scale), time.perf_counter(), []
    for index in range(studies):
        rng = np.random.default_rng([participants, int(10 * scale), index])
        blocks += study(rng, participants, case, truths)
        if index % 100 == 99:
            print(f"{participants}, {case}: {index + 1}, {time.perf_counter() - begin:.0f} s", file=sys.stderr)
    rows = pd.DataFrame(blocks, columns=["table", "term", "errors", "held", "width", "separated"])
    return rows.groupby(["table", "term", "errors"], sort=False).agg(
        held=("held", "mean"), separated=("separated", "sum"), width=("width", "median")
    )


def page(results, studies):
    heads = [f"{count}, {case}" for count, case in results]
    lines = [
        f"Made by `python benchmarks/coverage_statistics.py --write`: {studies} studies a column. A cell is",
        "the coverage of 95 % intervals, in %; in brackets, the number of one-sided ones (separation);",
        f"the median width. The standard error of the coverage is {100 * np.sqrt(0.05 * 0.95 / studies):.1f} %.",
        "",
        "| table | coefficient | errors | " + " | ".join(heads) + " |",
        "|---|---|---|" + "---|" * len(heads),
    ]
    index = pd.concat([summary[["held"]] for summary in results.values()], axis=1).index
    for table, term, errors in sorted(index, key=lambda key: (order(key[0]), key[1], order(key[2]))):
        cells = []
        for summary in results.values():
            if (table, term, errors) not in summary.index:
                cells.append("")
                continue
            row = summary.loc[(table, term, errors)]
            one_sided = f" ({int(row['separated'])})" if row["separated"] else ""
            cells.append(f"{100 * row['held']:.1f}{one_sided}, {row['width']:.2f}")
        lines.append(f"| {table} | {term} | {errors} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def order(name):
    for place, begin in enumerate(
        ("II", "III", "IV", "rate", "iid", "clustered", "jackknife", "the widest", "profile")
    ):
        if name == begin or (place > 3 and name.startswith(begin)):
            return place, name
    return 99, name


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--studies", type=int, default=1000)
    options.add_argument("--people", type=int, nargs="*", default=[4, 6, 8, 24])
    options.add_argument("--cases", nargs="*", choices=CASES, default=list(CASES))
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    results = {(n, case): measure(n, case, chosen.studies) for case in chosen.cases for n in chosen.people}
    text = page(results, chosen.studies)
    print(text)
    if chosen.write:
        put("methods/statistics.md", "coverage", text)


if __name__ == "__main__":
    main()
