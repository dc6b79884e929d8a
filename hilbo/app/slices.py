"""Slices of the posterior mean through its maximum, for the experimenter's page; one compiled function."""

import itertools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from hilbo.ordinal_gp import fit
from hilbo.session import progress
from hilbo.session.actions import LiveSession
from hilbo.session.ask_tell import Session, physical_trials

__all__ = ["Maps"]

_SIDE = 33


class Maps:
    """Makes the slices of a session's map, material by material."""

    def __init__(self, state: LiveSession):
        self._sessions: dict[str | None, Session] = {}
        for block in state.header.blocks:
            if not block.trials:
                study = state.study if block.material is None else state.study.material(block.material)
                self._sessions[block.material] = Session.start(study, state.header.seed)

    def warm(self, state: LiveSession) -> None:
        """Compile what `slices` needs."""
        for material, session in self._sessions.items():
            self._found(state, material, [])
            study = session.study
            middle = np.array([[(p.low + p.high) / 2 for p in study.space.parameters]])
            progress.trust(study, middle, [0], middle[0], state.header.seed)

    def trust(self, state: LiveSession) -> list[list[str]]:
        """How far the session has come, in words: name and value."""
        rows = []
        chosen = [i for i, b in enumerate(state.header.blocks) if not b.trials and state.answers(i)]
        block = next((i for i in chosen if not state.full(i)), chosen[-1] if chosen else None)
        found = None if block is None else progress.trust_of(state, block)
        if found is not None:
            rows.append(["Best so far", ", ".join(f"{name} {value:.3g}" for name, value in found.best.items())])
            top = state.study.responses[-1]
            rows.append([f'… would be "{top}"', f"{100 * found.top:.0f} %"])
            if found.movement is not None:
                rows.append(["… moves with one more", f"by {100 * found.movement:.1f} % of the ranges"])
        twice = progress.consistency(state)
        if twice.pairs:
            rows.append(["Asked twice", f"{twice.alike} of {twice.pairs} alike"])
        if state.screen not in ("done", "ended"):
            rows.append(["Minutes left", f"{progress.minutes_left(state):.0f}"])
        return rows

    def slices(self, state: LiveSession) -> dict[str, Any] | None:
        """For each pair of parameters: mean on a grid (row by row, None where not feasible), the maximum, and the
        trials with their distance from the slice. None where the session chooses nothing."""
        blocks = [i for i, block in enumerate(state.header.blocks) if not block.trials]
        if not blocks:
            return None
        present = state.pending.block if state.pending is not None else blocks[0]
        block = present if present in blocks else blocks[0]
        material = state.header.blocks[block].material
        answered = [t for t in state.answers(block) if t.values and "class_a" in t.values]
        return self._found(state, material, answered)

    def _found(self, state, material, answered):
        session = self._sessions[material]
        study = session.study
        names = study.space.names
        points = np.array([[t.renderings["a"][n] for n in names] for t in answered]).reshape(-1, len(names))
        answers = np.array([study.responses.index(t.values["class_a"]) for t in answered], int)
        trials = physical_trials(study, points, answers, study.selection.trials)
        posterior = fit(study.gp, trials, inference=study.inference, throw=False)
        best, mean, feasible = jax.device_get(_slices(study, posterior, session.step.best(points, answers)))
        marks = np.asarray(trials.x)[: len(answered)]
        levels = answers / (len(study.responses) - 1)
        now = self._now(state, study)
        return {"slices": [
            _slice(study, best, mean[k], feasible[k], pair, marks, levels, now)
            for k, pair in enumerate(itertools.combinations(range(len(names)), 2))
        ]}  # fmt: skip

    @staticmethod
    def _now(state, study):
        trial = state.pending
        if trial is None or trial.sets:
            return None
        return np.asarray(study.space.to_unit(np.array([trial.renderings["a"][n] for n in study.space.names])))


def _slice(study, best, mean, feasible, pair, marks, levels, now):
    names = study.space.names
    others = [k for k in range(len(names)) if k not in pair]
    held = [f"{names[k]} {float(study.space.parameters[k].to_physical(jnp.asarray(best[k]))):.3g}" for k in others]
    across, up = pair
    trials = [
        {"x": float(x[across]), "y": float(x[up]), "level": float(level), "now": False,
         "away": float(np.linalg.norm((x - best)[others]) / 0.35)}
        for x, level in zip(marks, levels, strict=True)
    ]  # fmt: skip
    if now is not None:
        trials.append({"x": float(now[across]), "y": float(now[up]), "level": 0.0, "now": True, "away": 0.0})
    shown = [
        [round(float(v), 4) if ok else None for v, ok in zip(row, oks, strict=True)]
        for row, oks in zip(mean, feasible, strict=True)
    ]
    return {
        "across": names[across],
        "up": names[up],
        "held": ", ".join(held),
        "best": [float(best[across]), float(best[up])],
        "mean": shown,
        "trials": trials,
    }


@eqx.filter_jit
def _slices(study, posterior, physical):
    best = study.space.to_unit(physical)
    axis = jnp.linspace(0.0, 1.0, _SIDE, dtype=best.dtype)
    up, across = jnp.meshgrid(axis, axis, indexing="ij")
    grids = [
        jnp.broadcast_to(best, (_SIDE * _SIDE, best.shape[0])).at[:, i].set(across.ravel()).at[:, j].set(up.ravel())
        for i, j in itertools.combinations(range(study.space.dim), 2)
    ]
    points = jnp.concatenate(grids)
    shape = (len(grids), _SIDE, _SIDE)
    return best, posterior.mean(points).reshape(shape), study.space.feasible(points).reshape(shape)
