"""Do the intervals of an identification hold what they promise? And how long does one take?

    python benchmarks/identification.py coverage --noise white --sets 1000   a study in pieces, kept in --keep
    python benchmarks/identification.py coverage --noise ar1 --sets 1000
    python benchmarks/identification.py select                               N-selection on two materials
    python benchmarks/identification.py time                                 against scipy's least_squares and lfilter
    python benchmarks/identification.py example                              the shipped table, simulated again
    python benchmarks/identification.py write                                into docs/methods/identification.md

Every simulated data set is the set S of the paper (N = 101) under both loads, as a device would apply them (ramps of
20 ms), each with 16 repeats and noise of 4 % of the curve's range if it is white, of 1 % if it is AR(1) with 0.9 from
one ms to the next, which leaves the data about as much to say. `loud` is AR(1) noise of 4 %.
"""

import argparse
import json
import os
import time
import warnings
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from pages import put

ROOT = Path(__file__).parents[1]
TRUTH = (-2.89, 5.70, 5.89, 0.203)
REPEATS = 16
MEMORY = {"white": 0.0, "ar1": 0.9, "loud": 0.9}  # correlation from one ms to the next
NOISE = {"white": 0.04, "ar1": 0.01, "loud": 0.04}  # of the range, in each repeat
NAMES = ("K_inst", "K_eff", "log κ", "logit α")
LEVEL = 0.95


def loads(T=1e-3, rise=0.02):
    """Times and inputs of the paper's tests: 5 mm for 3 s; 3 N for 3 s, then 0.5 N for 3 s."""
    t, u = np.arange(0, 3 + T / 2, T), np.arange(0, 6 + T / 2, T)
    x = 5 * np.minimum(t / rise, 1)
    F = 3 * np.minimum(u / rise, 1) - 2.5 * np.clip((u - 3) / rise, 0, 1)
    return (t, x), (u, F)


def rational(K0, K1, B1, alpha, N, T=1e-3):
    """Numerator and denominator of H(z), as anybody would write them."""
    c = np.cumprod(np.concatenate([[1.0], (np.arange(1, N + 1) - 1 - alpha) / np.arange(1, N + 1)]))
    beta = B1 * T**-alpha
    denominator = beta * c
    denominator[0] += K1
    return K0 * denominator + K1 * beta * c, denominator


def clean(parameters=TRUTH, N=101):
    """Curves without noise."""
    from scipy.signal import lfilter

    (t, x), (u, F) = loads()
    top, bottom = rational(*parameters, N)
    return (t, x, lfilter(top, bottom, x)), (u, F, lfilter(bottom / top[0], top / top[0], F))


def measured(parameters=TRUTH, N=101, repeats=1):
    from hilbo.identification.fitting import Test

    curves = zip(("relaxation", "creep"), clean(parameters, N), strict=True)
    return [Test(kind, t, np.tile(out, (repeats, 1)), np.tile(put, (repeats, 1))) for kind, (t, put, out) in curves]


def study():
    """A compiled function from the outputs of many data sets to estimates and intervals, and one that makes outputs."""
    import equinox as eqx
    import jax
    import jax.numpy as jnp

    from hilbo.identification import fitting, intervals
    from hilbo.identification.sampled import Sampled

    tests = measured(repeats=REPEATS)
    model = Sampled().at(tests)
    curves = tuple(model.prepare(test) for test in tests)
    weights = tuple(jnp.full(REPEATS, 1 / REPEATS) for _ in tests)
    lower, upper = (jnp.asarray(end) for end in model.box(tests))
    starts = jnp.asarray(model.starts(tests))

    def one(data):
        key, *outputs = data
        measured = tuple(eqx.tree_at(lambda c: c.output, c, o) for c, o in zip(curves, outputs, strict=True))
        best, costs = fitting.search(model, measured, weights, starts, lower, upper)
        fitted = fitting.Fit(model, measured, best, lower, upper, costs, weights)
        return best.q, intervals.profile_intervals(fitted), intervals.block_bootstrap(fitted, key, 1000)

    return jax.jit(lambda data: jax.lax.map(one, data)), tests


def noisy(tests, noise, numbers):
    """Outputs of the data sets with these numbers, each with random numbers of its own."""
    from scipy.signal import lfilter

    rho, outputs = MEMORY[noise], [[] for _ in tests]
    for number in numbers:
        rng = np.random.default_rng((7, number, len(noise)))
        for test, rows in zip(tests, outputs, strict=True):
            fresh = rng.standard_normal(test.output.shape)
            fresh[:, 1:] *= np.sqrt(1 - rho**2)
            size = NOISE[noise] * np.ptp(test.output[0])
            rows.append(test.output + size * lfilter([1.0], [1.0, -rho], fresh, axis=1))
    return tuple(np.stack(rows) for rows in outputs)


