"""What benchmarks/run.py prints and writes: the times, and beside them what no program could do without."""

import platform

ASKED = {"live step": 6, "session": 6, "cohort": 5, "pooled": 1.5, "hyperparameters": 10}
ASKED |= {f"{name}, alone": ASKED[name] for name in ("live step", "session")}
NAMES = {
    "live step": "live step: 24 answers to the next point, the step of `Session`; NumPy: best of 20,000 points",
    "live step, alone": "the same, each in a separate loop",
    "session": "25-trial session, `Session.start` to the last `tell`; NumPy: 5 given points, 20 such steps",
    "session, alone": "the same, each in a separate loop",
    "cohort": "24 people x 25 trials fitted, aggregated (BCM) at 20,000 points; screening in float32",
    "cohort, float64": "the same in float64",
    "pooled": "one GP on 600 answers, and the best of 20,000 points",
    "pooled, all": "the same with mean and sd at all 20,000 points, float64",
    "hyperparameters": "hyperparameters (theta, noise) of 24 people by evidence, 4 starts each",
}

LIMITS = (
    "",
    "Differences between a row and its floor:",
    "",
    "- live step: between NumPy's steps, as between people's answers, its code and numbers leave the caches. The fit,",
    "  a quarter of a step in a loop, takes four times as long then, and a call of a function that does nothing ten",
    "  times. The rest is screening and polishing.",
    "- session: NumPy's steps are shorter while there are few answers (2.3 ms on average), hilbo's are not: its arrays",
    "  have room for all 25. Its start takes 0.5 to 1.5 ms.",
    "- pooled, EP: a sweep is a factor, as many solves as answers, the joint covariance, and Newton's matrix for all",
    "  cavity variances with its own factor: about ten times what a step towards Laplace's mode takes. Fewer than five",
    "  sweeps after Laplace's mode, or a way that never forms the joint covariance, would be needed for less.",
    "- hyperparameters: derivatives of the terms up to the fourth, and many LAPACK calls on small matrices: 3 to 9 us",
    "  each at 25 answers. EP's evidences rise towards noise 0 for 15 of the 24, which takes longer.",
)


