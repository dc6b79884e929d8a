"""What a live session shows next, found before it is asked for: no fit runs after an answer.

`LiveChooser.lookahead(state)` finds the next rendering for each answer that may come; `choose` then only looks it up.
Each answer's posterior is fitted once, by the step that chooses (`hilbo.session.choose.step`), and kept: it explains
the choice, and the experimenter's page reads it. Optimisation renderings are those of
`hilbo.session.choose.ask_tell.Session`, bit for bit: they depend on the study, the seed (of the material:
`header.material_seed`) and the answers that count. A space-filling point without an answer that counts comes before all
others. With a warm start (`hilbo.session.choose.warm_start`, one for each material) there are no space-filling trials:
points come from it.
"""

import threading
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from hilbo.errors import InputError
from hilbo.search.set_facts import described
from hilbo.session.choose import avoided as apart
from hilbo.session.choose.ask_tell import Session
from hilbo.session.choose.explanation import Choice, explained
from hilbo.session.choose.step import Fitted
from hilbo.session.choose.warm_start import WarmStart
from hilbo.session.log.header import material_seed
from hilbo.session.log.records import Need, Planned
from hilbo.session.log.state import LiveSession
from hilbo.study.config import Study

__all__ = ["Answers", "LiveChooser", "warm_start_sources"]

Places = tuple[tuple[float, ...], ...]
"""Renderings in physical units."""

_KEPT = 64  # posteriors, the newest: those of the present, of what may follow, and of what undo leads back to


class Answers(NamedTuple):
    """The answers of a block that count: their renderings in physical units, and their categories.

    `points` are the renderings as they were presented, `proposed` as they were asked for: the same, but where a program
    presents, and confirms what it could.
    """

    block: int
    points: tuple[tuple[float, ...], ...] = ()
    categories: tuple[int, ...] = ()
    proposed: Places = ()

    @classmethod
    def of(cls, state: LiveSession, block: int) -> "Answers":
        """The answers of a block so far."""
        answered = state.answers(block)
        names, responses = state.study.space.names, state.study.responses
        points = tuple(_place(trial.presented["a"], names) for trial in answered)
        given = [trial.values["class_a"] for trial in answered if trial.values is not None]
        proposed = tuple(_place(trial.renderings["a"], names) for trial in answered)
        return cls(block, points, tuple(map(responses.index, given)), proposed)

    def followed_by(self, point: tuple[float, ...], category: int, proposed: tuple[float, ...]) -> "Answers":
        """With one more: where it was presented and proposed, physical units, and its category from 0."""
        return Answers(self.block, (*self.points, point), (*self.categories, category), (*self.proposed, proposed))


class _Situation(NamedTuple):
    """What a choice depends on beside study and seed: the answers, and the renderings not to be shown again."""

    answers: Answers
    excluded: tuple[tuple[float, ...], ...]

    @classmethod
    def of(cls, state: LiveSession, block: int) -> "_Situation":
        names = state.study.space.names
        return cls(Answers.of(state, block), tuple(_place(values, names) for values in state.excluded(block)))


