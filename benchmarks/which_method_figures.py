"""The two figures of docs/methods/which_method.md.

    python benchmarks/which_method_figures.py [--out docs/methods]

which_method-assumptions.svg is a sketch of what each method assumes about participants. which_method-regret.svg is
drawn from benchmarks/populations.jsonl: the mean regret of each method in each family of simulated populations with its
95 % interval (standard errors over seeds, as in docs/methods/which_method_tables.md), and the mean of each population.
"""

import argparse
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib import pyplot as plt
from populations import EVEN, FIRST, GROUPS, RULES, seeds_of, values_of
from rows import Rows

from hilbo.population.judged.leave_one_out import clustered

HERE = Path(__file__).parent
COLOURS = dict(zip(RULES, ("#0072B2", "#56B4E9", "#D55E00", "#E69F00", "#7F7F7F"), strict=True))
MARKERS = dict(zip(RULES, "osD^v", strict=True))
DESIGNS = {
    "24x25": "24 participants, 25 trials each",
    "12x15": "12 participants, 15 trials each",
}
FAMILIES = {
    "`paper-01` to `paper-30`": "participants\nlike the paper's",
    "`paper-individuals` and its variants": "participants with\nindividual optima",
    "functions drawn": "functions drawn\nfrom a Gaussian\nprocess",
}
SHARED, OWN = "#0072B2", "#9A9A9A"


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--out", type=Path, default=HERE.parent / "docs" / "methods")
    out = options.parse_args().out
    matplotlib.rcParams["svg.hashsalt"] = "hilbo"  # the same figure is the same file
    rows = Rows(HERE / "populations.jsonl").rows
    for name, figure in (("assumptions", assumptions()), ("regret", regret(rows))):
        figure.savefig(out / f"which_method-{name}.svg", metadata={"Date": None})


def family(rows, design, name):
    """The rows of a family and design whose populations have equally many studies."""
    first = FIRST + EVEN[design]
    return [r for r in rows if r["design"] == design and r["seed"] < first and GROUPS[name](r["population"])]


def estimates(rows, design, name, rule):
    """Mean regret of a method in a family, half the width of its 95 % interval, and the mean of each population."""
    part = family(rows, design, name)
    mean, error = clustered(values_of(part, rule), seeds_of(part))
    each = {}
    for row in part:
        each.setdefault(row["population"], []).append(row["rules"][rule]["regret"])
    return mean, 1.96 * error, np.array([np.mean(values) for values in each.values()])


def regret(rows):
    figure, panels = plt.subplots(2, 1, figsize=(6.4, 6.8), sharex=True, layout="constrained")
    for axes, (design, title) in zip(panels, DESIGNS.items(), strict=True):
        for place, name in enumerate(FAMILIES):
            for line, rule in enumerate(RULES):
                mean, half, each = estimates(rows, design, name, rule)
                y = place + 0.16 * (line - 2)
                axes.plot(each, np.full(len(each), y), "|", color=COLOURS[rule], alpha=0.35, markersize=5)
                look = {"color": COLOURS[rule], "marker": MARKERS[rule], "markersize": 5, "capsize": 3}
                axes.errorbar(mean, y, xerr=half, label=rule if place == 0 else None, **look, linestyle="none")
        axes.set_yticks(range(len(FAMILIES)), FAMILIES.values())
        axes.set(title=title, xlim=(0, None), ylim=(len(FAMILIES) - 0.5, -0.5))
        axes.grid(axis="x", alpha=0.3)
        axes.tick_params(axis="y", length=0)
    panels[-1].set_xlabel("regret (difference in P(highest response); smaller is better)")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False)
    return figure


