"""Run time against the textbook NumPy form (benchmarks/reference_numpy.py), as ratios within one run.

    python benchmarks/run.py            one core, one BLAS thread, for both
    python benchmarks/run.py --cores 2  both may use two cores
    python benchmarks/run.py --write    both of these, and what limits them, into docs/benchmarks.md

The two take turns, round by round, hilbo once with Laplace and once with expectation propagation; a row is the median
over the rounds and the ratio of medians. The live step is repeated many times, for its 99th percentile.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "benchmarks"), str(ROOT)]
ASKED = {"live step": 6, "session": 6, "cohort": 5, "pooled": 1.5, "hyperparameters": 10}
NAMES = {
    "live step": "live step: 24 answers to the next point, `Session`'s own step; NumPy: best of 20,000 points",
    "session": "25-trial session, `Session.start` to the last `tell`; NumPy: 5 given points, 20 such steps",
    "cohort": "24 people x 25 trials fitted, merged (BCM) at 20,000 points; screening in float32",
    "cohort, float64": "the same in float64",
    "pooled": "one GP on 600 answers, and the best of 20,000 points",
    "pooled, all": "the same with mean and sd at all 20,000 points, float64",
    "hyperparameters": "hyperparameters (theta, noise) of 24 people by evidence, 4 starts each",
}

LIMITS = (
    "",
    "What stands between a row and its floor:",
    "",
    "- live step, session: the likelihood's terms in each Newton step, screening, polishing at walls, some Python.",
    "- pooled, EP: a sweep is a factor, as many solves as answers, the joint covariance, and Newton's matrix for all",
    "  cavity variances with its own factor: about ten times what a step towards Laplace's mode takes. Fewer than five",
    "  sweeps after Laplace's mode, or a way that never forms the joint covariance, would be needed for less.",
    "- hyperparameters: derivatives of the terms up to the fourth, and much work on small matrices. EP's evidence",
    "  is still differentiated automatically.",
)


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--cores", type=int, default=1)
    options.add_argument("--rounds", type=int, default=15)
    options.add_argument("--json", action="store_true")
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    if chosen.write:
        runs = [measured_elsewhere(cores, chosen.rounds) for cores in (1, 2)]
        (ROOT / "docs" / "benchmarks.md").write_text(document(runs, chosen.rounds))
        return
    limit_cores(chosen.cores)
    found = measure(chosen.rounds)
    print(json.dumps(found) if chosen.json else table(found) + floor_text(found))


def limit_cores(cores):
    """Before NumPy and JAX are imported."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[name] = str(cores)
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[-cores:])
    if cores == 1:
        os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false " + os.environ.get("XLA_FLAGS", "")


def measured_elsewhere(cores, rounds):
    command = [sys.executable, "-W", "ignore", __file__, "--json", "--cores", str(cores), "--rounds", str(rounds)]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1])


def data():
    import jax
    import jax.numpy as jnp
    import numpy as np

    jax.config.update("jax_enable_x64", True)
    from hilbo.config import Study
    from hilbo.ordinal_gp import Trials

    study = Study.load(ROOT / "hilbo" / "data" / "paper.toml")
    candidates = study.space.candidates(20_000, 0)
    goal = np.array([0.15, 0.18, 0.2])
    rng = np.random.default_rng(0)

    def answer(point, trial):
        distance = np.linalg.norm(point - goal) + 0.05 * np.sin(37.0 * trial)
        return int(distance < 0.4) + int(distance < 0.2)

    people = []
    for _ in range(24):
        x = candidates[rng.integers(0, len(candidates), 25)]
        people.append((x, np.array([answer(row, j) for j, row in enumerate(x)])))
    stacked = [Trials.from_arrays(x, q, 25) for x, q in people]
    trials = jax.tree.map(lambda *leaves: jnp.stack(leaves), *stacked)
    return study, candidates, answer, people, stacked[0], trials


def tasks():
    """Name -> hilbo by inference, NumPy, how many more repeats."""
    import numpy as np
    import reference_numpy as textbook

    study, candidates, answer, people, _, trials = data()
    ours = {
        inference: hilbo_tasks(with_inference(study, inference), candidates, answer, people, trials)
        for inference in ("laplace", "ep")
    }
    x, q = (np.concatenate(part) for part in zip(*people, strict=True))
    given, starts = candidates[:5], np.array([(30.0, 0.5), (120.0, 0.25), (7.5, 1.0), (480.0, 0.125)])
    theirs = {
        "live step": lambda: textbook.ucb_choice(
            *textbook.predict(textbook.fit(people[0][0][:24], people[0][1][:24]), candidates)
        ),
        "session": lambda: textbook.session_25(given, candidates, answer),
        "cohort": lambda: textbook.study_24x25_bcm(people, candidates),
        "cohort, float64": lambda: textbook.study_24x25_bcm(people, candidates),
        "pooled": lambda: textbook.ucb_choice(*textbook.predict(textbook.fit(x, q), candidates)),
        "pooled, all": lambda: textbook.predict(textbook.fit(x, q), candidates),
        "hyperparameters": lambda: [textbook.optimise_hyperparameters(*person, starts) for person in people],
    }
    return {name: ([ours[i][name] for i in ours], theirs[name]) for name in theirs}


