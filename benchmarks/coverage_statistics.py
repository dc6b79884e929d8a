"""How often the 95 % intervals of tables II to IV hold the truth, in simulated studies whose participants differ.

    python benchmarks/coverage_statistics.py [--studies 1000] [--clusters 8 24] [--write]

Classes: a logistic variable with the set's level, a participant's effect and a participant's effect on the set; 12
comparisons each. Preferences: effects of participants and of 24 individual sets, each pair of them shown twice. The
truth is what endless participants would give: the logit of the mean probability, or the ordered logit that is nearest to the mean
probabilities, by Gauss-Hermite quadrature. --write puts the table into docs/statistics.md; 20 minutes.
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
from hilbo.preferences import rate  # noqa: E402
from hilbo.statistics import binary_logit, ordered_logit  # noqa: E402

# Levels of best, mid, worst, and edges between close, similar, different: with these effects, shares like the paper's.
LEVELS, EDGES = np.array([-4.8, 0.0, 3.4]), np.array([-2.0, 2.1])
PERSON, PERSON_SET = 0.8, 0.6  # sd in logits
JUDGE, SET, EFFECT = 0.6, 0.4, 1.05  # table IV: sd of participants and of sets, and the preference
SHOWN, SETS, TWICE = 8, 24, 2
NODES, WEIGHTS = hermegauss(60)
WEIGHTS = WEIGHTS / WEIGHTS.sum()
START, END = "<!-- coverage -->", "<!-- end of coverage -->"


def class_truth():
    """Mean class probabilities of each set, and the coefficients of tables II and III that they mean."""
    sd = np.hypot(PERSON, PERSON_SET)
    below = expit(EDGES[None, None, :] - LEVELS[:, None, None] - sd * NODES[None, :, None])
    below = np.einsum("n,snc->sc", WEIGHTS, below)
    shares = np.diff(np.hstack([np.zeros((3, 1)), below, np.ones((3, 1))]), axis=1)
    close = shares[:, 0]
    others = logit(close[1:].mean())

    def loss(theta):
        shift = np.array([theta[0], 0.0, theta[1]])
        inner = expit(theta[None, 2:] - shift[:, None])
        found = np.diff(np.hstack([np.zeros((3, 1)), inner, np.ones((3, 1))]), axis=1)
        return -np.sum(shares * np.log(found))

    near = minimize(
        loss, [-4.0, 3.0, *EDGES], method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-13, "maxiter": 9999}
    )
    return {"Intercept": others, "Best": logit(close[0]) - others}, {"Best": near.x[0], "Worst": near.x[1]}


def classes(rng, participants, scale):
    person = scale * PERSON * rng.standard_normal(participants)[:, None, None]
    both = scale * PERSON_SET * rng.standard_normal((participants, 3))[:, :, None]
    latent = LEVELS[None, :, None] + person + both + rng.logistic(size=(participants, 3, SHOWN))
    who, which, _ = np.indices(latent.shape)
    category = np.searchsorted(EDGES, latent.ravel())
    return category, which.ravel(), pd.DataFrame({"participant": who.ravel()})


def preferences(rng, participants, scale):
    judge = scale * JUDGE * rng.standard_normal(participants)[:, None, None]
    item = scale * SET * rng.standard_normal(SETS)[None, :, None]
    won = EFFECT + judge + item + rng.logistic(size=(participants, SETS, TWICE)) > 0
    who, which, _ = np.indices(won.shape)
    return won.ravel(), pd.DataFrame({"participant": who.ravel(), "set": which.ravel()})


def study(rng, participants, scale, truths):
    """Every interval of one study: table, term, errors, whether it holds the truth, its width."""
    category, shown, people = classes(rng, participants, scale)
    best, worst = (shown == 0).astype(float), (shown == 2).astype(float)
    won, pairs = preferences(rng, participants, scale)
    fits = {
        "II": binary_logit(category == 0, {"Best": best}, people).table,
        "III": ordered_logit(category, {"Best": best, "Worst": worst}, people).table,
        "IV": binary_logit(won, None, pairs).table.assign(term="Aggregate-Best"),
        "rate": rate(won, pairs, bootstrap=False).query("errors in ('Wilson', 'exact')").assign(term="rate"),
    }
    rows = []
    for name, table in fits.items():
        table = answered(table[table["term"].isin(truths[name])])
        rows += [table.assign(table=name), larger(table).assign(table=name)]
    found = pd.concat(rows)
    truth = np.array([truths[name][term] for name, term in zip(found["table"], found["term"], strict=True)])
    found["held"] = (found["low"].to_numpy() <= truth) & (truth <= found["high"].to_numpy())
    found["width"] = found["high"] - found["low"]
    return found[["table", "term", "errors", "held", "width", "separated"]]


def answered(table):
    """The interval of a separated coefficient stands in for every kind of error that the others have."""
    gone = table["errors"] == "profile likelihood"
    kinds = table.loc[~gone, "errors"].unique()
    copies = [table[gone].assign(errors=kind, separated=True) for kind in kinds]
    return pd.concat([table[~gone].assign(separated=False), *copies])


def larger(table):
    """The widest of the iid and the clustered intervals of each term."""
    plain = table[(table["errors"] == "iid") | table["errors"].str.startswith("clustered")]
    if plain.empty:
        return plain
    widths = (plain["high"] - plain["low"]).groupby(plain["term"])
    return plain.loc[widths.idxmax()].assign(errors="the largest of iid and clustered")


def truths_of(scale):
    global PERSON, PERSON_SET
    kept = PERSON, PERSON_SET
    PERSON, PERSON_SET = scale * PERSON, scale * PERSON_SET
    two, three = class_truth()
    PERSON, PERSON_SET = kept
    mean = WEIGHTS @ expit(EFFECT + scale * np.hypot(JUDGE, SET) * NODES)
    return {"II": two, "III": three, "IV": {"Aggregate-Best": logit(mean)}, "rate": {"rate": mean}}


def measure(participants, scale, studies):
    truths, begin, blocks = truths_of(scale), time.perf_counter(), []
    for index in range(studies):
        blocks.append(study(np.random.default_rng([participants, int(10 * scale), index]), participants, scale, truths))
        if index % 100 == 99:
            print(
                f"{participants} participants, effects x {scale}: {index + 1}, {time.perf_counter() - begin:.0f} s",
                file=sys.stderr,
            )
    found = pd.concat(blocks)
    return found.groupby(["table", "term", "errors"], sort=False).agg(
        held=("held", "mean"), separated=("separated", "sum"), width=("width", "median")
    )


def page(results, studies):
    heads = [f"{count} people{', alike' if scale == 0 else ''}" for count, scale in results]
    lines = [
        f"Made by `python benchmarks/coverage_statistics.py --write`: {studies} studies a column; the share of 95 % intervals",
        f"that held the truth, in %, in brackets how many were one-sided (separated), and the median width. The share's own standard error is {100 * np.sqrt(0.05 * 0.95 / studies):.1f} %.",
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
            gone = f" ({int(row['separated'])})" if row["separated"] else ""
            cells.append(f"{100 * row['held']:.1f}{gone}, {row['width']:.2f}")
        lines.append(f"| {table} | {term} | {errors} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def order(name):
    for place, begin in enumerate(("II", "III", "IV", "rate", "iid", "clustered", "the largest", "wild", "profile")):
        if name == begin or (place > 3 and name.startswith(begin)):
            return place, name
    return 99, name


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--studies", type=int, default=1000)
    options.add_argument("--clusters", type=int, nargs="*", default=[8, 24])
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    results = {(n, scale): measure(n, scale, chosen.studies) for scale in (1.0, 0.0) for n in chosen.clusters}
    text = page(results, chosen.studies)
    print(text)
    if chosen.write:
        path = ROOT / "docs" / "statistics.md"
        before, _, rest = path.read_text(encoding="utf-8").partition(START)
        _, _, after = rest.partition(END)
        path.write_text(f"{before}{START}\n{text}{END}{after}", encoding="utf-8")


if __name__ == "__main__":
    main()