class LiveChooser:
    """Finds and remembers the renderings of one session. May be used from several threads.

    `fits` counts the fits that were computed, `looked_up` the choices that were there when they were asked for.
    Raises `InputError` for maps of a warm start that do not fit the session's header.
    """

    def __init__(self, state: LiveSession, warm: Mapping[str | None, WarmStart] | None = None) -> None:
        self.fits, self.looked_up = 0, 0
        self._warm_starts = _checked_warm(state, warm or {})
        self._lock = threading.RLock()
        self._choices: dict[_Situation, dict[str, Any]] = {}
        self._fitted: dict[Answers, Fitted] = {}
        header, study = state.header, state.study
        assert isinstance(study, Study)  # whoever chooses needs the model too
        self._blocks = header.blocks
        materials = {block.material for block in header.blocks}
        self._studies = {name: study if name is None else study.material(name) for name in materials}
        self._sessions = {
            block.material: Session.start(self._studies[block.material], material_seed(header, block.material))
            for block in header.blocks
            if not block.trials
        }
        self._sets = {
            (name, id): described(self._studies[name].space, values)
            for name in materials
            for id, values in header.sets.items()
            if any(id in (p.a, p.b) for b in header.blocks if b.material == name for p in b.trials)
        }

    def warm(self) -> None:
        """Compile what optimisation trials need, by choosing their first."""
        for number in self.chosen_blocks:
            self._choice(_Situation(Answers(number), ()))

    @property
    def chosen_blocks(self) -> list[int]:
        """The blocks whose renderings are not planned."""
        return [number for number, block in enumerate(self._blocks) if not block.trials]

    def choose(self, state: LiveSession, need: Need) -> dict[str, Any]:
        """The data of a proposal: `renderings`, and `sets`, `first` or `choice`."""
        block = state.header.blocks[need.block]
        if need.repeats is not None:
            data = state.trial(need.repeats).data
            return {key: data[key] for key in ("renderings", "sets", "first", "choice") if key in data}
        if need.planned is not None:
            return self._planned(block.material, block.trials[need.planned])
        with self._lock:
            situation = _Situation.of(state, need.block)
            self.looked_up += situation in self._choices
            return self._choice(situation)

    def lookahead(self, state: LiveSession, wanted: Callable[[], bool] = lambda: True) -> dict[str, dict[str, Any]]:
        """For each answer to the pending optimisation trial, the likely ones first: what would be proposed after it.
        Empty where that is known without a fit; ends when it is not `wanted` any more."""
        trial = state.pending
        if trial is None or trial.repeats is not None or state.header.blocks[trial.block].trials:
            return {}
        if len(state.answers(trial.block)) + 1 >= state.quota(trial.block):
            return {}
        excluded = _Situation.of(state, trial.block).excluded
        following = dict(zip(state.study.responses, _following(state), strict=True))
        likely = trial.data.get("choice", {}).get("probabilities", {})
        ahead: dict[str, dict[str, Any]] = {}
        for response in sorted(following, key=lambda response: -likely.get(response, 0.0)):
            if not wanted():
                break
            ahead[response] = self._choice(_Situation(following[response], excluded))
        return ahead

    # What the experimenter's page reads.

    def study(self, block: int) -> Study:
        """The study of a block's material."""
        return self._studies[self._blocks[block].material]

    def fitted(self, answers: Answers) -> Fitted:
        """The posterior after some answers, and what it chooses: each fitted once while it is kept."""
        with self._lock:
            if answers not in self._fitted:
                self.fits += 1
                points = _rows(answers.points, self.study(answers.block))
                self._fitted[answers] = self._session(answers.block).step.fitted(points, answers.categories)
                while len(self._fitted) > _KEPT:
                    self._fitted.pop(next(iter(self._fitted)))
            return self._fitted[answers]

    def fitted_after_each_answer(self, state: LiveSession) -> list[Fitted]:
        """The same after each answer that the pending optimisation trial may get."""
        return [self.fitted(answers) for answers in _following(state)]

    def best(self, block: int, fitted: Fitted) -> Float[np.ndarray, " d"]:
        """Where the posterior mean is largest, in physical units; nothing is fitted. (d,)."""
        return self._session(block).step.best(fitted.posterior)

    def _session(self, block: int) -> Session:
        return self._sessions[self._blocks[block].material]

    def _planned(self, material: str | None, planned: Planned) -> dict[str, Any]:
        sides = {"a": planned.a} if planned.b is None else {"a": planned.a, "b": planned.b}
        sets = {side: self._sets[material, id] for side, id in sides.items()}
        return {
            "renderings": {side: dict(one.parameters) for side, one in sets.items()},
            "sets": sides,
            "first": planned.first,
            "choice": {"by": "plan", "margin": {side: one.margin for side, one in sets.items()}},
        }

    def _choice(self, situation: _Situation) -> dict[str, Any]:
        with self._lock:
            if situation not in self._choices:
                study, fitted = self.study(situation.answers.block), self.fitted(situation.answers)
                self._choices[situation] = explained(study, fitted.posterior, self._chosen(situation, fitted))
            return self._choices[situation]

    def _chosen(self, situation: _Situation, fitted: Fitted) -> Choice:
        answers = situation.answers
        study, session = self.study(answers.block), self._session(answers.block)
        warm = self._warm_starts.get(self._blocks[answers.block].material)
        excluded = _rows(situation.excluded, study)
        left = apart.when_nothing_is_apart(study, excluded)
        if left is not None:
            return Choice(left, "stopped least often")
        if warm is not None:
            return Choice(apart.point_from_map(study, warm, fitted.posterior, excluded), "map")
        initial = session.step.initial
        missing = _missing(initial, answers.proposed, situation.excluded)
        if missing:  # in their order; one whose answer was voided comes again
            return Choice(missing[0], "latin hypercube")
        if len(answers.points) < len(initial):
            others = np.concatenate([initial, _rows(answers.points, study)])
            return Choice(apart.spread_point(study, excluded, others, session.seed), "latin hypercube")
        if apart.is_near(study, fitted.point, excluded):
            return Choice(apart.point_kept_apart(study, session.plan, fitted.posterior, excluded), "ucb, apart")
        return Choice(fitted.point, study.selection.acquisition)


