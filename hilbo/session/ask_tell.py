"""One participant's session: ask for a rendering, tell the answer; every state is a new immutable record.

    session = Session.start(study, seed=0)
    point   = session.ask()              # parameter -> value in physical units
    session = session.tell("close")

The first trials are a Latin hypercube inside the feasible set, the following maximise the acquisition function over a
low-discrepancy candidate set and are polished (paper, algorithm 1). The next point depends only on the study, the
answers so far and the seed: fits start cold, from the physical values that a table would hold, so that a replay (of a
log, of a table, on another day) gives the same points bit for bit.
"""

import functools
import threading
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import msgspec
import numpy as np

from hilbo.errors import InputError
from hilbo.numerics.compiling import compiler_options
from hilbo.ordinal_gp import Posterior, Trials, fit
from hilbo.session.selection import Design, design, next_point
from hilbo.study.config import Study

__all__ = ["Session", "physical_trials"]


def physical_trials(study: Study, points: np.ndarray, answers: np.ndarray, capacity: int) -> Trials:
    """Trials from points (n, d) in physical units: the one way from what tables and logs hold to what a fit sees.

    Rows beyond n are put in the middle of the box before the change of coordinates, so that it compiles once.
    """
    padded, categories = _padded(points, answers, _padding(study, capacity))
    return Trials(_to_unit(study.space, padded), jnp.asarray(categories), jnp.arange(capacity) < len(points))


def _padding(study, capacity):
    return np.tile([(p.low + p.high) / 2 for p in study.space.parameters], (capacity, 1))


def _padded(points, answers, padding):
    padded, categories = padding.copy(), np.zeros(len(padding), np.int32)
    padded[: len(points)], categories[: len(answers)] = points, answers
    return padded, categories


@eqx.filter_jit
def _to_unit(space, physical):
    return space.to_unit(physical)


@eqx.filter_jit
def _to_physical(space, unit):
    return space.to_physical(unit)


class _Step:
    """What is compiled once for a study and a design: from answers to the next point, in physical units.

    Everything but the answers is bound, so that a call costs no look at the study: JAX gets its arrays as one flat
    tuple, because walking through the records costs more than the fit where caches are cold.
    """

    def __init__(self, study, plan):
        self._study, self._plan = study, plan
        self.arrays, self.compiled = _program(study, plan)
        self.weight, self.capacity = np.float64(study.selection.weight), study.selection.trials
        self.initial = np.asarray(_to_physical(study.space, plan.initial))
        self.responses, self.names = study.responses, study.space.names
        self.padding = _padding(study, self.capacity)

    def __call__(self, points, answers):
        """The next point, as numbers that survive a round trip through text; None when all trials are answered."""
        count = len(answers)
        if count >= self.capacity:
            return None
        if count < len(self.initial):
            return self.initial[count]
        return self._found(self.compiled, points, answers, self.weight)

    def best(self, points, answers):
        """Where the posterior mean is largest."""
        return self._found(self._of_the_mean, points, answers, np.float64(0.0))

    @functools.cached_property
    def _of_the_mean(self):
        """The UCB of weight 0 is largest where the mean is: in most studies this is the program that chooses."""
        plain = msgspec.structs.replace(self._study.selection, acquisition="ucb", minimum_distance=None)
        return _program(replace(self._study, selection=plain), self._plan)[1]

    def warm(self):
        """Compile what chooses."""
        self._found(self.compiled, self.padding[:0], (), self.weight)

    def _found(self, program, points, answers, weight):
        padded, categories = _padded(points, answers, self.padding)
        return np.asarray(program(self.arrays, padded, categories, np.int32(len(answers)), weight))


def _program(study, plan):
    """The arrays of a study and a design, and what is compiled for all that differ in nothing else."""
    leaves, structure = jax.tree.flatten((study, plan))
    fixed = tuple(None if eqx.is_array(leaf) else leaf for leaf in leaves)
    return tuple(leaf for leaf in leaves if eqx.is_array(leaf)), _compiled(structure, fixed)


@functools.lru_cache(maxsize=32)
def _compiled(structure, fixed):
    @functools.partial(jax.jit, compiler_options=compiler_options())
    def step(arrays, points, answers, count, weight):
        given = iter(arrays)
        study, plan = jax.tree.unflatten(structure, [next(given) if leaf is None else leaf for leaf in fixed])
        trials = Trials(study.space.to_unit(points), answers, jnp.arange(len(points), dtype=count.dtype) < count)
        return study.space.to_physical(next_point(study, plan, trials, count, weight))

    return step


@dataclass(frozen=True, eq=False)
class Session:
    """A participant's answers so far and the rendering to ask next; made by `start`, `tell` and `replay`.

    `points` (n, d) are in physical units, `answers` (n,) categories from 0; `proposal` (d,) is the next point, None
    when all the study's trials are answered.
    """

    study: Study
    plan: Design
    points: np.ndarray
    answers: np.ndarray
    proposal: np.ndarray | None
    seed: int
    step: _Step = field(repr=False)

    @classmethod
    def start(cls, study: Study, seed: int = 0) -> "Session":
        """A session without answers. The seed decides the space-filling trials and the candidates."""
        plan = design(study, seed)
        step = _Step(study, plan)
        points, answers = np.zeros((0, study.space.dim)), np.zeros(0, int)
        return cls(study, plan, points, answers, step(points, answers), seed, step)

    @classmethod
    def replay(cls, study: Study, responses: Iterable[str], seed: int = 0) -> "Session":
        """The session in which these answers were given, in this order."""
        session = cls.start(study, seed)
        for response in responses:
            session = session.tell(response)
        return session

    @property
    def trials(self) -> Trials:
        """The answers as the model's data, with the capacity of the whole session."""
        return physical_trials(self.study, self.points, self.answers, self.study.selection.trials)

    @property
    def done(self) -> bool:
        """Whether all the study's trials are answered."""
        return self.proposal is None

    def warm(self) -> threading.Thread:
        """Compile the step that chooses points, in a thread: while the first, given points are answered."""
        thread = threading.Thread(target=self.step.warm, daemon=True)
        thread.start()
        return thread

    def ask(self) -> dict[str, float]:
        """The rendering to present next: parameter -> value in physical units."""
        return dict(zip(self.step.names, _asked(self).tolist(), strict=True))

    def tell(self, response: str, at: Mapping[str, float] | None = None) -> "Session":
        """The next state, after the participant's answer (one of the study's responses) to the asked point.

        `at`: the point that was really presented, if it was not the asked one.
        """
        step = self.step
        if response not in step.responses:
            raise InputError(f'Session: "{response}" is no answer of this study; give one of {step.responses}.')
        shown = _asked(self) if at is None else np.array([at[name] for name in step.names])
        points = np.concatenate([self.points, shown[None, :]])
        answers = np.append(self.answers, step.responses.index(response))
        return replace(self, points=points, answers=answers, proposal=step(points, answers))

    def posterior(self) -> Posterior:
        """The participant's posterior after the answers so far."""
        return fit(self.study.gp, self.trials, inference=self.study.inference)

    def best(self) -> dict[str, float]:
        """The rendering with the largest posterior mean: parameter -> value in physical units."""
        self.posterior()  # which refuses answers that cannot be fitted
        return dict(zip(self.step.names, self.step.best(self.points, self.answers).tolist(), strict=True))


def _asked(session) -> np.ndarray:
    if session.proposal is None:
        raise InputError(
            f"Session: all {len(session.answers)} trials of the study are answered; nothing is left to ask."
        )
    return session.proposal