def coverage(chosen):
    """Runs what is missing of a study, in pieces that are kept."""
    import jax

    chosen.keep.mkdir(parents=True, exist_ok=True)
    run, tests = study()
    for begin in range(0, chosen.sets, chosen.piece):
        path = chosen.keep / f"{chosen.noise}-{begin:05d}-{chosen.piece}.npz"
        if path.exists():
            continue
        count = min(chosen.piece, chosen.sets - begin)
        start = time.perf_counter()
        keys = jax.random.split(jax.random.key(begin), count)
        q, profile, boot = jax.block_until_ready(run((keys, *noisy(tests, chosen.noise, range(begin, begin + count)))))
        fields = {name: np.asarray(value) for name, value in vars(profile).items()}
        np.savez(path, q=q, boot_lower=boot[0], boot_upper=boot[1], **fields)
        print(f"{path.name}: {(time.perf_counter() - start) / count:.2f} s a set", flush=True)
    print(json.dumps(summary(chosen.keep, chosen.noise), indent=1))


def summary(folder, noise):
    """Shares of intervals that hold the truth, one-sided ones apart."""
    from hilbo.identification.sampled import Sampled

    pieces = [np.load(path) for path in sorted(folder.glob(f"{noise}-*.npz"))]
    if not pieces:
        return None
    data = {key: np.concatenate([np.atleast_1d(piece[key]) for piece in pieces]) for key in pieces[0]}
    truth = Sampled().coordinates(*TRUTH)
    lower = np.where(data["open_lower"], -np.inf, data["lower"])
    upper = np.where(data["open_upper"], np.inf, data["upper"])
    two = ~data["open_lower"] & ~data["open_upper"] & data["bracketed"]
    holds = (lower <= truth) & (truth <= upper)
    boot = (data["boot_lower"] <= truth) & (truth <= data["boot_upper"])
    rows = {}
    for j, name in enumerate(NAMES):
        chosen, open_ = two[:, j], ~two[:, j] & data["bracketed"][:, j]
        rows[name] = {
            "profile": holds[chosen, j].mean(),
            "two-sided": int(chosen.sum()),
            "one-sided": int(open_.sum()),
            "one-sided holds": int(holds[open_, j].sum()),
            "failed": int((~data["bracketed"][:, j]).sum()),
            "bootstrap": boot[:, j].mean(),
            "bias": float((data["q"][:, j] - truth[j]).mean() / data["q"][:, j].std()),
        }
    return {"sets": len(data["q"]), "rows": rows}


MATERIALS = {
    "the published model, N = 101": (TRUTH, 101),
    "an exact material that relaxes within the test (τ = 0.5 s)": ((0.44, 1.3, 1.0, 0.35), 7000),
    "an exact material that goes on relaxing (τ = 14 s)": ((0.44, 1.2, 3.0, 0.35), 7000),
}


def select():
    """N-selection without noise; a filter with more taps than samples is an exact (sampled) material."""
    from hilbo.identification.memory_selection import select_memory

    lines = []
    for name, (parameters, N) in MATERIALS.items():
        words = ", ".join(f"{k} = {v:g}" for k, v in zip(("K0", "K1", "B1", "α"), parameters, strict=True))
        lines += [
            f"Data: {name} ({words}).",
            "",
            "| N | relaxation | creep | K0 | K1 | B1 | α | |",
            "|---:|" + "---:|" * 6 + "---|",
        ]
        for row in select_memory(measured(parameters, N)):
            values, errors = row.fit.parameters(), [f"{100 * row.nrmse[k]:.3f} %" for k in ("relaxation", "creep")]
            numbers = [f"{values[k]:.3g}" for k in ("K0", "K1", "B1", "alpha")]
            held = [label for label, at in zip(row.fit.model.labels, row.fit.held(), strict=True) if at]
            note = f"{', '.join(held)} at its bound" if held else "" if row.fit.solution.converged else "flat valley"
            lines.append("| " + " | ".join(["full" if row.N is None else str(row.N), *errors, *numbers, note]) + " |")
        lines.append("")
    return "\n".join(lines)


