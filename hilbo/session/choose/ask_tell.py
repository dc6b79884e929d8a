"""One participant's session: ask for a rendering, tell the answer; every state is a new immutable record.

    session = Session.start(study, seed=0)
    point   = session.ask()              # parameter -> value in physical units
    session = session.tell("close")

The first trials are a Latin hypercube inside the feasible set, the following maximise the acquisition function over a
low-discrepancy candidate set and are polished (paper, algorithm 1). The next point depends only on the study, the
answers so far and the seed: fits start cold, from the physical values as in a table, so that a replay (of a
log, of a table, on another day) gives the same points bit for bit.
"""

import threading
import weakref
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, SupportsFloat

import jax.numpy as jnp
import numpy as np
import pandas as pd

from hilbo.errors import InputError, warn_caller
from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import Posterior, Trials, fit
from hilbo.search.box import Parameter
from hilbo.session.choose.selection import Design, design
from hilbo.session.choose.step import Step, padding
from hilbo.study.config import Study
from hilbo.study.tables.equalities import broken_equality

__all__ = ["Session", "physical_trials"]

_LARGEST_SEED = 2**63 - 1  # of JAX's keys
_HAD_RESPONSES: "weakref.WeakSet[Session]" = weakref.WeakSet()


def physical_trials(study: Study, points: np.ndarray, answers: np.ndarray, capacity: int) -> Trials:
    """Trials of `capacity` rows from n points (n, d) in physical units and their categories (n,); further rows are
    masked.

    Tables and logs are always converted by this function before a fit. The further rows are in the middle of the box
    before the change of coordinates, so that it compiles once.
    """
    padded, categories = padding(study, capacity), np.zeros(capacity, np.int32)
    padded[: len(points)], categories[: len(answers)] = points, answers
    return Trials(_to_unit(study.space, padded), jnp.asarray(categories), jnp.arange(capacity) < len(points))


@program
def _to_unit(space, physical):
    """Points from physical units to the unit cube."""
    return space.to_unit(physical)