def with_inference(study, inference):
    return type(study).from_dict(edited(study, inference))


def edited(study, inference):
    raw = json.loads(study.content) | {"schema": 1}
    raw["gp"]["inference"] = inference
    return raw


def hilbo_tasks(study, candidates, answer, people, trials):
    import equinox as eqx
    import jax
    import jax.numpy as jnp
    import numpy as np

    from hilbo.acquisition import UCB
    from hilbo.hyperparameters import maximise_evidence
    from hilbo.lattice import screen_points
    from hilbo.ordinal_gp import Trials, fit
    from hilbo.session import Session
    from hilbo.study import fit_cohort, population

    points = jnp.asarray(candidates)
    short = points.astype(jnp.float32)
    low, width = (
        np.array(part) for part in zip(*((p.low, p.high - p.low) for p in study.space.parameters), strict=True)
    )
    given = np.asarray(study.space.to_physical(people[0][0][:24]))
    begun = Session.start(study)
    pooled = Trials.from_arrays(*(np.concatenate(part) for part in zip(*people, strict=True)), 600)
    cohort = Cohort(trials)
    merge = jax.jit(lambda posteriors, points: population(posteriors.astype(points.dtype), points))
    learn = eqx.filter_jit(
        jax.vmap(lambda gp, one: maximise_evidence(gp, one, starts=4, inference=study.inference), in_axes=(None, 0))
    )

    def session():
        state = Session.start(study)
        for trial in range(25):
            unit = (np.array(list(state.ask().values())) - low) / width
            state = state.tell(study.responses[answer(unit, trial)])
        return state.answers

    @jax.jit
    def choice(gp, data, points):
        posterior = fit(gp, data, inference=study.inference, throw=False).astype(points.dtype)
        latent = posterior.latent
        return jnp.argmax(screen_points(gp.kernel, posterior.trials.x, latent.weights, latent.factor, points, UCB(0.7)))

    @jax.jit
    def everywhere(gp, data, points):
        mean, variance = fit(gp, data, inference=study.inference, throw=False).predict(points)
        return mean, jnp.sqrt(variance)

    return {
        "live step": lambda: begun.step(given, people[0][1][:24]),
        "session": session,
        "cohort": lambda: merge(fit_cohort(study, cohort), short),
        "cohort, float64": lambda: merge(fit_cohort(study, cohort), points),
        "pooled": lambda: choice(study.gp, pooled, short),
        "pooled, all": lambda: everywhere(study.gp, pooled, points),
        "hyperparameters": lambda: learn(study.gp, trials).log_evidence,
    }


class Cohort:
    """What fit_cohort looks at."""

    def __init__(self, trials):
        self.trials = trials


def once(function):
    import jax

    start = time.perf_counter()
    jax.block_until_ready(function())
    return time.perf_counter() - start


