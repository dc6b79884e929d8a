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
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int, PRNGKeyArray

from hilbo import acquisition
from hilbo.compiling import compiler_options
from hilbo.config import Study
from hilbo.errors import InputError
from hilbo.kernels import gram
from hilbo.lattice import Lattice, nodes_for, screen, screen_points
from hilbo.ordinal_gp import Posterior, Trials, fit
from hilbo.search_lattice import lattice_of
from hilbo.search_space import SearchSpace

__all__ = [
    "CANDIDATES",
    "Design",
    "Session",
    "best_point",
    "design",
    "next_point",
    "physical_trials",
    "search_points",
]

CANDIDATES = 4096
"""Points inside the feasible set among which a function is maximised before polishing; a quarter more on its walls."""
_STARTS = 4  # of the polishing, on the lattice
_GAIN, _IN_UNITS_OF_F = 1e-7, ("ucb", "mean")  # of the prior's sd: less is no reason to polish on
_JOINT_CANDIDATES = 512  # of which a Thompson draw is a joint one, cubic in their number


class Design(eqx.Module):
    """What a seed decides in advance: where the first trials are, and among which points the others are searched.

    The latter are a lattice in two or three dimensions, whose nodes are products and cost a hundredth of other points;
    else, and for Thompson's draws, `candidates`.
    """

    initial: Float[Array, "s d"]
    candidates: Float[Array, "m d"] | None
    lattice: Lattice | None
    key: PRNGKeyArray


def search_points(space: SearchSpace, seed: int, count: int = CANDIDATES) -> Float[Array, "m d"]:
    """Points of the unit cube among which to look for a maximum: `count` inside the feasible set, a quarter of that
    on its walls, edges and corners."""
    return jnp.concatenate([jnp.asarray(space.candidates(count, seed)), jnp.asarray(space.walls(count // 4, seed))])


def design(study: Study, seed: int, count: int = CANDIDATES) -> Design:
    """The seeded part of a session: space-filling points (s, d), and the points to search, in the unit cube."""
    space, nodes = study.space, nodes_for(float(jnp.max(study.gp.kernel.theta)))
    on_lattice = space.dim in (2, 3) and study.selection.acquisition != "thompson"
    return Design(
        jnp.asarray(space.latin_hypercube(study.selection.space_filling, seed)),
        None if on_lattice else search_points(space, seed, count),
        lattice_of(space, nodes) if on_lattice else None,
        jax.random.key(seed),
    )


def next_point(
    study: Study, plan: Design, trials: Trials, trial: Int[Array, ""] | int, weight: ArrayLike | None = None
) -> Float[Array, " d"]:
    """The point (d,) of the unit cube to ask after the given answers, by the study's acquisition; traceable.

    `weight`: of the standard deviation in UCB, if it is not to be the study's.
    """
    posterior = fit(study.gp, trials, inference=study.inference, throw=False)
    if study.selection.acquisition == "thompson":
        return _thompson_point(posterior, plan, trial)
    distance = study.selection.minimum_distance
    allowed = (lambda x: _far_from(trials, x, distance)) if distance else None
    return _highest(study, plan, posterior, _score(study, posterior, weight), allowed).x


def _highest(study, plan, posterior, score, allowed=None) -> acquisition.Choice:
    """Where a score is largest in the feasible set; screened in float32."""

    def score_at(x):
        mean, variance = posterior.predict(x[None, :])
        return score(mean[0], variance[0])

    space = {"from_box": study.space.from_box, "to_box": study.space.to_box, "feasible": study.space.feasible}
    if study.selection.acquisition in _IN_UNITS_OF_F:
        space["gain"] = _GAIN * jnp.sqrt(study.gp.kernel.variance)
    short = posterior.astype(jnp.float32)
    known = short.gp.kernel, short.trials.x, short.latent.weights, short.latent.factor
    if plan.lattice is None:
        points = plan.candidates
        if allowed is None:
            values = screen_points(*known, points.astype(jnp.float32), score)
        else:  # which may rule out all points that were not skipped
            values = score(*short.predict(points.astype(jnp.float32)))
        return acquisition.maximise(values, points, score_at, **space, allowed=allowed)
    found = screen(*known, plan.lattice, score, allowed)
    rows = acquisition.spread(found.hopes, found.points, _STARTS)
    usable = found.hopes[rows] > -jnp.inf
    return acquisition.climb(found.points[rows], usable, score_at, **space, allowed=allowed)


def best_point(study: Study, posterior: Posterior, candidates: Float[Array, "m d"]) -> acquisition.Choice:
    """Where the posterior mean is largest in the feasible set (paper, algorithm 1), searched from `candidates`."""
    return acquisition.maximise(
        posterior.astype(jnp.float32).mean(candidates.astype(jnp.float32)),
        candidates,
        lambda x: posterior.mean(x[None, :])[0],
        from_box=study.space.from_box,
        to_box=study.space.to_box,
        feasible=study.space.feasible,
    )


def _score(study, posterior, weight):
    kind = study.selection.acquisition
    if kind == "ucb":
        return acquisition.UCB(study.selection.weight if weight is None else weight)
    if kind == "log_ei":
        trials = posterior.trials
        return acquisition.LogEI(jnp.max(jnp.where(trials.mask, posterior.mean(trials.x), -jnp.inf)))
    if kind == "top_category":
        return acquisition.TopCategory(study.gp.likelihood.thresholds[-1], study.gp.likelihood.noise)
    return acquisition.Mean()


def _far_from(trials, x, distance):
    """Whether x keeps the smallest distance to every earlier trial."""
    apart = jnp.sum((trials.x - x[None, :]) ** 2, axis=1) >= distance**2
    return jnp.all(apart | ~trials.mask)


def _thompson_point(posterior, plan, trial):
    points = plan.candidates[:_JOINT_CANDIDATES]
    cross = gram(posterior.gp.kernel, points, posterior.trials.x)
    covariance = gram(posterior.gp.kernel, points, points) - cross @ posterior.latent.inverse @ cross.T
    key = jax.random.fold_in(plan.key, trial)
    row, _ = acquisition.thompson(key, cross @ posterior.latent.weights, covariance)
    return points[row]


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
        self.arrays, self.compiled = _program(study, plan)
        # Where the mean is largest, the UCB of weight 0 is: in most studies the same program.
        plain = msgspec.structs.replace(study.selection, acquisition="ucb", minimum_distance=None)
        self._of_the_mean = _program(replace(study, selection=plain), plan)[1]
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