@dataclass(frozen=True, eq=False)
class Session:
    """A participant's responses so far and the next stimulus; made by `start`, `tell` and `replay`.

    `points` (n, d) are in physical units, `answers` (n,) categories from 0; `proposal` (d,) is the next point, None
    when all the study's trials have a response.
    """

    study: Study
    plan: Design
    points: np.ndarray
    answers: np.ndarray
    proposal: np.ndarray | None
    seed: int
    step: Step = field(repr=False)

    def __repr__(self) -> str:
        """One line: study, numbers of responses and trials, and the proposal in physical units, if there is one."""
        of, asked = self.study.file.selection.trials, ""
        if self.proposal is not None:
            values = zip(self.study.space.parameters, self.proposal.tolist(), strict=True)
            asked = ", asks " + ", ".join(f"{p.name} {p.words(value)} {p.unit}".rstrip() for p, value in values)
        return f'Session("{self.study.file.name}": {len(self.answers)} of {of} answers{asked})'

    def __reduce__(self) -> tuple[object, ...]:
        """Pickles and copies contain the data of a session; its compiled step is made again."""
        return _restored, (self.study, self.plan, self.points, self.answers, self.proposal, self.seed)

    @classmethod
    def start(cls, study: Study, seed: int = 0) -> "Session":
        """A session without responses. The seed decides the space-filling trials and the candidates.

        Raises `InputError` for a `study` that has not been loaded, and a `seed` that is no whole number from 0.
        """
        if not isinstance(study, Study):
            raise InputError(f"Session: study is a {type(study).__name__}; load it first, by Study.load(path).")
        if not isinstance(seed, int | np.integer) or isinstance(seed, bool) or seed < 0:
            raise InputError(f"Session: seed is {seed!r}; it must be a whole number from 0.")
        if seed > _LARGEST_SEED:
            raise InputError(f"Session: seed is {seed}; it must be at most {_LARGEST_SEED}, which is 2^63 - 1.")
        plan = design(study, seed)
        step = Step(study, plan)
        points, answers = _read_only(np.zeros((0, study.space.dim)), np.zeros(0, int))
        return cls(study, plan, points, answers, step(points, answers), seed, step)

    @classmethod
    def replay(cls, study: Study, responses: Iterable[str], seed: int = 0) -> "Session":
        """Session after these responses to its proposals, in this order. Raises `InputError` for a study, seed or
        response that is not valid, and for too many responses."""
        session = cls.start(study, seed)
        for response in responses:
            session = session.tell(response)
        return session

    @property
    def trials(self) -> Trials:
        """The answers as the model's data, masked and with the capacity of the whole session."""
        return physical_trials(self.study, self.points, self.answers, self.study.file.selection.trials)

    @property
    def done(self) -> bool:
        """Whether all the study's trials are answered."""
        return self.proposal is None

    def warm(self) -> threading.Thread:
        """Compile the step that chooses points in a new thread, which is returned: while the first points are
        answered."""
        thread = threading.Thread(target=self.step.warm, daemon=True)
        thread.start()
        return thread

    def ask(self) -> dict[str, Any]:
        """The rendering to present next: parameter -> value in physical units, levels by name; the same until `tell`.

        A state that has had its response asks for the same stimulus again, with a warning: `tell` returns the next
        state. Raises `InputError` once all trials of the study are answered.
        """
        if self in _HAD_RESPONSES:
            warn_caller(
                "Session: this state has had its response; keep the next one: session = session.tell(response)."
            )
        return self._named(_asked(self))

    def tell(self, response: str, at: Mapping[str, Any] | pd.Series | None = None) -> "Session":
        """The next state, after the participant's response (one of the study's) to the asked rendering; `self` is
        unchanged.

        `at`: the rendering that was really presented, if it differs: each parameter's value by its name, as `ask` has
        one, or a row of a DataFrame. Raises `InputError` for an unknown `response`, a rendering with other parameters,
        values out of range or a violated equality of the study, and once all trials are answered.
        """
        step = self.step
        if response not in step.responses:
            raise InputError(
                f'Session: "{response}" is no answer of this study; give one of {", ".join(step.responses)}.'
            )
        asked = _asked(self)
        shown = asked if at is None else self._point(at)
        points = np.concatenate([self.points, shown[None, :]])
        points, answers = _read_only(points, np.append(self.answers, step.responses.index(response)))
        _HAD_RESPONSES.add(self)
        return replace(self, points=points, answers=answers, proposal=step(points, answers))

    def _named(self, point: np.ndarray) -> dict[str, Any]:
        """Physical numbers (d,) by the parameters' names; levels by their own names."""
        values = zip(self.study.space.parameters, point.tolist(), strict=True)
        return {p.name: p.shown(value) if p.levels else value for p, value in values}

    def _point(self, at: Mapping[str, Any] | pd.Series) -> np.ndarray:
        """Convert a rendering that was presented to numbers (d,). Raises `InputError` for other parameters, values out
        of range, or an equality of the study that is violated."""
        names = ", ".join(self.step.names)
        if not isinstance(at, Mapping | pd.Series):
            raise InputError(f"Session: at is a {type(at).__name__}; give a dict with a value for each of {names}.")
        given = list(at.keys())
        if len(given) != len(self.step.names) or set(given) != set(self.step.names):
            raise InputError(f"Session: at has {', '.join(map(str, given))}; give {names}.")
        for p in self.study.space.parameters:
            value = at[p.name]
            if not p.levels and (not isinstance(value, SupportsFloat) or getattr(value, "ndim", 0)):
                raise InputError(f"Session: {p.name} is {value!r}; give a number.")
            if not p.holds(_in_its_digits(p, value)):
                raise InputError(f"Session: {p.name} is {value}; it must be {p.range_words}.")
        point = {p.name: _in_its_digits(p, at[p.name]) for p in self.study.space.parameters}
        broken = broken_equality(point, self.study.file)
        if broken is not None:
            raise InputError(f"Session: {broken}")
        return np.array(list(point.values()))

    def posterior(self) -> Posterior:
        """Fit the answers so far, and return the participant's posterior."""
        return fit(self.study.gp, self.trials, inference=self.study.inference)

    def best(self) -> dict[str, Any]:
        """The optimum of the posterior, for the highest response its largest mean, in the form of `ask`; computed with
        a fit. Raises `InputError` before the first answer, when the prior mean is the same everywhere."""
        if not len(self.answers):
            raise InputError("Session: there are no responses yet, hence no best stimulus; add one with tell() first.")
        return self._named(self.step.best(self.posterior()))


def _in_its_digits(parameter: Parameter, value: Any) -> float:
    """A given value as a physical number: the index of a level (NaN if it is unknown), else its float. A float32 is
    read by its shortest decimal: 0.99 is 0.99, not 0.9900000095, which is beyond the end of the range."""
    if parameter.levels:
        return parameter.number(str(value))
    dtype = getattr(value, "dtype", np.dtype(float))
    return float(str(value)) if dtype.kind == "f" and dtype.itemsize < 8 else float(value)


def _restored(
    study: Study, plan: Design, points: np.ndarray, answers: np.ndarray, proposal: np.ndarray | None, seed: int
) -> Session:
    """Session with these data, for copies and pickles; its arrays are made read-only, and its step is created again."""
    _read_only(points, answers, *([] if proposal is None else [proposal]))
    return Session(study, plan, points, answers, proposal, seed, Step(study, plan))


def _read_only(*arrays: np.ndarray) -> tuple[np.ndarray, ...]:
    """Make the arrays read-only in place, since states are immutable, and return them."""
    for array in arrays:
        array.flags.writeable = False
    return arrays


def _asked(session: Session) -> np.ndarray:
    """The proposal (d,) of a session. Raises `InputError` once all trials are answered."""
    if session.proposal is None:
        raise InputError(
            f"Session: all {len(session.answers)} trials of the study are answered; nothing is left to ask."
        )
    return session.proposal
