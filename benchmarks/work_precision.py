"""Run time against error: inference, the committee machine, the acquisition's optimum; into docs/results/accuracy.md
and work_precision.svg beside it.

    python benchmarks/work_precision.py            everything (half an hour on one core, most of it compilation)
    python benchmarks/work_precision.py 10 25      these numbers of answers only, and nothing written

Four kinds of seeded data at n = 10, 25, 50 and 100 answers: separated (no mistakes), noisy with repeated stimuli,
near-separable (noise 0.1) and real people (the shipped video ratings; 100 answers are two people's). The reference is
`exact` with 65,536 samples and another key. Times are medians of a compiled fit and prediction at 200 points, one
thread.
"""

import os
import sys
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false " + os.environ.get("XLA_FLAGS", "")

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks import pages  # noqa: E402
from benchmarks import work_precision_maps as maps  # noqa: E402
from hilbo import RBF, OrdinalGP, OrdinalProbit, Study, Trials, fit  # noqa: E402
from hilbo.inference.ep import ep  # noqa: E402
from hilbo.inference.exact import exact  # noqa: E402
from hilbo.kernels import gram  # noqa: E402
from hilbo.likelihoods import TiltedTerms  # noqa: E402
from hilbo.ordinal_gp import Posterior  # noqa: E402
from hilbo.study.cohort import cohort_of, read_trials  # noqa: E402

__all__ = ["main"]

SIZES = (10, 25, 50, 100)
KINDS = ("separated", "noisy, repeats", "near-separable", "real people")
QUANTITIES = ("mean", "sd", "class probability", "log evidence", "next point")


