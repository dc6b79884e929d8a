"""Run time of the mechanics against plain NumPy and SciPy, and time against error of the ways to keep memory.

    python benchmarks/mechanics.py [--rounds 5] [--write]

One core, float64; the two sides take turns, a row is the median over the rounds. --write makes
docs/results/run_time.md and docs/results/memory.svg.
"""

import argparse
import functools
import itertools
import os
import platform
import time
import warnings

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
warnings.filterwarnings("ignore", category=DeprecationWarning)

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from scipy.signal import lfilter  # noqa: E402
from scipy.stats import qmc  # noqa: E402

jax.config.update("jax_enable_x64", True)
from pages import DOCS, put  # noqa: E402

from hilbo import passivity, viscoelastic  # noqa: E402
from hilbo.viscoelastic import FOSLS  # noqa: E402

T, N, K_EFF = 1e-3, 101, 0.44
FOAM = (0.44, 5.70, 5.89, 0.203)  # the K1, B1, α of memory foam, with the K0 >= 0 that full memory needs
SAMPLES = 3000


def sets(count):
    return qmc.scale(qmc.Sobol(3, rng=0).random(2**15), (1, 0.001, 0.01), (32, 32, 0.99))[:count].T


def taps(alpha, count):
    return np.cumprod(np.concatenate([[1.0], (np.arange(1, count + 1) - 1 - alpha) / np.arange(1, count + 1)]))


def grid_check(K1, B1, alpha, points=4096):
    """Smallest damping on a grid of frequencies, set by set."""
    angle = np.linspace(0, np.pi, points)[1:]
    cot, needed = 1 / np.tan(angle / 2), np.empty(len(K1))
    for i in range(len(K1)):
        c = taps(alpha[i], N)
        beta = B1[i] * T ** -alpha[i]
        pot = beta * np.fft.rfft(c, 2 * (points - 1))[1:]
        K0 = K_EFF - K1[i] * beta * c.sum() / (K1[i] + beta * c.sum())
        H = K0 + K1[i] * pot / (K1[i] + pot)
        needed[i] = 500 * T * np.max(H.real - cot * H.imag)
    return needed


def filtered(K0, K1, B1, alpha, x):
    """Forces by scipy's filter, set by set."""
    force = np.empty((len(K1), len(x)))
    for i in range(len(K1)):
        pot = B1[i] * T ** -alpha[i] * taps(alpha[i], N)
        series = pot.copy()
        series[0] += K1[i]
        force[i] = lfilter(K0[i] * series + K1[i] * pot, series, x)
    return force


def timed(functions, rounds):
    """Median seconds of each function, taking turns."""
    for function in functions:
        jax.block_until_ready(function())
    seconds = []
    for _ in range(rounds):
        row = []
        for function in functions:
            start = time.perf_counter()
            jax.block_until_ready(function())
            row.append(time.perf_counter() - start)
        seconds.append(row)
    return np.median(seconds, axis=0)


def ratios(rounds):
    many = sets(20_000)
    ours, theirs = timed([lambda: passivity.minimum_damping(*many), lambda: grid_check(*many)], rounds)
    gap = np.abs(np.asarray(passivity.minimum_damping(*many)) / grid_check(*many) - 1).max()
    yield f"20,000 passivity checks, against a grid of 4,096 frequencies (they differ by {gap:.0e})", theirs, ours

    some = sets(256)
    model = jax.vmap(lambda *q: FOSLS(viscoelastic.K0_from_effective_stiffness(*q), *q))(*some)
    certify = jax.jit(lambda model: jax.lax.map(lambda m: passivity.certify(m, 0.95).lower, model, batch_size=64))
    (seconds,) = timed([lambda: certify(model)], rounds)
    yield "256 certificates, every frequency", None, seconds

    few = sets(1000)
    K0 = np.asarray(viscoelastic.K0_from_effective_stiffness(*few))
    x = 5 * np.minimum(1, np.arange(SAMPLES) / 50)
    render = jax.jit(lambda *q: jax.lax.map(lambda p: FOSLS(*p).simulate(x), q))
    ours, theirs = timed([lambda: render(K0, *few), lambda: filtered(K0, *few, x)], rounds)
    gap = np.abs(np.asarray(render(K0, *few)) - filtered(K0, *few, x)).max()
    yield f"1,000 renderings of 3 s, against scipy's lfilter (they differ by {gap:.0e} N)", theirs, ours


