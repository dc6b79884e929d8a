"""Look-ahead of a live session: the next rendering is computed before it is needed, so that no fit runs after an
answer.

`LiveChooser.lookahead(state)` computes the next rendering for each possible answer; `choose` then only looks it up.
Each answer's posterior is fitted once, by the step that chooses (`hilbo.session.choose.step`), and cached: it explains
the choice and is shown on the experimenter page. Renderings of an optimisation are those of
`hilbo.session.choose.ask_tell.Session`, bit for bit: they depend on the study, the seed (of the material:
`header.material_seed`) and the answers that count. Space-filling points without an answer come first. With a warm start
(`hilbo.session.choose.warm_start`, one per material) there are none: all points come from its map.
"""

import threading
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from hilbo.errors import InputError
from hilbo.search.rendering import Rendering
from hilbo.session.choose.ask_tell import Session
from hilbo.session.choose.choice import Answers, explained, next_point
from hilbo.session.choose.step import Fitted
from hilbo.session.choose.warm_start import WarmStart
from hilbo.session.log.header import material_seed
from hilbo.session.log.records import Need
from hilbo.session.log.state import LiveSession
from hilbo.study.config import Study
from hilbo.study.file.plan_file import Planned

__all__ = ["LiveChooser", "warm_start_sources"]

_KEPT = 64  # posteriors, the newest: of the present state, of its possible successors, and of the states before undo


