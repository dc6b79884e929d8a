"""What a live session shows next, found before it is asked for: no fit runs after an answer.

`LiveChooser.lookahead(state)` finds the next rendering for each answer that may come; `choose` then only looks it up.
Optimisation renderings are `hilbo.session.ask_tell.Session`'s, bit for bit: they depend on the study, the seed and the
answers that count. A rendering voided twice is replaced: in the space-filling trials by the candidate farthest from all
others, afterwards by the highest UCB that keeps a distance of `APART` from it in the unit cube.

With a warm start (`hilbo.session.warm_start`, one for each material) there are no space-filling trials: points come
from it.

Every choice says why: `choice` has what chose it, mean and sd of the latent score, the acquisition's value, the
probabilities of the answers, the passivity margin (N.s/m) and the certificate of the fit.
"""

import dataclasses
import threading
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from hilbo import acquisition
from hilbo.errors import InputError
from hilbo.ordinal_gp import Trials, fit
from hilbo.search.candidates import search_points
from hilbo.session.ask_tell import Session, physical_trials
from hilbo.session.records import Need
from hilbo.session.state import LiveSession
from hilbo.session.warm_start import WarmStart, warm_point
from hilbo.study.config import Study

__all__ = ["APART", "LiveChooser", "told_of"]

APART = 0.05
"""Least distance in the unit cube from a rendering that was voided twice."""

_History = tuple[tuple[tuple[float, ...], int], ...]  # points and categories
_Key = tuple[int, _History, tuple[tuple[float, ...], ...]]


class LiveChooser:
    """Finds and remembers the renderings of one session. May be used from several threads.

    `fits` counts the choices that had to be computed with a posterior, `found` those that were looked up.
    """

    def __init__(self, state: LiveSession, warm: Mapping[str | None, WarmStart] | None = None) -> None:
        self.fits, self.found = 0, 0
        self._warm_starts = _checked_warm(state, warm or {})
        self._lock = threading.Lock()
        self._known: dict[_Key, dict[str, Any]] = {}
        header, study = state.header, state.study
        materials = {block.material for block in header.blocks}
        self._studies = {name: study if name is None else study.material(name) for name in materials}
        chosen = {block.material for block in header.blocks if not block.trials}
        self._sessions = {name: Session.start(self._studies[name], header.seed) for name in chosen}
        self._sets = {
            (name, id): _described(self._studies[name], values)
            for name in materials
            for id, values in header.sets.items()
            if any(id in (p.a, p.b) for b in header.blocks if b.material == name for p in b.trials)
        }

    def warm(self) -> None:
        """Compile what optimisation trials need."""
        for name, study in self._studies.items():
            if name in self._sessions:
                middle = tuple((p.low + p.high) / 2 for p in study.space.parameters)
                self._compute(name, ((middle, 0),) * max(1, study.selection.space_filling), ())

    def choose(self, state: LiveSession, need: Need) -> dict[str, Any]:
        """The data of a proposal: `renderings`, and `sets`, `first` or `choice`."""
        block = state.header.blocks[need.block]
        if need.repeats is not None:
            data = state.trial(need.repeats).data
            return {key: data[key] for key in ("renderings", "sets", "first", "choice") if key in data}
        if need.planned is not None:
            return self._planned(block.material, block.trials[need.planned])
        return self._look(_key(state, need.block), block.material)

    def lookahead(self, state: LiveSession) -> dict[str, dict[str, Any]]:
        """For each answer to the pending optimisation trial: what would be proposed after it. Empty where that is
        known without a fit."""
        trial = state.pending
        if trial is None or trial.repeats is not None or state.header.blocks[trial.block].trials:
            return {}
        block = state.header.blocks[trial.block]
        if len(state.answers(trial.block)) + 1 >= state.quota(trial.block):
            return {}
        number, history, excluded = _key(state, trial.block)
        point = tuple(trial.renderings["a"][name] for name in state.study.space.names)
        return {
            response: self._look((number, (*history, (point, category)), excluded), block.material, count=False)
            for category, response in enumerate(state.study.responses)
        }

    def _planned(self, material, planned):
        sides = {"a": planned.a} if planned.b is None else {"a": planned.a, "b": planned.b}
        described = {side: self._sets[material, id] for side, id in sides.items()}
        return {
            "renderings": {side: dict(found["parameters"]) for side, found in described.items()},
            "sets": sides,
            "first": planned.first,
            "choice": {"by": "plan", "margin": {side: found["margin"] for side, found in described.items()}},
        }

    def _look(self, key, material, count=True):
        with self._lock:
            if key in self._known:
                self.found += count
            else:
                self._known[key] = self._compute(material, key[1], key[2])
            return self._known[key]

    def _compute(self, material, history, excluded):
        study, session, warm = self._studies[material], self._sessions[material], self._warm_starts.get(material)
        points = np.array([point for point, _ in history], float).reshape(len(history), study.space.dim)
        answers = np.array([category for _, category in history], int)
        initial = session.step.initial
        gone = np.array(excluded, float).reshape(-1, study.space.dim)
        if warm is not None:
            self.fits += 1
            found, by = _from_map(study, warm, *_padded(study, points, answers), np.int32(len(history)), gone), "map"
        elif len(history) < len(initial):
            found = _not_among(study, initial[len(history)], gone, np.concatenate([initial, points]), session.seed)
            by = "latin hypercube"
        else:
            self.fits += 1
            found, by = session.step(points, answers), study.selection.acquisition
            if _near(study, found, gone):
                found, by = _apart(study, session, points, answers, gone), "ucb, apart"
        trials = physical_trials(study, points, answers, study.selection.trials)
        posterior = fit(study.gp, trials, inference=study.inference, throw=False)
        terms = _terms(study, posterior, np.asarray(found))
        return _explained(study, found, by, terms)


