"""Slices of the posterior mean through its maximum, for the experimenter's page; one compiled function.

There is a slice for each pair of parameters. A single parameter has one slice, with the answer on the vertical axis.
"""

import itertools
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import Posterior
from hilbo.search.apart import differences
from hilbo.search.box import Parameter
from hilbo.search.rendering import Rendering
from hilbo.session.choose import progress
from hilbo.session.choose.choice import Answers
from hilbo.session.choose.look_ahead import LiveChooser
from hilbo.session.log.state import LiveSession
from hilbo.study.config import Study

__all__ = ["Maps"]

_SIDE = 33
_ANSWER = "answer given"  # vertical axis of a map with one parameter
_Pair = tuple[int, int | None]  # of parameters, across and up


class Maps:
    """Computes the slices of a session's posterior, material by material, from the fits that its chooser caches."""

    def __init__(self, chooser: LiveChooser):
        self._chooser = chooser

    def warm(self) -> None:
        """Compile what `slices` and `trust` need, for each block whose trials are chosen, by a fit without answers."""
        for block in self._chooser.chosen_blocks:
            fitted, study = self._chooser.fitted(Answers(block)), self._chooser.study(block)
            self._sliced(Answers(block), None)
            following = [fitted] * len(study.responses)
            progress.trust(self._chooser, block, fitted, fitted.point, following)

    def trust(self, state: LiveSession) -> list[list[str]]:
        """How far the session has come, as rows of name and value: the best rendering so far, its expected shift with
        one more trial, and the agreement of repeated trials. Only rows that are known; of the block that is running, or
        the last one."""
        rows = []
        chosen = [i for i in self._chooser.chosen_blocks if state.answers(i)]
        block = next((i for i in chosen if not state.full(i)), chosen[-1] if chosen else None)
        trust = None if block is None else progress.trust_of(state, block, self._chooser)
        if trust is not None:
            parameters = ((p, trust.best[p.name]) for p in state.study.space.parameters)
            named = (f"{p.name} {p.words(value) if p.levels else f'{value:.3g}'}" for p, value in parameters)
            rows.append(["Current optimum", ", ".join(named)])
            if trust.movement is not None:
                rows.append(["Expected shift after one more trial", f"{100 * trust.movement:.1f} % of the ranges"])
        twice = progress.consistency(state)
        if twice.pairs:
            rows.append(["Test–retest agreement", f"{twice.alike} of {twice.pairs}"])
        return rows

    def slices(self, state: LiveSession) -> dict[str, Any] | None:
        """A dict for JSON, None if the session chooses no trials.

        "slices": for each pair of parameters, or the only one, the posterior mean on a grid (rows from low to high;
        None where not feasible), the maximum, and the trials with their distance from the slice; empty before the first
        answer. "ranges": each parameter's range and unit.
        """
        blocks = self._chooser.chosen_blocks
        if not blocks:
            return None
        trial = state.pending
        block = trial.block if trial is not None and trial.block in blocks else blocks[0]
        asked = None if trial is None or trial.sets else trial.presented["a"]
        answers = Answers.of(state, block)
        slices = self._sliced(answers, asked) if answers.categories else []
        parameters = self._chooser.study(block).space.parameters
        ranges = {
            p.name: {"unit": p.unit, "scale": p.scale, "low": p.low, "high": p.high, "levels": p.levels}
            for p in parameters
        }
        if len(self._chooser.study(block).space.free) == 1:
            ranges[_ANSWER] = {"unit": "", "scale": "linear", "low": 0, "high": 1, "levels": state.study.responses}
        return {"slices": slices, "ranges": ranges}

    def _sliced(self, answers: Answers, asked: Mapping[str, float] | None) -> list[dict[str, Any]]:
        """The slices after some answers, as dicts for JSON. `asked`: parameters of the rendering that is presented, in
        physical units, or None."""
        study, fitted = self._chooser.study(answers.block), self._chooser.fitted(answers)
        best = self._chooser.best(answers.block, fitted)
        maps: _Slices = jax.device_get(_slices(study, fitted.posterior, best))
        marks = np.asarray(fitted.posterior.trials.x)[: len(answers.categories)]
        levels = np.array(answers.categories, int) / (len(study.responses) - 1)
        felt = None if asked is None else Rendering.of(study.space, asked).unit
        pairs = enumerate(_pairs(study.space.free))
        return [_slice(study, maps, k, pair, marks, levels, felt) for k, pair in pairs]