def logarithmic(points):
    """Weights |c_i| gathered on `points` delays: the first half of them each, the others in groups that grow."""
    c = np.abs(taps(FOAM[3], SAMPLES))[1:]
    first = points // 2
    edges = np.unique(np.round(np.geomspace(first + 1, SAMPLES + 1, points - first + 1)).astype(int))
    edges = np.concatenate([np.arange(1, first + 1), edges])
    groups = [np.arange(low, high) for low, high in itertools.pairwise(edges)]
    weight = np.array([c[group - 1].sum() for group in groups])
    delay = np.array([np.round(np.average(group, weights=c[group - 1])) for group in groups]).astype(int)
    return weight, delay


@functools.partial(jax.jit, static_argnames="points")
def sampled_history(x, points):
    """The plain recursion with logarithmic memory: a ring of 3,000 samples, of which some are read."""
    weight, delay = (jnp.asarray(value) for value in logarithmic(points))
    K0, K1, B1, alpha = FOAM
    beta = B1 * T**-alpha
    g, k = K1 / (K1 + beta), K1 * beta / (K1 + beta)

    def step(ring, inputs):
        n, x = inputs
        past = weight @ ring[(n - delay) % (SAMPLES + 1)]
        return ring.at[n % (SAMPLES + 1)].set(past + g * (x - past)), K0 * x + k * (x - past)

    return jax.lax.scan(step, jnp.zeros(SAMPLES + 1), (jnp.arange(SAMPLES), x))[1]


def memories(rounds):
    """Name, numbers kept, microseconds per sample of the plain recursion, and largest error of the force."""
    x = viscoelastic.relaxation_load()
    exact = np.asarray(FOSLS(*FOAM, N=SAMPLES).simulate(x))

    def plain(**memory):
        return jax.jit(lambda x: FOSLS(*FOAM, **memory).simulate(x, block=1))

    kinds = [("short memory", n, plain(N=n)) for n in (10, 25, 51, 101, 201, 501, 1001, 2001)]
    kinds += [("exponentials", k, plain(memory="full", states=k)) for k in (8, 10, 12)]
    kinds += [("log-memory", p, functools.partial(sampled_history, points=p)) for p in (10, 20, 40, 80)]
    for name, size, render in kinds:
        (seconds,) = timed([functools.partial(render, x)], rounds)
        error = np.abs(np.asarray(render(x)) - exact).max() / np.abs(exact).max()
        yield name, size, 1e6 * seconds / SAMPLES, error


def plot(rows):
    import matplotlib

    matplotlib.use("Agg")
    matplotlib.rcParams["svg.hashsalt"] = "hilbo"
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(6.4, 4.0), layout="constrained")
    for name, marker in (("short memory", "o"), ("exponentials", "s"), ("log-memory", "^")):
        mine = [row for row in rows if row[0] == name]
        axes.loglog([row[2] for row in mine], [row[3] for row in mine], marker=marker, label=name)
        for _, size, micro, error in mine:
            axes.annotate(str(size), (micro, error), textcoords="offset points", xytext=(4, 4), fontsize=8)
    axes.set(xlabel="time per sample, plain recursion (µs)", ylabel="largest error / largest force")
    axes.legend()
    axes.grid(alpha=0.3)
    figure.savefig(DOCS / "results" / "memory.svg", metadata={"Date": None})


def text(rows, kept, rounds):
    lines = [
        f"Made by `python benchmarks/mechanics.py --write`: 1 core, float64, medians of {rounds} rounds in turn;",
        f"{platform.machine()}, Python {platform.python_version()}, jax {jax.__version__}.",
        "",
        "| task | NumPy/SciPy (ms) | hilbo (ms) | ratio |",
        "|---|---:|---:|---:|",
    ]
    for name, theirs, ours in rows:
        beside = ("", "") if theirs is None else (f"{1e3 * theirs:.1f}", f"{theirs / ours:.1f} x")
        lines.append(f"| {name} | {beside[0]} | {1e3 * ours:.1f} | {beside[1]} |")
    lines += [
        "",
        "Time against error of the plain recursion, one sample after the other as on a device: force of a 5 mm",
        f"relaxation over 3 s, K0, K1, B1, α = {', '.join(map(str, FOAM))}, against all 3,000 past samples.",
        "",
        "| memory | stored numbers | µs per sample | largest error / largest force |",
        "|---|---:|---:|---:|",
    ]
    lines += [f"| {name} | {size} | {micro:.2f} | {error:.1e} |" for name, size, micro, error in kept]
    lines += [
        "",
        "Log-memory reads delays that grow by a factor, from a ring that must store all of them.",
        "",
        "![time against error](memory.svg)",
    ]
    return "\n".join(lines) + "\n"


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--rounds", type=int, default=5)
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    rows, kept = list(ratios(chosen.rounds)), list(memories(chosen.rounds))
    page = text(rows, kept, chosen.rounds)
    print(page)
    if chosen.write:
        put("results/run_time.md", "mechanics", page)
        plot(kept)


if __name__ == "__main__":
    main()