def assumptions():
    figure, panels = plt.subplots(3, 2, figsize=(6.4, 6.4), sharex=True, sharey=True, layout="constrained")
    sketches = (
        ("pooled", "one participant gave all responses", pooled),
        ("bcm", "one common function; each participant's\nposterior is an independent view of it", committee),
        ("average", "individual functions, averaged;\nno model of the population", average),
        ("hierarchical", "a common function and individual\ndeviations; hyperparameters given", hierarchical),
        ("learnt-2", "as hierarchical, peaked functions; lengths,\nvariances and thresholds fitted", learnt),
    )
    for axes, (name, text, sketch) in zip(panels.flat, sketches, strict=False):
        sketch(axes, np.linspace(0, 1, 400))
        axes.set_title(text, fontsize=8.5)
        axes.text(0.03, 0.95, name, weight="bold", fontsize=10, va="top", transform=axes.transAxes)
        axes.set(xticks=[], yticks=[], ylim=(-0.35, 1.5))
    legend(panels.flat[-1])
    figure.supxlabel("stimulus", fontsize=9)
    figure.supylabel("latent score", fontsize=9)
    return figure


def hill(x, centre=0.5, height=1.0, width=0.2):
    return height * np.exp(-0.5 * ((x - centre) / width) ** 2)


PEOPLE = ((0.36, 0.85), (0.52, 1.2), (0.66, 0.95))  # optimum and height of three participants


def pooled(axes, x):
    axes.plot(x, hill(x), color=SHARED, linewidth=2)
    rng = np.random.default_rng(4)
    at = rng.uniform(0.05, 0.95, 24)
    axes.plot(at, hill(at) + rng.normal(0, 0.14, 24), ".", color="black", markersize=5)


def committee(axes, x):
    rng = np.random.default_rng(2)
    for centre in (0.42, 0.5, 0.58):
        view = hill(x, centre) + rng.normal(0, 0.05)
        axes.fill_between(x, view - 0.2, view + 0.2, color=OWN, alpha=0.25, linewidth=0)
    axes.plot(x, hill(x), color=SHARED, linewidth=2)


def average(axes, x):
    each = [hill(x, centre, height) for centre, height in PEOPLE]
    for own in each:
        axes.plot(x, own, color=OWN, linewidth=1)
    axes.plot(x, np.mean(each, axis=0), color=SHARED, linewidth=2, linestyle="--")


def hierarchical(axes, x, shape=hill):
    for centre, height in PEOPLE:
        deviation = 0.45 * (shape(x, centre, height, 0.14) - shape(x, 0.5, 0.9, 0.17))
        axes.plot(x, shape(x) + deviation, color=OWN, linewidth=1)
    axes.plot(x, shape(x), color=SHARED, linewidth=2)


def peak(x, centre=0.5, height=1.2, width=0.2):
    return height * np.exp(-np.abs(x - centre) / width)


def learnt(axes, x):
    hierarchical(axes, x, peak)
    for threshold in (0.35, 0.8):
        axes.axhline(threshold, color="black", linewidth=0.8, linestyle=":")
    arrow = {"arrowstyle": "<->", "color": "black", "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", (0.04, 0.35), (0.04, 0.8), arrowprops=arrow)
    axes.annotate("", (0.28, -0.2), (0.5, -0.2), arrowprops=arrow)
    axes.text(0.39, -0.16, "length", ha="center", va="bottom", fontsize=8)


def legend(axes):
    axes.axis("off")
    lines = (
        axes.plot([], [], color=SHARED, linewidth=2, label="function of the population")[0],
        axes.plot([], [], color=SHARED, linewidth=2, linestyle="--", label="mean of individual functions")[0],
        axes.plot([], [], color=OWN, linewidth=1, label="function of one participant")[0],
        axes.fill_between([], [], color=OWN, alpha=0.4, linewidth=0, label="posterior of one participant"),
        axes.plot([], [], ".", color="black", label="response")[0],
        axes.plot([], [], ":", color="black", linewidth=0.8, label="threshold between categories")[0],
    )
    axes.legend(handles=lines, loc="center", frameon=False, fontsize=8.5)


if __name__ == "__main__":
    main()