def _pairs(free: tuple[int, ...]) -> list[_Pair]:
    """Indices of the parameters on the horizontal and vertical axis of each slice, of those that are `free`; (index,
    None) for a single one."""
    return [*itertools.combinations(free, 2)] or [(free[0], None)]


class _Slices(NamedTuple):
    """The maximum in the unit cube, and the posterior mean and the feasibility on the grids through it (row: vertical
    axis)."""

    best: Float[Array, " d"]
    mean: Float[Array, "pairs side side"]
    feasible: Bool[Array, "pairs side side"]


def _slice(study, maps: _Slices, k: int, pair: _Pair, marks, levels, felt) -> dict[str, Any]:
    """Slice `k` of `maps` as JSON for the page: means (None where infeasible), the values of the other parameters, and
    each answer with its distance from the slice. `pair`: indices of the parameters across and up; without an up, an
    answer's height is its level. `marks` (n, d) and `levels` (n,), on [0, 1]: the answers; `felt` (d,): the present
    rendering, or None. Points are in the unit cube."""
    best, names, parameters = maps.best, study.space.names, study.space.parameters
    others = [i for i in study.space.free if i not in pair]
    held = [_held(parameters[i], float(best[i])) for i in others]
    held += [f"the {names[i]} that completes the sum" for i in study.space.dependent]
    across, up = pair

    def dot(x: Float[np.ndarray, " d"], height: float) -> dict[str, float]:
        """Place of a point on the slice; `height`: without an up."""
        y = height if up is None else _place(parameters[up], float(x[up]))
        return {"x": _place(parameters[across], float(x[across])), "y": y}

    trials = []
    for x, level in zip(marks, levels, strict=True):
        away = float(np.linalg.norm(differences(study.gp.kernel.levels, x, best)[others]) / 0.35)
        trials.append(dot(x, float(level)) | {"level": float(level), "now": False, "away": away})
    if felt is not None:
        trials.append(dot(felt, 0.5) | {"level": 0.0, "now": True, "away": 0.0})
    shown = [
        [round(float(v), 4) if ok else None for v, ok in zip(row, oks, strict=True)]
        for row, oks in zip(maps.mean[k], maps.feasible[k], strict=True)
    ]
    goal = study.goal.category / (len(study.responses) - 1)
    return {
        "across": names[across],
        "up": _ANSWER if up is None else names[up],
        "held": ", ".join(held),
        "best": list(dot(np.asarray(best), goal).values()),
        "mean": shown,
        "trials": trials,
    }


def _held(parameter: Parameter, unit: float) -> str:
    """Name and value, "name = value", of a parameter that is constant in a slice; `unit`: its value in the unit
    cube."""
    value = float(parameter.to_physical(np.asarray(unit)))
    return f"{parameter.name} = {parameter.words(value) if parameter.levels else f'{value:.3g}'}"


def _axis(parameter: Parameter) -> Float[np.ndarray, " side"]:
    """Grid points of a parameter's axis in the unit cube, (side,); each level of a categorical parameter fills a band
    of equal width."""
    count = len(parameter.levels)
    if not count:
        return np.linspace(0.0, 1.0, _SIDE)
    return np.asarray(parameter.to_unit(np.floor((np.arange(_SIDE) + 0.5) * count / _SIDE)))


def _place(parameter: Parameter, unit: float) -> float:
    """Place on an axis of the page, on [0, 1], of a value `unit` of the unit cube: equal steps from level to level."""
    if not parameter.levels:
        return unit
    return float(parameter.to_physical(np.asarray(unit))) / (len(parameter.levels) - 1)


@program
def _slices(study: Study, posterior: Posterior, physical: Float[Array | np.ndarray, " d"]) -> _Slices:
    """Posterior mean and feasibility on the grids of all slices through a point (d,) in physical units."""
    best = study.space.to_unit(physical)
    axes = [jnp.asarray(_axis(p), best.dtype) for p in study.space.parameters]
    grids = []
    for i, j in _pairs(study.space.free):
        up, across = jnp.meshgrid(axes[i if j is None else j], axes[i], indexing="ij")
        grid = jnp.broadcast_to(best, (_SIDE * _SIDE, best.shape[0])).at[:, i].set(across.ravel())
        grids.append(grid if j is None else grid.at[:, j].set(up.ravel()))
    points = study.space.completed(jnp.concatenate(grids))
    shape = (len(grids), _SIDE, _SIDE)
    return _Slices(best, posterior.mean(points).reshape(shape), study.space.feasible(points).reshape(shape))