def timing(rounds=5):
    """One identification, five starts, both tests: seconds of the textbook form and of hilbo, and their costs."""
    import jax
    from scipy.optimize import least_squares
    from scipy.signal import lfilter

    from hilbo.identification.fitting import fit
    from hilbo.identification.sampled import Sampled

    outputs = noisy(measured(repeats=REPEATS), "white", [0])
    tests = [type(t)(t.kind, t.time, o[0], t.input) for t, o in zip(measured(repeats=REPEATS), outputs, strict=True)]
    model = Sampled()
    box, starts = model.box(tests), model.starts(tests)
    means = [(t.kind, t.input.mean(axis=0), t.output.mean(axis=0)) for t in tests]

    def residuals(q):
        kappa, alpha = np.exp(q[2]), 1 / (1 + np.exp(-q[3]))
        S = np.prod(1 - alpha / np.arange(1, 102))
        K1 = (q[0] - q[1]) * (1 + kappa) * (kappa + S) / (kappa * (1 - S))
        top, bottom = rational(q[1] - K1 * S / (kappa + S), K1, K1 / kappa * 1e-3**alpha, alpha, 101)
        parts = []
        for kind, applied, out in means:
            pair = (top, bottom) if kind == "relaxation" else (bottom / top[0], top / top[0])
            parts.append((out - lfilter(*pair, applied)) / (np.ptp(out) * np.sqrt(out.size)))
        return np.concatenate(parts)

    def textbook():
        runs = [least_squares(residuals, np.clip(q, *box), bounds=box, x_scale="jac") for q in starts]
        return 2 * min(run.cost for run in runs)

    ours = lambda: float(jax.block_until_ready(fit(tests, model).solution.cost))  # noqa: E731
    times, costs = [], (textbook(), ours())
    for _ in range(rounds):
        pair = []
        for function in (textbook, ours):
            start = time.perf_counter()
            function()
            pair.append(time.perf_counter() - start)
        times.append(pair)
    slow, fast = np.median(times, axis=0)
    return (
        "| task | scipy (ms) | hilbo (ms) | ratio |\n|---|---:|---:|---:|\n"
        "| identification of both tests, 9,002 samples, N = 101, five starts: `least_squares` on `lfilter` with finite"
        f" differences, against a screened grid and exact Jacobians | {1e3 * slow:.0f} | {1e3 * fast:.0f} |"
        f" {slow / fast:.1f} x |\n\nFinal sums of NRMSE²: {costs[0]:.9e} and {costs[1]:.9e}.\n"
    )


def coverage_table(folder):
    """Shares of intervals that hold the truth."""
    lines = [
        "| noise | coordinate | profile: two-sided | coverage | one-sided | coverage | search failed | bootstrap |",
        "|---|---|---:|---:|---:|---:|---:|---:|",
    ]
    for noise, rho in MEMORY.items():
        shares = summary(folder, noise)
        label = f"white, {100 * NOISE[noise]:g} %" if rho == 0 else f"AR(1), {rho:g}, {100 * NOISE[noise]:g} %"
        for name, row in shares["rows"].items() if shares else ():
            one = (
                f"{row['one-sided']} | {100 * row['one-sided holds'] / row['one-sided']:.1f} %"
                if row["one-sided"]
                else "0 |"
            )
            lines.append(
                f"| {label} | {name} | {row['two-sided']} | {100 * row['profile']:.1f} % | {one} | {row['failed']} |"
                f" {100 * row['bootstrap']:.1f} % |"
            )
    return "\n".join(lines) + "\n"


def write(folder):
    """Each table into docs/methods/identification.md; a study that has not been run keeps its old table."""
    made = {"select": select, "time": timing}
    if folder.exists():
        made["coverage"] = lambda: coverage_table(folder)
    for name, make in made.items():
        put("methods/identification.md", name, make())


def example():
    """The shipped table of simulated memory foam: 16 repeats a test, every 10 ms, as a careful logger writes them."""
    import pandas as pd
    from scipy.signal import lfilter

    rng, rows = np.random.default_rng(2026), []
    top, bottom = rational(*TRUTH, 101)
    for kind, (t, load), forward in zip(("relaxation", "creep"), loads(), (True, False), strict=True):
        for repeat in range(1, REPEATS + 1):
            applied = load * (1 + 0.01 * rng.standard_normal())
            model = (top, bottom) if forward else (bottom, top)
            answer = lfilter(model[0] / model[1][0], model[1] / model[1][0], applied)
            answer += lfilter([1], [1, -0.7], 0.006 * np.ptp(answer) * rng.standard_normal(t.size))
            pair = (applied, answer) if forward else (answer, applied)
            columns = {"test": kind, "repeat": repeat, "time_s": t.round(3), "position_mm": pair[0], "force_N": pair[1]}
            rows.append(pd.DataFrame(columns)[::10])
    table = pd.concat(rows).round({"position_mm": 4, "force_N": 4})
    table.to_csv(ROOT / "hilbo" / "data" / "memory_foam_simulated.csv", index=False)


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("task", choices=("coverage", "select", "time", "example", "write"))
    options.add_argument("--noise", choices=tuple(MEMORY), default="white")
    options.add_argument("--sets", type=int, default=1000)
    options.add_argument("--piece", type=int, default=50)
    options.add_argument("--keep", type=Path, default=ROOT / "identification-study", help="folder for the pieces")
    chosen = options.parse_args()
    warnings.filterwarnings("ignore", category=DeprecationWarning)
    import jax

    jax.config.update("jax_enable_x64", True)
    tasks = {
        "coverage": lambda: coverage(chosen),
        "example": example,
        "select": lambda: print(select()),
        "time": lambda: print(timing()),
        "write": lambda: write(chosen.keep),
    }
    tasks[chosen.task]()


if __name__ == "__main__":
    main()