def _missing(initial: Float[np.ndarray, "k d"], proposed: Places, excluded: Places) -> list[Float[np.ndarray, " d"]]:
    """Points of the initial design that no answer stands for yet; of levels and whole numbers it may hold one twice."""
    answered, missing = Counter(proposed), []
    for point in initial:
        place = tuple(point.tolist())
        if place in excluded:
            continue
        if answered[place]:
            answered[place] -= 1
        else:
            missing.append(point)
    return missing


def warm_start_sources(warm: Mapping[str | None, WarmStart]) -> str | None:
    """What a header says of a session's warm starts, one for each material; None where there are none."""
    return ",".join(f"{name or ''}={warm[name].source}" for name in sorted(warm, key=str)) or None


def _from(sources: str | None) -> str:
    """In words what a header says of warm starts."""
    if sources is None:
        return "without --warm-start"
    maps = [source.rpartition("=")[::2] for source in sources.split(",")]
    words = [f"the map whose SHA-256 begins with {digest}{f' for {name}' if name else ''}" for name, digest in maps]
    return f"from {' and '.join(words)}"


def _place(values: Mapping[str, float], names: tuple[str, ...]) -> tuple[float, ...]:
    return tuple(values[name] for name in names)


def _rows(points: tuple[tuple[float, ...], ...], study: Study) -> Float[np.ndarray, "k d"]:
    return np.array(points, float).reshape(-1, study.space.dim)


def _following(state: LiveSession) -> list[Answers]:
    """The answers after each one that the pending trial may get."""
    trial = state.pending
    assert trial is not None
    answers, names = Answers.of(state, trial.block), state.study.space.names
    point, proposed = _place(trial.presented["a"], names), _place(trial.renderings["a"], names)
    return [answers.followed_by(point, category, proposed) for category in range(len(state.study.responses))]


def _checked_warm(state: LiveSession, warm: Mapping[str | None, WarmStart]) -> dict[str | None, WarmStart]:
    """The warm starts, which must be those of the header: the next trial is to be the same after a resume."""
    sources = warm_start_sources(warm)
    if sources != state.header.warm_start:
        begun = state.header.warm_start
        what = "leave --warm-start out" if begun is None else "give that map with --warm-start"
        raise InputError(f"the session was begun {_from(begun)}, not {_from(sources)}; {what}.")
    return dict(warm)