def data(kind: str, n: int):
    """Model and trials (x, q); seeded."""
    rng = np.random.default_rng([77, n, KINDS.index(kind)])
    if kind == "real people":
        folder = ROOT / "hilbo" / "data"
        study = Study.load(folder / "video_quality.toml")
        cohort = cohort_of(read_trials(folder / "video_quality.csv", study), study)
        x, q = (np.asarray(part)[:2, :70].reshape(140, *part.shape[2:]) for part in (cohort.trials.x, cohort.trials.q))
        rows = (
            rng.permutation(70)[:n]
            if n <= 70
            else np.concatenate([rng.permutation(70)[:50], 70 + rng.permutation(70)[:50]])
        )
        return study.gp, x[rows], q[rows]
    x = rng.random((n, 3))
    if kind == "noisy, repeats":
        x = x[rng.integers(0, max(n // 3, 1), n)]
    latent = 1.6 - 4.0 * np.sum((x - np.array([0.35, 0.6, 0.4])) ** 2, axis=1)
    noise, theta = {"separated": (0.5, 30.0), "noisy, repeats": (0.5, 10.0), "near-separable": (0.1, 3.0)}[kind]
    if kind == "noisy, repeats":
        latent = latent + noise * rng.standard_normal(n)
    return OrdinalGP(RBF(theta), OrdinalProbit((-0.5, 0.5), noise)), x, np.searchsorted([-0.5, 0.5], latent)


def by_exact(samples: int, seed: int):
    def run(gp, trials):
        ends = jnp.full((1,), jnp.inf, trials.x.dtype)
        edges = jnp.concatenate([-ends, gp.likelihood.thresholds, ends])
        covariance = gram(gp.kernel, trials.x, trials.x)
        low, high = edges[trials.q], edges[trials.q + 1]
        key = jax.random.key(seed)
        return Posterior(gp, trials, exact(key, covariance, low, high, gp.likelihood.noise, trials.mask, samples))

    return run


def approximate(inference: str):
    return lambda gp, trials: fit(gp, trials, inference=inference, throw=False)


def few_steps(steps: int):
    def run(gp, trials):
        terms = TiltedTerms(gp.likelihood, trials.q, trials.mask)
        return Posterior(gp, trials, ep(gram(gp.kernel, trials.x, trials.x), terms, max_steps=steps))

    return run


METHODS = {
    "laplace": (approximate("laplace"), np.float64),
    "laplace, float32": (approximate("laplace"), np.float32),
    "ep, 2 steps": (few_steps(2), np.float64),
    "ep": (approximate("ep"), np.float64),
    "ep, float32": (approximate("ep"), np.float32),
    "ep_corrected": (approximate("ep_corrected"), np.float64),
    "ep_corrected, float32": (approximate("ep_corrected"), np.float32),
    "exact, 512": (by_exact(32 * 16, 1), np.float64),
    "exact, 4,096": (by_exact(32 * 128, 1), np.float64),
    "exact, 16,384": (by_exact(32 * 512, 1), np.float64),
    "exact, 16,384, float32": (by_exact(32 * 512, 1), np.float32),
}
SHOWN = ("laplace", "ep", "ep_corrected", "exact, 16,384")
REFERENCE = by_exact(32 * 2048, 99)


def answer(run):
    """Compiled: model, trials, points -> posterior, mean, sd."""

    def posterior_and_moments(gp, trials, x):
        posterior = run(gp, trials)
        mean, variance = posterior.predict(x)
        return posterior, mean, jnp.sqrt(variance)

    return jax.jit(posterior_and_moments)


def quantities(function, args):
    """Mean, sd, class probabilities at the first few points, log evidence."""
    posterior, mean, sd = function(*args)
    return mean, sd, posterior.class_probabilities(args[2][:8]), posterior.log_evidence


def misses(approximation, truth):
    """Errors in the order of QUANTITIES; the next point's is the loss of UCB (weight 0.7) by the reference."""
    mean, sd, probability = (
        np.sqrt(np.mean((np.asarray(a) - np.asarray(b)) ** 2))
        for a, b in zip(approximation[:3], truth[:3], strict=True)
    )
    ucb = [np.asarray(m + 0.7 * s, float) for m, s in (approximation[:2], truth[:2])]
    loss = np.max(ucb[1]) - ucb[1][np.argmax(ucb[0])]
    return [mean, sd, probability, abs(float(approximation[3]) - float(truth[3])), loss]


def measure(sizes):
    """{(method, n): (errors (kinds, quantities), seconds)}, and {n: the reference's own standard errors}."""
    compiled = {name: answer(run) for name, (run, _) in METHODS.items()}
    reference = answer(REFERENCE)
    results, floors = {}, {}
    for n in sizes:
        errors, seconds, floor = {name: [] for name in METHODS}, {name: [] for name in METHODS}, []
        for kind in KINDS:
            gp, x, q = data(kind, n)
            x_new = np.random.default_rng(5).random((200, 3))[:, : x.shape[1]]
            args = gp, Trials.from_arrays(x, q, n), jnp.asarray(x_new)
            truth = quantities(reference, args)
            sure = reference(*args)[0]
            of_mean = np.sqrt(np.mean(np.asarray(sure.standard_errors(args[2][:8])[0]) ** 2))
            floor.append([of_mean, float(sure.certificate.log_evidence_error)])
            for name, (_, dtype) in METHODS.items():
                model = jax.tree.map(lambda leaf, dtype=dtype: leaf.astype(dtype), gp)
                args = model, Trials.from_arrays(x.astype(dtype), q, n), jnp.asarray(x_new.astype(dtype))
                errors[name].append(misses(quantities(compiled[name], args), truth))
                seconds[name].append(clock(compiled[name], args))
        for name in METHODS:
            results[name, n] = np.array(errors[name]), float(np.median(seconds[name]))
        floors[n] = np.max(floor, axis=0)
        jax.clear_caches()  # as many compiled functions as all sizes need are more memory maps than Linux gives
        print(f"n = {n} done", file=sys.stderr)
    return results, floors


def clock(function, args) -> float:
    jax.block_until_ready(function(*args))
    taken = []
    for _ in range(9):
        start = time.perf_counter()
        jax.block_until_ready(function(*args))
        taken.append(time.perf_counter() - start)
    return float(np.median(taken))


def table(results, sizes) -> str:
    """A row per method: time at every n, and the worst error over all data sets."""
    times = " | ".join(f"{n} answers" for n in sizes)
    rows = [
        f"| method | {times} | " + " | ".join(QUANTITIES) + " |",
        "|---|" + "---:|" * (len(sizes) + len(QUANTITIES)),
    ]
    for name in METHODS:
        clocks = " | ".join(f"{1e3 * results[name, n][1]:.2f}" for n in sizes)
        worst = np.max([np.max(results[name, n][0], axis=0) for n in sizes], axis=0)
        rows.append(f"| {name} | {clocks} | " + " | ".join(f"{value:.1g}" for value in worst) + " |")
    return "\n".join(rows)


def by_kind(results, sizes) -> str:
    """Errors of mean, sd and evidence of each data set."""
    head = " | ".join(f"{name}: mean | sd | log evidence" for name in SHOWN)
    rows = [f"| data | n | {head} |", "|---|---:|" + "---:|" * (3 * len(SHOWN))]
    for row, kind in enumerate(KINDS):
        for n in sizes:
            figures = (results[name, n][0][row][[0, 1, 3]] for name in SHOWN)
            rows.append(f"| {kind} | {n} | " + " | ".join(f"{v:.4f}" for part in figures for v in part) + " |")
    return "\n".join(rows)


STYLE = {
    "laplace": ("#000000", "s"),
    "ep": ("#E69F00", "^"),
    "ep_corrected": ("#0072B2", "o"),
    "exact": ("#CC79A7", "D"),
}


def draw(results, floors, sizes, path):
    """Columns: n. Above the error of the mean, below that of the log evidence; the reference's own error in grey."""
    mpl.use("Agg")
    from matplotlib import pyplot as plt

    shape = dict(figsize=(1.2 + 2.5 * len(sizes), 5.6), sharex=True, sharey="row", squeeze=False, layout="constrained")
    figure, axes = plt.subplots(2, len(sizes), **shape)
    for row, (quantity, label) in enumerate([(0, "error of the mean (prior sd)"), (3, "error of the log evidence")]):
        for axis, n in zip(axes[row], sizes, strict=True):
            _panel(axis, {name: results[name, n] for name in METHODS}, quantity)
            axis.axhspan(1e-9, 2 * floors[n][row], color="0.88", lw=0)
        axes[row, 0].set_ylabel(f"{label}\nworst of four data sets")
    for axis, n in zip(axes[0], sizes, strict=True):
        axis.set_title(f"{n} answers", fontsize=10)
    for axis in axes[1]:
        axis.set_xlabel("fit and 200 predictions (ms)")
    for axis in axes[:, 0]:
        low = min(line.get_ydata().min() for a in axis.figure.axes if a.get_shared_y_axes().joined(a, axis)
                  for line in a.lines)  # fmt: skip
        axis.set_ylim(low / 2)
    handles = [
        plt.Line2D([], [], color=c, marker=m, ls="-" if k == "exact" else "", label=k) for k, (c, m) in STYLE.items()
    ]
    handles += [
        plt.Line2D([], [], color="0.4", marker="o", mfc="none", ls="", label="the same in float32"),
        plt.Line2D([], [], color="0.88", lw=8, label="not told from the reference"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=9, frameon=False)
    figure.savefig(path, metadata={"Date": None})


def _panel(axis, results, quantity):
    for family, (colour, marker) in STYLE.items():
        whole = [name for name in results if name.split(",")[0] == family and "steps" not in name]
        for single in (False, True):
            names = [name for name in whole if ("float32" in name) == single]
            times = [1e3 * results[name][1] for name in names]
            errors = [np.max(results[name][0][:, quantity]) for name in names]
            fill = {"mfc": "none"} if single else {}
            axis.loglog(times, errors, marker, ls="-" if len(names) > 1 else "", color=colour, ms=7, **fill)
    axis.grid(color="0.93")
    axis.set_axisbelow(True)


def main():
    jax.config.update("jax_enable_x64", True)
    asked = tuple(int(size) for size in sys.argv[1:])
    sizes = asked or SIZES
    results, floors = measure(sizes)
    text = PAGE.format(table=table(results, sizes), kinds=by_kind(results, sizes), bcm=maps.committee(REFERENCE),
                       optimum=maps.optimum())  # fmt: skip
    print(text)
    if not asked:
        draw(results, floors, sizes, ROOT / "docs" / "results" / "work_precision.svg")
        pages.put("results/accuracy.md", "work precision", text)


PAGE = """Made by `python benchmarks/work_precision.py`, one thread, x86-64. Low and left is good.

![Run time against error of the mean and of the log evidence](work_precision.svg)

Left, milliseconds for a fit and 200 predictions, by the number of answers. Right, the worst error over four kinds of
data (separated, noisy with repeats, near-separable with noise 0.1, real people) and all numbers of answers, against
`exact` with 65,536 samples: RMS over 200 points (class probabilities: 8). "Next point": loss of UCB, by the
reference's posterior, of the point that the method would choose next. "exact, N": N samples.

{table}

"ep_corrected" costs a little more than EP; the errors of its means, standard deviations and evidence are no larger than
those of `exact` with thousands of samples, at a small part of its cost. Its class probabilities are those of EP.
Float32 changes none of the errors and saves a third of the time of `exact` ([below](#float32-against-float64)).

### By kind of data

RMS errors of mean and sd over 200 points, and of the log evidence. The noise is 0.5, of near-separable data 0.1, of
real people 0.47.

{kinds}

EP stays within .002 in the mean and .03 in the evidence at noise 0.5 up to 25 answers, within .003 and .15 at noise
0.1. With more responses its error, the third cumulants of neighbouring responses, exceeds that
([inference](../methods/inference.md)); the corrected one stays within.

### The committee machine

100 responses of one latent function, divided among participants: the committee's map (BCM) against the pooled exact
posterior (noise 0.5, theta 10, RMS over 200 points, in prior sds), by the inference of the individual posteriors.
The error with `exact` is the approximation of the committee: participants are independent given f at one point.

{bcm}

### The acquisition's optimum

UCB maximised over the passive set of the preset `paper`, in 24 states of 5 to 25 responses: loss against the best
known point (65,536 points inside and 16,384 on the walls, 24 of them polished), and the time of a choice. Candidates
are inside the set plus a quarter more on its walls; "polished" are that many of the best. Sessions of two
or three parameters screen a lattice instead.

{optimum}
"""


if __name__ == "__main__":
    main()