def measure(rounds):
    import numpy as np

    found = {"tasks": {}, "floors": floors(rounds)}
    for name, (ours, theirs) in tasks().items():
        for function in (*ours, theirs):
            once(function)
        count = 40 * rounds if name == "live step" else max(rounds // 5, 3) if name == "hyperparameters" else rounds
        times = np.array([[once(function) for function in (*ours, theirs)] for _ in range(count)])
        found["tasks"][name] = {
            "median": np.median(times, axis=0).tolist(),
            "p99": np.quantile(times, 0.99, axis=0).tolist(),
        }
        print(name, found["tasks"][name], file=sys.stderr)
    return found


def floors(rounds):
    """Seconds per operation of this machine through XLA, and how many steps the tasks take."""
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    numbers = {}
    for kind in ("float32", "float64"):
        pairs = -jnp.linspace(0.0, 20.0, 25 * 5000, dtype=kind).reshape(25, 5000)
        thin, square = jnp.ones((26, 25), kind), jnp.ones((600, 600), kind)
        wide = jnp.ones((600, 2000), kind)
        exp, product = jax.jit(jnp.exp), jax.jit(jnp.matmul)
        for name, call, operations in (
            ("exp", partial(exp, pairs), pairs.size),
            ("product 26 x 25 x 5,000", partial(product, thin, pairs), 26 * 25 * 5000),
            ("product 600 x 600 x 2,000", partial(product, square, wide), 600 * 600 * 2000),
        ):
            once(call)
            numbers[f"{name}, {kind}"] = min(once(call) for _ in range(4 * rounds)) / operations
    nothing = jax.jit(lambda a: a + 1)
    one = jnp.ones(())
    once(lambda: nothing(one))
    numbers["dispatch"] = min(once(lambda: nothing(one)) for _ in range(40 * rounds))
    return numbers | parts(rounds) | counts()


def parts(rounds):
    """Seconds of what a fit consists of, within a compiled loop."""
    import jax.numpy as jnp

    from hilbo.linalg import cholesky, solve_lower
    from hilbo.ordinal_gp import OrdinalTerms

    study, _, _, _, first, _ = data()
    terms = OrdinalTerms(study.gp.likelihood, first.q, first.mask)
    numbers = {}
    for n, repeats in ((25, 300), (600, 3)):
        places = jnp.linspace(0.0, 1.0, n)
        matrix = jnp.exp(-30.0 * (places[:, None] - places[None, :]) ** 2) + jnp.eye(n)
        column, lower = jnp.ones((n, 1)), jnp.linalg.cholesky(matrix)
        for name, body, start in (
            ("factor", lambda m, k=matrix: 1e-3 * cholesky(m) + k, matrix),
            ("solve", lambda c, f=lower: 1e-3 * solve_lower(f, c) + 1.0, column),
            ("solves", lambda m, f=lower, k=matrix: 1e-3 * solve_lower(f, m) + k, matrix),
            ("product", lambda m, k=matrix: 1e-3 * (k @ m) + k, matrix),
        ):
            numbers[f"{name} {n}"] = within(body, start, repeats, rounds)
    numbers["terms 25"] = within(lambda e: 0.9 * e + 1e-9 * sum(terms(e)), jnp.linspace(-1.0, 1.0, 25), 300, rounds)
    return numbers


def within(body, start, repeats, rounds):
    import jax

    many = jax.jit(lambda x: jax.lax.fori_loop(0, repeats, lambda _, value: body(value), x))
    once(lambda: many(start))
    return min(once(lambda: many(start)) for _ in range(2 * rounds)) / repeats


def counts():
    """Newton steps of the fits, and evaluations of the search for hyperparameters, as many for each start as for the
    best."""
    import equinox as eqx
    import jax
    import numpy as np

    from hilbo.hyperparameters import maximise_evidence
    from hilbo.ordinal_gp import Trials, fit

    study, _, _, people, first, trials = data()
    pooled = Trials.from_arrays(*(np.concatenate(part) for part in zip(*people, strict=True)), 600)
    learned = eqx.filter_jit(jax.vmap(lambda one: maximise_evidence(study.gp, one, starts=4)))(trials)
    steps = int(fit(study.gp, pooled).certificate.iterations)
    return {
        "steps 25": int(fit(study.gp, first).certificate.iterations),
        "steps 600": steps,
        # EP counts the steps to Laplace's mode, where it begins, with its own.
        "steps 600, ep": int(fit(study.gp, pooled, inference="ep").certificate.iterations) - (steps - 1),
        "evaluations": 4 * int(np.sum(learned.steps)),
    }


def table(found):
    lines = [
        "| task | NumPy (ms) | hilbo, Laplace (ms) | ratio (asked) | hilbo, EP (ms) | EP / Laplace |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for key, times in found["tasks"].items():
        laplace, ep, numpy = (1e3 * t for t in times["median"])
        asked = f" ({ASKED[key]})" if key in ASKED else ""
        ratio = f"{numpy / laplace:.1f} x{asked}"
        lines.append(f"| {NAMES[key]} | {numpy:.2f} | {laplace:.2f} | {ratio} | {ep:.2f} | {ep / laplace:.2f} |")
    p99 = [1e3 * t for t in found["tasks"]["live step"]["p99"]]
    lines += [
        "",
        f"99th percentile of the live step: Laplace {p99[0]:.2f} ms, EP {p99[1]:.2f} ms, NumPy {p99[2]:.2f} ms.",
    ]
    return "\n".join(lines) + "\n"


def document(runs, rounds):
    import jax

    lines = [
        "# Run time",
        "",
        "Made by `python benchmarks/run.py --write` (`make bench` prints the first table). hilbo and the textbook",
        "NumPy form, benchmarks/reference_numpy.py, take turns in one run; medians of",
        f"{rounds} rounds ({40 * rounds} of the live step); {platform.machine()}, Python {platform.python_version()},",
        f"jax {jax.__version__}. What the chosen points are worth: [choice.md](choice.md). Cold start:",
        "[cold_start.md](cold_start.md). What is skipped: [skipping.md](skipping.md).",
        "",
        "## One core, one BLAS thread",
        "",
        table(runs[0]),
        "## Two cores, two BLAS threads",
        "",
        table(runs[1]),
        "## What this machine needs for the operations alone",
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
    """What the operations that cannot be skipped take, beside what the tasks take."""
    cost, tasks = run["floors"], run["tasks"]
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
    expanded = 3 * step + cost["factor 25"] + cost["solves 25"] + 6 * cost["product 25"]
    spread = cost["steps 600, ep"] * (cost["factor 600"] + cost["solves 600"] + cost["product 600"])
    rows = [
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
    ]
    lines = [
        "",
        "| task | inference | what it cannot do without | floor (ms) | hilbo (ms) | hilbo / floor |",
        "|---|---|---|---:|---:|---:|",
    ]
    for key, which, what, floor in rows:
        took, name = tasks[key]["median"][which], ("Laplace", "EP")[which]
        lines.append(f"| {key} | {name} | {what} | {1e3 * floor:.2f} | {1e3 * took:.2f} | {took / floor:.1f} |")
    lines += ["", f"A call of a function that does nothing takes {1e6 * cost['dispatch']:.1f} us.", *LIMITS]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