def told_of(warm: Mapping[str | None, WarmStart]) -> str | None:
    """What a header says of a session's warm starts, one for each material; None where there are none."""
    return ",".join(f"{name or ''}={warm[name].source}" for name in sorted(warm, key=str)) or None


def _key(state, block) -> _Key:
    names = state.study.space.names
    history = tuple(
        (tuple(t.renderings["a"][n] for n in names), state.study.responses.index(t.values["class_a"]))
        for t in state.answers(block)
    )
    return block, history, tuple(tuple(point[n] for n in names) for point in state.excluded(block))


def _checked_warm(state, warm):
    """The warm starts, which must be those of the header: the next trial is to be the same after a resume."""
    told = told_of(warm)
    if told != state.header.warm_start:
        raise InputError(
            f"the session's warm start is {state.header.warm_start or 'none'}, not {told or 'none'}; give the maps that"
            " it was begun with."
        )
    return dict(warm)


def _from_map(study, warm, x, q, count, gone):
    return np.asarray(_map_point(study, warm, x, q, count, _held(study, gone)))


def _held(study, gone):
    """The points that are gone, padded with places far away, so that nothing is compiled again for one more."""
    held = np.full((max(8, len(gone)), study.space.dim), 9.0)
    if len(gone):
        held[-len(gone) :] = _units(study, gone)
    return jnp.asarray(held)


@eqx.filter_jit
def _map_point(study, warm, points, answers, count, gone):
    trials = Trials(study.space.to_unit(points), answers, jnp.arange(len(points), dtype=count.dtype) < count)
    return study.space.to_physical(warm_point(study, warm, trials, gone, APART))


def _near(study, point, gone) -> bool:
    """Whether a point is nearer than `APART` to one that is gone."""
    if not len(gone):
        return False
    unit = _units(study, np.concatenate([gone, np.asarray(point)[None]]))
    return bool(np.min(np.linalg.norm(unit[:-1] - unit[-1], axis=1)) < APART)


def _units(study, physical):
    return np.asarray(study.space.to_unit(physical))


