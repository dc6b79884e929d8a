"""Run time against the textbook NumPy form (benchmarks/reference_numpy.py), as ratios within one run.

    python benchmarks/run.py            one core, one BLAS thread, for both
    python benchmarks/run.py --cores 2  the process may use two cores; NumPy keeps one BLAS thread

The two take turns, round by round; a row is the median over the rounds and the ratio of medians. Writes
docs/benchmarks.md with --write.
"""

import argparse
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--cores", type=int, default=1)
    options.add_argument("--rounds", type=int, default=15)
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    available = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, available[-chosen.cores :])
    if chosen.cores == 1:
        os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false " + os.environ.get("XLA_FLAGS", "")
    rows = [timed(name, ours, theirs, chosen.rounds) for name, ours, theirs in tasks()]
    os.sched_setaffinity(0, available)
    text = table(rows, cold_start(), chosen)
    print(text)
    if chosen.write:
        (ROOT / "docs" / "benchmarks.md").write_text(text)


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
    import functools

    import equinox as eqx
    import jax
    import jax.numpy as jnp
    import numpy as np
    import reference_numpy as textbook

    from hilbo import session as session_module
    from hilbo.hyperparameters import maximise_evidence
    from hilbo.ordinal_gp import Trials, fit
    from hilbo.study import fit_cohort, population

    study, candidates, answer, people, one, trials = data()
    points = jnp.asarray(candidates)

    short = points.astype(jnp.float32)

    @jax.jit
    def step(gp, data, points):
        posterior = fit(gp, data, throw=False).astype(points.dtype)
        mean, variance = posterior.predict(points)
        return jnp.argmax(mean + 0.7 * jnp.sqrt(variance))

    def live_numpy():
        posterior = textbook.fit(*people[0])
        return textbook.ucb_choice(*textbook.predict(posterior, candidates))

    def session(screened):
        data = Trials.empty(25, 3)
        for trial in range(25):
            row = trial if trial < 5 else int(step(study.gp, data, screened))
            data = append(data, candidates[row], answer(candidates[row], trial))
        return data.q

    def own_session():
        data = Trials.empty(25, 3)
        for trial in range(25):
            point = candidates[trial] if trial < 5 else own(data)
            data = append(data, point, answer(np.asarray(point), trial))
        return data.q

    append = jax.jit(lambda data, x, q: data.append(x, q))
    plan = session_module.design(study, 0)
    own = jax.jit(lambda data: session_module.next_point(study, plan, data, 24))  # UCB does not look at the trial
    starts = [(30.0, 0.5), (120.0, 0.25), (7.5, 1.0), (480.0, 0.125)]
    learn = eqx.filter_jit(functools.partial(maximise_evidence, learn=("theta", "noise"), starts=4))
    merge = jax.jit(lambda posteriors, points: population(posteriors.astype(points.dtype), points))
    live, whole = (
        "fit n = 25, mean and sd at 20,000 candidates, choice",
        "24 people x 25 trials, fitted and merged (BCM)",
    )
    given = candidates[:5]
    tasks = []
    for kind, where in (("float64", points), ("float32 screening", short)):
        tasks += [
            (f"live step: {live}; {kind}", functools.partial(step, study.gp, one, where), live_numpy),
            (
                f"25-trial session: 5 given points, 20 such steps; {kind}",
                functools.partial(session, where),
                lambda: textbook.session_25(given, candidates, answer),
            ),
            (
                f"{whole} at 20,000 points; {kind}",
                lambda where=where: merge(fit_cohort(study, Cohort(trials)), where),
                lambda: textbook.study_24x25_bcm(people, candidates),
            ),
        ]
    as_sessions = "as sessions do it: 5,120 points, the best polished"
    return [
        *tasks,
        (
            f"live step {as_sessions}, against the best of 20,000",
            lambda: own(one),
            live_numpy,
        ),
        (
            f"25-trial session {as_sessions}, against the best of 20,000",
            own_session,
            lambda: textbook.session_25(given, candidates, answer),
        ),
        (
            "hyperparameters (theta, noise) of one person by evidence, 4 starts",
            lambda: learn(study.gp, one).log_evidence,
            lambda: textbook.optimise_hyperparameters(*people[0], np.array(starts)),
        ),
    ]


class Cohort:
    """What fit_cohort looks at."""

    def __init__(self, trials):
        self.trials = trials


def timed(name, ours, theirs, rounds):
    import jax

    def once(function):
        start = time.perf_counter()
        jax.block_until_ready(function())
        return time.perf_counter() - start

    both = [f for f in (ours, theirs) if f]
    for function in both:
        once(function)
        once(function)
    times = [[once(function) for function in both] for _ in range(rounds)]
    medians = [sorted(column)[rounds // 2] for column in zip(*times, strict=True)]
    return name, *medians


def cold_start():
    """Seconds of whole processes: what a user waits for."""
    first = (
        "import jax; jax.config.update('jax_enable_x64', True)\n"
        "from hilbo import Session, Study\n"
        f"s = Session.start(Study.load({str(ROOT / 'hilbo/data/paper.toml')!r}))\n"
        "for _ in range(5): s = s.tell('different')\n"
        "print(s.ask())"
    )
    rows = []
    with tempfile.TemporaryDirectory() as cache:
        env = os.environ | {
            "JAX_COMPILATION_CACHE_DIR": cache,
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
        }
        for name, code in (
            ("`import jax`", "import jax"),
            ("`import hilbo`", "import hilbo"),
            ("first chosen point of a session, empty compilation cache", first),
            ("the same, warm cache", first),
        ):
            start = time.perf_counter()
            subprocess.run([sys.executable, "-W", "ignore", "-c", code], env=env, check=True, capture_output=True)
            rows.append((name, time.perf_counter() - start))
    return rows


def table(rows, cold, chosen):
    import jax

    cores = f"{chosen.cores} core{'s' if chosen.cores > 1 else ''}"
    lines = [
        "# Run time",
        "",
        "Made by `python benchmarks/run.py --write` (`make bench` prints it). Ratios against the textbook NumPy form,",
        f"benchmarks/reference_numpy.py in the same run, {cores}, one BLAS thread, float64, medians of {chosen.rounds}",
        f"rounds in turn; {platform.machine()}, Python {platform.python_version()}, jax {jax.__version__}.",
        "",
        "| task | NumPy (ms) | hilbo (ms) | ratio |",
        "|---|---:|---:|---:|",
    ]
    lines += [f"| {name} | {1e3 * b:.2f} | {1e3 * a:.2f} | {b / a:.1f} x |" for name, a, b in rows]
    lines += [
        "",
        "What sessions choose has a UCB 0.005 higher than the best of 20,000 points on average, and lower in 3 of 480",
        "states (by 0.006 at most), counted over the preset's simulated sessions.",
        "",
        "Whole processes, cold start:",
        "",
        "| process | seconds |",
        "|---|---:|",
    ]
    lines += [f"| {name} | {seconds:.1f} |" for name, seconds in cold]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
