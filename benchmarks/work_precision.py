"""Run time against error of every inference method, on fixed data; writes docs/work_precision.md and .svg.

    python benchmarks/work_precision.py            all four sizes (a quarter of an hour, most of it compilation)
    python benchmarks/work_precision.py 25 100     these only

Each of four kinds of data at n = 10, 25, 50 and 100 answers: separated (no mistakes), noisy with repeated stimuli,
near-separable (noise 0.1) and real people (the shipped video ratings; 100 answers are two people's). The reference is
`exact` with 65,536 samples and another key; its own standard error is the last column's floor. Times are of a
compiled fit and prediction at 200 points, one thread.
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

from hilbo import RBF, OrdinalGP, OrdinalProbit, Study, Trials, fit  # noqa: E402
from hilbo.exact import exact  # noqa: E402
from hilbo.kernels import gram  # noqa: E402
from hilbo.ordinal_gp import Posterior  # noqa: E402
from hilbo.study import cohort_of  # noqa: E402
from hilbo.tables import read_trials  # noqa: E402

__all__ = ["main"]

SIZES = tuple(int(size) for size in sys.argv[1:]) or (10, 25, 50, 100)
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


METHODS = {
    "laplace, float32": (approximate("laplace"), np.float32),
    "laplace": (approximate("laplace"), np.float64),
    "ep, float32": (approximate("ep"), np.float32),
    "ep": (approximate("ep"), np.float64),
    "exact, 512": (by_exact(32 * 16, 1), np.float64),
    "exact, 16,384": (by_exact(32 * 512, 1), np.float64),
}
REFERENCE = by_exact(32 * 2048, 99)


def answer(run):
    """Compiled: model, trials, points -> posterior, mean, sd."""

    def found(gp, trials, x):
        posterior = run(gp, trials)
        mean, variance = posterior.predict(x)
        return posterior, mean, jnp.sqrt(variance)

    return jax.jit(found)


def quantities(function, args):
    """Mean, sd, class probabilities at the first few points, log evidence."""
    posterior, mean, sd = function(*args)
    return mean, sd, posterior.class_probabilities(args[2][:8]), posterior.log_evidence


def misses(found, truth):
    """Errors in the order of QUANTITIES; the next point's is the loss of UCB (weight 0.7) by the reference."""
    mean, sd, probability = (
        np.sqrt(np.mean((np.asarray(a) - np.asarray(b)) ** 2)) for a, b in zip(found[:3], truth[:3], strict=True)
    )
    ucb = [np.asarray(m + 0.7 * s, float) for m, s in (found[:2], truth[:2])]
    loss = np.max(ucb[1]) - ucb[1][np.argmax(ucb[0])]
    return [mean, sd, probability, abs(float(found[3]) - float(truth[3])), loss]


def measure():
    """{(method, n): (errors (kinds, quantities), seconds)}."""
    compiled = {name: answer(run) for name, (run, _) in METHODS.items()}
    reference = answer(REFERENCE)
    results = {}
    for n in SIZES:
        errors, seconds = {name: [] for name in METHODS}, {name: [] for name in METHODS}
        for kind in KINDS:
            gp, x, q = data(kind, n)
            x_new = np.random.default_rng(5).random((200, 3))[:, : x.shape[1]]
            truth = quantities(reference, (gp, Trials.from_arrays(x, q, n), jnp.asarray(x_new)))
            for name, (_, dtype) in METHODS.items():
                model = jax.tree.map(lambda leaf, dtype=dtype: leaf.astype(dtype), gp)
                args = model, Trials.from_arrays(x.astype(dtype), q, n), jnp.asarray(x_new.astype(dtype))
                errors[name].append(misses(quantities(compiled[name], args), truth))
                seconds[name].append(clock(compiled[name], args))
        for name in METHODS:
            results[name, n] = np.array(errors[name]), float(np.median(seconds[name]))
        print(f"n = {n} done", file=sys.stderr)
    return results


def clock(function, args) -> float:
    jax.block_until_ready(function(*args))
    taken = []
    for _ in range(9):
        start = time.perf_counter()
        jax.block_until_ready(function(*args))
        taken.append(time.perf_counter() - start)
    return float(np.median(taken))


def table(results) -> str:
    head = "| n | method | time (ms) | " + " | ".join(QUANTITIES) + " |\n|---|---|---:|" + "---:|" * len(QUANTITIES)
    rows = []
    for n in SIZES:
        for name in METHODS:
            errors, seconds = results[name, n]
            worst = np.max(errors, axis=0)
            rows.append(f"| {n} | {name} | {1e3 * seconds:.2f} | " + " | ".join(f"{v:.1e}" for v in worst) + " |")
    return head + "\n" + "\n".join(rows)


def by_kind(results) -> str:
    head = "| data | method | " + " | ".join(QUANTITIES) + " |\n|---|---|" + "---:|" * len(QUANTITIES)
    rows = [
        f"| {kind} | {name} | " + " | ".join(f"{v:.1e}" for v in results[name, SIZES[-1]][0][row]) + " |"
        for row, kind in enumerate(KINDS)
        for name in ("laplace", "ep", "exact, 16,384")
    ]
    return head + "\n" + "\n".join(rows)


def draw(results, path):
    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(
        1, len(SIZES), figsize=(1 + 3 * len(SIZES), 3.6), sharex=True, sharey=True, squeeze=False, layout="constrained"
    )
    colours = {"laplace": "C0", "ep": "C1", "exact": "C2"}
    for axis, n in zip(axes[0], SIZES, strict=True):
        for name in METHODS:
            errors, seconds = results[name, n]
            family = name.split(",")[0]
            marker = "s" if "float32" in name else "o"
            axis.loglog(
                1e3 * seconds,
                np.max(errors[:, 0]),
                marker,
                color=colours[family],
                mfc="none" if marker == "s" else None,
            )
            axis.annotate(
                name, (1e3 * seconds, np.max(errors[:, 0])), textcoords="offset points", xytext=(4, 4), fontsize=7
            )
        axis.set_title(f"{n} answers")
        axis.set_xlabel("time of a fit and 200 predictions (ms)")
        axis.margins(x=0.25)
    axes[0, 0].set_ylabel("error of the mean, worst of four data sets (prior sd)")
    figure.savefig(path, metadata={"Date": None})


def main():
    jax.config.update("jax_enable_x64", True)
    results = measure()
    text = f"""# Run time against error

Made by `python benchmarks/work_precision.py`, one thread, x86-64. Low and left is good.

![Run time against error of the mean](work_precision.svg)

Errors against `exact` with 65,536 samples, RMS over 200 points (class probabilities: 8) and the worst of four data
sets: separated, noisy with repeats, near-separable (noise 0.1), real people. "Next point": how much less UCB, by the
reference's posterior, the point has that the method would ask next. "exact, N": N samples.

{table(results)}

What the kinds of data do, at {SIZES[-1]} answers:

{by_kind(results)}
"""
    (ROOT / "docs" / "work_precision.md").write_text(text)
    draw(results, ROOT / "docs" / "work_precision.svg")
    print(text)


if __name__ == "__main__":
    main()
