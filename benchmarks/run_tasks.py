"""What benchmarks/run.py times: the scene, each task by hilbo and by the textbook, and one call on the clock.

Imported after the number of cores has been limited.
"""

import json
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import reference_numpy as textbook

from hilbo.acquisition import UCB
from hilbo.hyperparameters.maximum_evidence import maximise_evidence
from hilbo.ordinal_gp import Trials, fit
from hilbo.search.lattice import screen_points
from hilbo.session.choose.ask_tell import Session
from hilbo.study.config import Study
from hilbo.study.estimate.aggregate import fit_cohort
from hilbo.study.estimate.optimum import predict_people

PAPER = Path(__file__).parents[1] / "hilbo" / "data" / "paper.toml"


def data():
    """Study, candidates, who answers, 24 people's (x, q), the first one's trials, everybody's; float64 from here on."""
    jax.config.update("jax_enable_x64", True)
    study = Study.load(PAPER)
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


def tasks(scene):
    """Name -> hilbo by inference, NumPy; of a scene as `data` gives it."""
    study, candidates, answer, people, _, trials = scene
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
    raw = json.loads(study.file.content) | {"schema": 1}
    raw["gp"]["inference"] = inference
    return raw


def hilbo_tasks(study, candidates, answer, people, trials):
    points = jnp.asarray(candidates)
    short = points.astype(jnp.float32)
    low, width = (
        np.array(part) for part in zip(*((p.low, p.high - p.low) for p in study.space.parameters), strict=True)
    )
    given = np.asarray(study.space.to_physical(people[0][0][:24]))
    begun = Session.start(study)
    pooled = Trials.from_arrays(*(np.concatenate(part) for part in zip(*people, strict=True)), 600)
    cohort = Cohort(trials)
    merge = jax.jit(lambda posteriors, points: predict_people(posteriors.astype(points.dtype), points))
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
    """Seconds of a call, until its result is there."""
    start = time.perf_counter()
    jax.block_until_ready(function())
    return time.perf_counter() - start