def _not_among(study, point, gone, others, seed):
    """A space-filling point; in place of one that is gone, the candidate farthest from all points so far."""
    if not any(np.array_equal(point, other) for other in gone):
        return point
    candidates = study.space.candidates(256, seed)
    distance = np.linalg.norm(candidates[:, None] - _units(study, np.concatenate([others, gone]))[None], axis=2)
    return np.asarray(study.space.to_physical(candidates[int(distance.min(axis=1).argmax())]))


def _padded(study, points, answers):
    capacity, count = study.selection.trials, len(answers)
    middle = np.array([(p.low + p.high) / 2 for p in study.space.parameters])
    x, q = np.tile(middle, (capacity, 1)), np.zeros(capacity, np.int32)
    x[:count], q[:count] = points, answers
    return x, q


@eqx.filter_jit
def _terms(study, posterior, x):
    """Mean, variance and class probabilities at x, the certificate of the fit, and what the space says of x."""
    unit = study.space.to_unit(x)
    mean, variance = posterior.predict(unit[None, :])
    values = dict(zip(study.space.names, x, strict=True))
    derived = study.space.derived(values)
    return {
        "unit": unit,
        "mean": mean[0],
        "variance": variance[0],
        "probabilities": study.gp.likelihood.class_probabilities(mean[0], variance[0]),
        "certificate": posterior.certificate,
        "derived": derived,
        "margin": study.space.passivity_margin(values),
    }


def _explained(study, point, by, terms):
    terms = jax.device_get(terms)
    parameters = dict(zip(study.space.names, np.asarray(point).tolist(), strict=True))
    mean, sd = float(terms["mean"]), float(np.sqrt(terms["variance"]))
    certificate = terms["certificate"]
    choice = {
        "by": by,
        "unit": terms["unit"].tolist(),
        "mean": mean,
        "sd": sd,
        "score": mean + study.selection.weight * sd if by.startswith("ucb") else None,
        "probabilities": dict(zip(study.responses, terms["probabilities"].tolist(), strict=True)),
        "margin": None if terms["margin"] is None else float(terms["margin"]),
        "certificate": {
            field.name: getattr(certificate, field.name).item() for field in dataclasses.fields(certificate)
        },
    }
    derived = {name: float(value) for name, value in terms["derived"].items()}
    return {"renderings": {"a": parameters | derived}, "choice": choice}


def _described(study: Study, values: Mapping[str, float]) -> dict[str, Any]:
    """A planned set with what follows from it, and its passivity margin."""
    derived, margin = _facts(study, {name: np.asarray(values[name], float) for name in study.space.names})
    parameters = {name: float(values[name]) for name in study.space.names}
    parameters |= {name: float(value) for name, value in derived.items()}
    return {"parameters": parameters, "margin": None if margin is None else float(margin)}


@eqx.filter_jit
def _facts(study, values):
    return study.space.derived(values), study.space.passivity_margin(values)


def _apart(study, session, points, answers, gone) -> np.ndarray:
    candidates = search_points(study.space, session.seed)
    x, q = _padded(study, points, answers)
    return np.asarray(_apart_point(study, x, q, np.int32(len(answers)), _held(study, gone), candidates))


@eqx.filter_jit
def _apart_point(study, points, answers, count, gone, candidates):
    """The highest UCB that keeps its distance from the points `gone` (k, d) of the unit cube, in physical units."""
    trials = Trials(study.space.to_unit(points), answers, jnp.arange(len(points), dtype=count.dtype) < count)
    posterior = fit(study.gp, trials, inference=study.inference, throw=False)
    score = acquisition.UCB(study.selection.weight)

    def score_at(x):
        mean, variance = posterior.predict(x[None, :])
        return score(mean[0], variance[0])

    def allowed(x):
        return jnp.all(jnp.sum((gone - x[None, :]) ** 2, axis=1) >= APART**2)

    found = acquisition.maximise(
        score(*posterior.predict(candidates)),
        candidates,
        score_at,
        from_box=study.space.from_box,
        to_box=study.space.to_box,
        feasible=study.space.feasible,
        allowed=allowed,
    )
    return study.space.to_physical(found.x)
