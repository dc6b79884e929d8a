"""Ordinal regression on the Machine CPU data of Chu & Ghahramani (2005), over their 20 partitions.

    python benchmarks/machine_cpu.py FOLDER [--bins 5 10] [--splits 20] [--inference laplace ep] [--ard] [--write]

FOLDER holds machine_cpu.csv (x1..x6, y5, y10) and machine_cpu_splits.csv (b5_s00..b10_s19, 1 for a training row). The
data carry no licence and are not part of hilbo. Inputs are standardised on the training rows; theta (one, or with
--ard one per input), noise and thresholds maximise the evidence, the prior variance is 1. A prediction is the most
probable category. Published, for Laplace with one theta: 5 bins error 16.5 +- 3.6 %, mean absolute error .185 +- .040;
10 bins 33.8 +- 3.9 %, .475 +- .073 (mean and sd over the partitions). --write puts the table into
docs/results/accuracy.md.
"""

import argparse
import functools
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from scipy.stats import norm

jax.config.update("jax_enable_x64", True)

from pages import put  # noqa: E402

from hilbo.hyperparameters.maximum_evidence import maximise_evidence  # noqa: E402
from hilbo.ordinal_gp import RBF, OrdinalGP, OrdinalProbit, Trials, fit  # noqa: E402

ROOT = Path(__file__).parents[1]
PUBLISHED = {5: ("16.5 ± 3.6", ".185 ± .040"), 10: ("33.8 ± 3.9", ".475 ± .073")}
INPUTS = [f"x{i}" for i in range(1, 7)]
CAPACITY = 160


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("folder", type=Path)
    options.add_argument("--bins", type=int, nargs="+", default=[5, 10])
    options.add_argument("--splits", type=int, default=20)
    options.add_argument("--inference", nargs="+", default=["laplace"])
    options.add_argument("--ard", action="store_true", help="besides, one theta per input")
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    data = pd.read_csv(chosen.folder / "machine_cpu.csv")
    splits = pd.read_csv(chosen.folder / "machine_cpu_splits.csv")
    rows = [
        row(data, splits, bins, inference, ard, chosen.splits)
        for bins in chosen.bins
        for inference in chosen.inference
        for ard in ((False, True) if chosen.ard else (False,))
    ]
    text = table(rows, chosen.splits)
    print(text)
    if chosen.write:
        put("results/accuracy.md", "machine cpu", text)


def row(data, splits, bins, inference, ard, count):
    begun, scores = time.perf_counter(), []
    for split in range(count):
        train = splits[f"b{bins}_s{split:02d}"].to_numpy() == 1
        scores.append(score(data, train, bins, inference, ard))
    name = f"{inference}, {'a theta per input' if ard else 'one theta'}"
    return bins, name, np.array(scores), time.perf_counter() - begun


def score(data, train, bins, inference, ard):
    """Error, mean absolute error, and mean log predictive probability on the rows that are not in `train`."""
    x, y = data[INPUTS].to_numpy(), data[f"y{bins}"].to_numpy()
    y = y - y.min()
    x = (x - x[train].mean(axis=0)) / x[train].std(axis=0)
    gp, trials = start(y[train], bins, ard), Trials.from_arrays(x[train], y[train], CAPACITY)
    probabilities, steps = predict(gp, trials, jnp.asarray(x[~train]), inference)
    predicted, truth = np.argmax(probabilities, axis=1), y[~train]
    right = np.asarray(probabilities)[np.arange(len(truth)), truth]
    off = np.abs(predicted - truth)
    return np.mean(off > 0), np.mean(off), np.mean(np.log(right)), steps


def start(y, bins, ard):
    """Thresholds where the categories' frequencies put them, each category counted half a time more than it occurs."""
    noise = 0.3
    share = np.cumsum(np.bincount(y, minlength=bins) + 0.5)[:-1] / (len(y) + 0.5 * bins)
    thresholds = norm.ppf(share) * np.sqrt(1 + noise**2)
    theta = np.full(len(INPUTS), 0.1) if ard else 0.1
    return OrdinalGP(RBF(theta, 1.0), OrdinalProbit(thresholds, noise))


@functools.partial(jax.jit, static_argnames="inference")
def predict(gp, trials, x, inference):
    learned = maximise_evidence(gp, trials, ("theta", "noise", "thresholds"), starts=2, inference=inference)
    posterior = fit(learned.gp, trials, inference=inference, throw=False)
    return posterior.class_probabilities(x), learned.steps


def table(rows, count):
    lines = [
        "Ordinal regression on the data of Chu & Ghahramani (2005), JMLR 6:1019, over their partitions (150",
        "training and 59 test rows): made by",
        "`python benchmarks/machine_cpu.py FOLDER --inference laplace ep --ard --write`.",
        f"Mean ± sd over {count} partitions.",
        "Hyperparameters by maximum evidence of the inference named; published: Laplace with one theta.",
        "",
        "| bins | inference | error (%) | mean absolute error | mean log p | seconds a partition |",
        "|---:|---|---:|---:|---:|---:|",
    ]
    for bins in dict.fromkeys(bins for bins, *_ in rows):
        error, absolute = PUBLISHED[bins]
        lines.append(f"| {bins} | published | {error} | {absolute} | | |")
        for _, name, scores, seconds in (each for each in rows if each[0] == bins):
            e, a, p, _ = scores.mean(axis=0)
            se, sa, sp, _ = scores.std(axis=0, ddof=1)
            lines.append(
                f"| {bins} | {name} | {100 * e:.1f} ± {100 * se:.1f} | {a:.3f} ± {sa:.3f} | {p:.2f} ± {sp:.2f} |"
                f" {seconds / count:.1f} |"
            )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
