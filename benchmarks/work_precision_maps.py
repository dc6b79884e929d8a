"""The map and optimum parts of benchmarks/work_precision.py: committee machine and acquisition, time against error."""

import time

import jax
import jax.numpy as jnp
import numpy as np

from hilbo import RBF, OrdinalGP, OrdinalProbit, Study, Trials, acquisition, bcm, fit
from hilbo.search.candidates import search_points

__all__ = ["committee", "optimum"]

PEOPLE = ((4, 25), (10, 10))
STATES = 24
INFERENCES = ("laplace", "ep", "ep_corrected", "exact")
COUNTS = (256, 4096, 20000)
BEST_KNOWN = 65536


def clock(function, *args, rounds: int = 9) -> tuple[object, float]:
    """The compiled function's result and the median of its seconds."""
    result = jax.block_until_ready(function(*args))
    taken = []
    for _ in range(rounds):
        start = time.perf_counter()
        jax.block_until_ready(function(*args))
        taken.append(time.perf_counter() - start)
    return result, float(np.median(taken))


def _shared_answers():
    rng = np.random.default_rng(2000)
    x = rng.random((100, 3))
    latent = 1.6 - 4.0 * np.sum((x - np.array([0.35, 0.6, 0.4])) ** 2, axis=1) + 0.5 * rng.standard_normal(100)
    return OrdinalGP(RBF(10.0), OrdinalProbit((-0.5, 0.5), 0.5)), x, np.searchsorted([-0.5, 0.5], latent)


def committee(reference) -> str:
    """The table; `reference`: model and trials -> the pooled exact posterior."""
    gp, x, q = _shared_answers()
    x_new = jnp.asarray(np.random.default_rng(5).random((200, 3)))
    mean, variance = jax.jit(lambda t: reference(gp, t).predict(x_new))(Trials.from_arrays(x, q, 100))
    rows = ["| people x answers | inference | time (ms) | mean | sd |", "|---|---|---:|---:|---:|"]
    for people, each in ((1, 100), *PEOPLE):
        parts = [Trials.from_arrays(x[i::people], q[i::people], each) for i in range(people)]
        trials = jax.tree.map(lambda *leaves: jnp.stack(leaves), *parts)
        for inference in INFERENCES:

            def merged(trials, inference=inference):
                one = lambda t: fit(gp, t, inference=inference, throw=False).predict_explained(x_new)  # noqa: E731
                means, explained = jax.vmap(one)(trials)
                return bcm.combine_explained(means, explained, 1.0, throw=False)

            (merged_mean, spread), seconds = clock(jax.jit(merged), trials, rounds=5)
            errors = (merged_mean - mean, jnp.sqrt(spread) - jnp.sqrt(variance))
            figures = " | ".join(f"{float(jnp.sqrt(jnp.mean(e**2))):.4f}" for e in errors)
            name = f"{people} x {each}" if inference == "laplace" else ""
            rows.append(f"| {name} | {inference} | {1e3 * seconds:.1f} | {figures} |")
    return "\n".join(rows)


def _states(study):
    """Trials after 5 to 25 answers in the passive set, answered without noise around a seeded favourite."""
    for state in range(STATES):
        rng = np.random.default_rng([31, state])
        x = np.asarray(study.space.candidates(64, 100 + state))
        favourite = x[63]
        count = (5, 10, 18, 25)[state % 4]
        distance = np.linalg.norm(x[:count] - favourite, axis=1) + 0.05 * rng.standard_normal(count)
        yield Trials.from_arrays(x[:count], (2 - np.searchsorted([0.15, 0.4], distance)).astype(int), 25)


def _chooser(study, candidates, starts, dtype):
    score = acquisition.UCB(0.7)

    def choose(trials):
        posterior = fit(study.gp, trials, throw=False)
        screened = posterior.astype(dtype).predict(candidates.astype(dtype))
        return acquisition.maximise(
            score(*screened),
            candidates,
            lambda x: score(*(part[0] for part in posterior.predict(x[None, :]))),
            from_box=study.space.from_box,
            to_box=study.space.to_box,
            feasible=study.space.feasible,
            starts=starts,
        ).value

    return jax.jit(choose)


def optimum() -> str:
    """Loss of UCB and time, by candidates, precision of the screening, and polishing."""
    study = Study.load("hilbo/data/paper.toml")
    states = list(_states(study))
    choices = {"best known": _chooser(study, search_points(study.space, 999, BEST_KNOWN), 24, jnp.float64)}
    for count in COUNTS:
        candidates = search_points(study.space, 7, count)
        choices[f"{count:,} | - | float64"] = _chooser(study, candidates, 0, jnp.float64)
        choices[f"{count:,} | 3 | float64"] = _chooser(study, candidates, 3, jnp.float64)
        choices[f"{count:,} | 3 | float32"] = _chooser(study, candidates, 3, jnp.float32)
    clocked = {name: [clock(choose, t, rounds=3) for t in states] for name, choose in choices.items()}
    values = {name: np.array([float(value) for value, _ in each]) for name, each in clocked.items()}
    best = np.max(list(values.values()), axis=0)
    rows = [
        "| candidates | polished | screening | time (ms) | loss, mean | loss, worst |",
        "|---:|---:|---|---:|---:|---:|",
    ]
    for name in list(choices)[1:]:
        loss, seconds = best - values[name], np.median([s for _, s in clocked[name]])
        rows.append(f"| {name} | {1e3 * seconds:.2f} | {np.mean(loss):.1e} | {np.max(loss):.1e} |")
    return "\n".join(rows)