class LiveChooser:
    """Chooser of the renderings of one session, with a cache of choices and posteriors. Thread-safe.

    `fits` counts the fits that were computed, `looked_up` the choices that were in the cache when needed.
    Raises `InputError` for maps of a warm start that do not fit the session's header.
    """

    def __init__(self, state: LiveSession, warm: Mapping[str | None, WarmStart] | None = None) -> None:
        self.fits, self.looked_up = 0, 0
        self._warm_starts = _checked_warm(state, warm or {})
        self._lock = threading.RLock()
        self._choices: dict[Answers, dict[str, Any]] = {}
        self._fitted: dict[tuple, Fitted] = {}
        header, study = state.header, Study.of(state.study)
        self._blocks = header.blocks
        self._studies = {b.material: study if b.material is None else study.material(b.material) for b in header.blocks}
        self._sessions = {
            block.material: Session.start(self._studies[block.material], material_seed(header, block.material))
            for block in header.blocks
            if not block.trials
        }
        self._planned = {
            (block.material, id): Rendering.of(self._studies[block.material].space, header.sets[id])
            for block in header.blocks
            for trial in block.trials
            for id in (trial.a, trial.b)
            if id is not None
        }

    def warm(self) -> None:
        """Compile all programs that proposals need, by choosing the first rendering of each block."""
        for rendering in self._planned.values():
            _ = rendering.margin
        for number in self.chosen_blocks:
            self._choice(Answers(number))

    @property
    def chosen_blocks(self) -> list[int]:
        """Indices of the blocks whose renderings are chosen, not planned."""
        return [number for number, block in enumerate(self._blocks) if not block.trials]

    def choose(self, state: LiveSession, need: Need) -> dict[str, Any]:
        """Data of the next proposal: `renderings`, and `sets`, `first` or `choice` (the explanation).

        A repetition has the data of the trial that it repeats, a planned trial its sets; else the choice is looked up,
        or computed with a fit.
        """
        block = state.header.blocks[need.block]
        if need.repeats is not None:
            data = state.trial(need.repeats).data
            return {key: data[key] for key in ("renderings", "sets", "first", "choice") if key in data}
        if need.planned is not None:
            return self._of_plan(block.material, block.trials[need.planned])
        with self._lock:
            answers = Answers.of(state, need.block)
            self.looked_up += answers in self._choices
            return self._choice(answers)

    def lookahead(self, state: LiveSession, wanted: Callable[[], bool] = lambda: True) -> dict[str, dict[str, Any]]:
        """Response -> proposal that would follow it, for the pending optimisation trial, most probable response first.

        Computed choices are cached. Empty if no fit is needed: for repetitions, planned trials and the last trial of a
        block. Stops early once `wanted` returns False.
        """
        trial = state.pending
        if trial is None or trial.repeats is not None or state.header.blocks[trial.block].trials:
            return {}
        if len(state.answers(trial.block)) + 1 >= state.quota(trial.block):
            return {}
        following = dict(zip(state.study.responses, Answers.after_pending(state), strict=True))
        likely = trial.data.get("choice", {}).get("probabilities", {})
        ahead: dict[str, dict[str, Any]] = {}
        for response in sorted(following, key=lambda response: -likely.get(response, 0.0)):
            if not wanted():
                break
            ahead[response] = self._choice(following[response])
        return ahead

    # What the experimenter's page reads.

    def study(self, block: int) -> Study:
        """The study of a block's material."""
        return self._studies[self._blocks[block].material]

    def fitted(self, answers: Answers) -> Fitted:
        """The posterior after some answers, and the point that it leads to; fitted on the first call, then cached."""
        key = answers.block, answers.points, answers.categories
        with self._lock:
            if key not in self._fitted:
                self.fits += 1
                step = self._session(answers.block).step
                points = np.array(answers.points, float).reshape(-1, len(step.names))
                self._fitted[key] = step.fitted(points, answers.categories)
                while len(self._fitted) > _KEPT:
                    self._fitted.pop(next(iter(self._fitted)))
            return self._fitted[key]

    def best(self, block: int, fitted: Fitted) -> Float[np.ndarray, " d"]:
        """Optimum (d,) of the posterior, in physical units; nothing is fitted."""
        return self._session(block).step.best(fitted.posterior)

    def _session(self, block: int) -> Session:
        """The `Session` (study, seed, design, step) of a block's material."""
        return self._sessions[self._blocks[block].material]

    def _of_plan(self, material: str | None, planned: Planned) -> dict[str, Any]:
        """Data of the proposal of a planned trial: `renderings`, `sets`, `first`, and `choice` with the passivity
        margins."""
        sides = {"a": planned.a} if planned.b is None else {"a": planned.a, "b": planned.b}
        renderings = {side: self._planned[material, id] for side, id in sides.items()}
        return {
            "renderings": {side: rendering.parameters for side, rendering in renderings.items()},
            "sets": sides,
            "first": planned.first,
            "choice": {"by": "plan", "margin": {side: rendering.margin for side, rendering in renderings.items()}},
        }

    def _choice(self, answers: Answers) -> dict[str, Any]:
        """Data of the proposal after these answers, from the cache or computed with a fit."""
        with self._lock:
            if answers not in self._choices:
                session, fitted = self._session(answers.block), self.fitted(answers)
                warm = self._warm_starts.get(self._blocks[answers.block].material)
                point, by = next_point(session, warm, answers, fitted)
                self._choices[answers] = explained(session.study, fitted.posterior, point, by)
            return self._choices[answers]


def warm_start_sources(warm: Mapping[str | None, WarmStart]) -> str | None:
    """Text for the header that identifies a session's warm starts, "MATERIAL=SOURCE,…"; None if there are none."""
    return ",".join(f"{name or ''}={warm[name].source}" for name in sorted(warm, key=str)) or None


def _from(sources: str | None) -> str:
    """Clause for messages: the warm starts that a header's text identifies, such as "without --warm-start"."""
    if sources is None:
        return "without --warm-start"
    maps = [source.rpartition("=")[::2] for source in sources.split(",")]
    words = [f"the map whose SHA-256 begins with {digest}{f' for {name}' if name else ''}" for name, digest in maps]
    return f"from {' and '.join(words)}"


def _checked_warm(state: LiveSession, warm: Mapping[str | None, WarmStart]) -> dict[str | None, WarmStart]:
    """Return the warm starts. Raises InputError if they are not those of the header: after a resume the next trial must
    be the same."""
    sources = warm_start_sources(warm)
    if sources != state.header.warm_start:
        begun = state.header.warm_start
        what = "leave --warm-start out" if begun is None else "give that map with --warm-start"
        raise InputError(f"the session was begun {_from(begun)}, not {_from(sources)}; {what}.")
    return dict(warm)