def table(run):
    """The times of one run."""
    lines = [
        "| task | NumPy (ms) | hilbo, Laplace (ms) | ratio (target) | hilbo, EP (ms) | EP / Laplace |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for key, times in run["tasks"].items():
        laplace, ep, numpy = (1e3 * t for t in times["median"])
        asked = f" ({ASKED[key]})" if key in ASKED else ""
        ratio = f"{numpy / laplace:.1f} x{asked}"
        lines.append(f"| {NAMES[key]} | {numpy:.2f} | {laplace:.2f} | {ratio} | {ep:.2f} | {ep / laplace:.2f} |")
    p99 = [1e3 * t for t in run["tasks"]["live step"]["p99"]]
    lines += [
        "",
        f"99th percentile of the live step: Laplace {p99[0]:.2f} ms, EP {p99[1]:.2f} ms, NumPy {p99[2]:.2f} ms.",
    ]
    return "\n".join(lines) + "\n"


def document(runs, rounds):
    """A part of docs/results/run_time.md, from a run on one core and one on two."""
    import jax

    lines = [
        "Made by `python benchmarks/run.py --write` (`make bench` prints the first table). hilbo and the textbook",
        "NumPy form, benchmarks/reference_numpy.py, take turns in one run; medians of",
        f"{rounds} rounds ({40 * rounds} of the live step); {platform.machine()}, Python {platform.python_version()},",
        f"jax {jax.__version__}. Quality of the chosen points:",
        "[trial selection](accuracy.md#trial-selection-in-sessions).",
        "",
        "### One core, one BLAS thread",
        "",
        table(runs[0]),
        "### Two cores, two BLAS threads",
        "",
        table(runs[1]),
        "### What this machine needs for the operations alone",
        "",
        "Nanoseconds per exponential, and per multiplication with addition; by XLA on one core (two).",
        "",
        "| operation | float32 | float64 |",
        "|---|---:|---:|",
    ]
    for name in ("exp", "product 26 x 25 x 5,000", "product 600 x 600 x 2,000"):
        cells = [
            f"{1e9 * runs[0]['floors'][f'{name}, {kind}']:.3f} ({1e9 * runs[1]['floors'][f'{name}, {kind}']:.3f})"
            for kind in ("float32", "float64")
        ]
        lines.append(f"| {name} | {cells[0]} | {cells[1]} |")
    return "\n".join(lines) + "\n" + floor_text(runs[0])


def floor_text(run):
    """The time of the necessary operations, next to that of the tasks."""
    cost, tasks = run["floors"], run["tasks"]
    lines = [
        "",
        "| task | inference | necessary operations | floor (ms) | hilbo (ms) | hilbo / floor |",
        "|---|---|---|---:|---:|---:|",
    ]
    for key, which, what, floor in bounds(cost):
        took, name = tasks[key]["median"][which], ("Laplace", "EP")[which]
        lines.append(f"| {key} | {name} | {what} | {1e3 * floor:.2f} | {1e3 * took:.2f} | {took / floor:.1f} |")
    lines += ["", f"A call of a function that does nothing takes {1e6 * cost['dispatch']:.1f} us.", *LIMITS]
    return "\n".join(lines) + "\n"


def bounds(cost):
    """(task, inference, necessary operations, their seconds), from the seconds of `run_floors.floors`."""
    step = cost["terms 25"] + cost["factor 25"] + 2 * cost["solve 25"]
    fit = cost["steps 25"] * step + cost["factor 25"] + cost["solves 25"]
    live = cost["dispatch"] + fit + 27 * 625 * 25 * cost["product 26 x 25 x 5,000, float32"]
    cohort = {
        kind: 24 * (fit + 20_000 * (25 * cost[f"exp, {kind}"] + 26 * 25 * cost[f"product 26 x 25 x 5,000, {kind}"]))
        for kind in ("float32", "float64")
    }
    large = cost["steps 600"] * cost["factor 600"] + cost["solves 600"]
    screened = 20_000 * 600 * (cost["exp, float32"] + cost["product 600 x 600 x 2,000, float32"])
    everywhere = 20_000 * 600 * (cost["exp, float64"] + 601 * cost["product 600 x 600 x 2,000, float64"])
    # EP's terms are derived in mean and variance of the cavity: three times the work of their values and slopes.
    sweeps = 2 * (3 * cost["terms 25"] + cost["factor 25"] + cost["solves 25"] + 3 * cost["product 25"])
    expanded = 3 * step + cost["factor 25"] + cost["solves 25"] + 6 * cost["product 25"]
    spread = cost["steps 600, ep"] * (cost["factor 600"] + cost["solves 600"] + cost["product 600"])
    return [
        ("live step", 0, f"a call; {cost['steps 25']} Newton steps at 25 answers; means on the lattice, float32", live),
        ("session", 0, "20 such steps", 20 * live),
        ("cohort", 0, "24 fits; 24 x 20,000 x (25 exponentials, 26 x 25 products), float32", cohort["float32"]),
        ("cohort, float64", 0, "the same, float64", cohort["float64"]),
        (
            "pooled",
            0,
            f"{cost['steps 600']} factors of 600 x 600; 20,000 x 600 exponentials, float32",
            large + screened,
        ),
        ("pooled", 1, f"{cost['steps 600, ep']} sweeps: a factor, 600 solves, a product", large + spread + screened),
        ("pooled, all", 0, "20,000 x 600 x (1 exponential, 601 products), float64", large + everywhere),
        (
            "hyperparameters",
            0,
            f"{cost['evaluations']} evaluations: 3 Newton steps, a factor, 25 solves, 6 products of 25 x 25",
            cost["evaluations"] * expanded,
        ),
        (
            "hyperparameters",
            1,
            f"{cost['evaluations, ep']} evaluations: as much, and 2 sweeps (thrice the terms, a factor, 25 solves,"
            " 3 products)",
            cost["evaluations, ep"] * (expanded + sweeps),
        ),
    ]
