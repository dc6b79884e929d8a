"""Selection of the next point: pure, traceable functions of study, seed and answers.

The first trials are a Latin hypercube inside the feasible set, the following maximise the acquisition function over a
low-discrepancy candidate set or a lattice and are polished (paper, algorithm 1).
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import msgspec
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from hilbo import acquisition
from hilbo.kernels import gram
from hilbo.likelihoods import Goal
from hilbo.numerics.climbing import Choice, climb, spread
from hilbo.ordinal_gp import OrdinalGP, Posterior, Trials, fit
from hilbo.search.apart import differences
from hilbo.search.candidates import CANDIDATES, search_points
from hilbo.search.lattice import Lattice, OptimisticScore, nodes_for, screen, screen_points
from hilbo.search.space import SearchSpace
from hilbo.search.space_lattice import lattice_of
from hilbo.study.config import Inference, Study
from hilbo.study.file.schema import Selection

__all__ = ["Choosing", "Design", "design", "next_point", "point_after", "point_away_from"]

_STARTS = 4  # of the polishing, on the lattice
_GAIN = 1e-7  # of the prior's sd, of a score in units of f: less is no reason to polish on
_JOINT_CANDIDATES = 512  # of which a Thompson draw is a joint one, cubic in their number


class Choosing(eqx.Module):
    """The part of a study that its choices depend on: studies that differ in the rest share points and programs.

    The weight of the standard deviation is no part of it, but an argument of `point_after`.
    """

    gp: OrdinalGP
    space: SearchSpace
    inference: Inference = eqx.field(static=True)
    selection: Selection = eqx.field(static=True)
    goal: Goal = eqx.field(static=True)

    @classmethod
    def of(cls, study: Study) -> "Choosing":
        """Part of a study that choices depend on; numbers that are no part of a program are set to 0."""
        selection = msgspec.structs.replace(study.file.selection, space_filling=0, weight=0.0)
        return cls(study.gp, study.space, study.inference, selection, study.goal)


class Design(eqx.Module):
    """Seeded part of a session: the first points (s, d), and the points among which the acquisition is maximised.

    The latter are a lattice in two or three dimensions, whose nodes are products and cost a hundredth of other points;
    else, for constraints, whole numbers and levels, and for Thompson's draws, `candidates`. Unit cube.
    """

    initial: Float[Array, "s d"]
    candidates: Float[Array, "m d"] | None
    lattice: Lattice | None
    key: PRNGKeyArray


def design(study: Study, seed: int, count: int = CANDIDATES) -> Design:
    """Create the seeded part of a session: space-filling points (s, d), and the points to search, in the unit cube.
    `count`: number of candidates, if no lattice is used. Raises `InputError` if too few points are feasible."""
    space, nodes = study.space, nodes_for(float(np.asarray(study.gp.kernel.theta).max()))
    on_lattice = space.even and space.dim in (2, 3) and study.file.selection.acquisition != "thompson"
    return Design(
        jax.device_put(space.latin_hypercube(study.file.selection.space_filling, seed)),
        None if on_lattice else search_points(space, seed, count),
        lattice_of(space, nodes) if on_lattice else None,
        jax.random.key(seed),
    )


def next_point(
    study: Study, plan: Design, trials: Trials, trial: Int[Array, ""] | int, weight: ArrayLike | None = None
) -> Float[Array, " d"]:
    """Fit the given answers, and return the next point (d,) of the unit cube by the study's acquisition; traceable.

    `trial`: index of the trial, which seeds Thompson's draw. `weight`: of the standard deviation in UCB, None for the
    study's. Never a space-filling point.
    """
    posterior = fit(study.gp, trials, inference=study.inference, throw=False)
    weight = study.file.selection.weight if weight is None else weight
    return point_after(Choosing.of(study), plan, posterior, trial, weight)


def point_after(
    choosing: Choosing, plan: Design, posterior: Posterior, trial: Int[Array, ""] | int, weight: ArrayLike
) -> Float[Array, " d"]:
    """The next point (d,) of the unit cube, by the acquisition, from the posterior of the answers; traceable.

    `trial`: index of the trial, which seeds Thompson's draw; `weight`: of the standard deviation in UCB. Never a
    space-filling point.
    """
    thompson, distance = choosing.selection.acquisition == "thompson", choosing.selection.minimum_distance
    allowed = None
    if distance:
        points, usable = _searched(plan, _JOINT_CANDIDATES if thompson else None)
        allowed = _keeps_distance(choosing.gp.kernel.levels, posterior.trials, points, usable, distance)
    if thompson:
        return _thompson_point(choosing, posterior, plan, trial, allowed)
    return _highest(choosing, plan, posterior, _score(choosing, posterior, weight), allowed).x


def point_away_from(
    study: Study, plan: Design, posterior: Posterior, excluded: Float[Array, "k d"], distance: float
) -> Float[Array, " d"]:
    """Point (d,) with the highest UCB at least `distance` from the points `excluded`, all in the unit cube;
    traceable."""

    def allowed(x):
        """Whether the point x (d,) keeps the distance."""
        return jnp.all(jnp.sum(differences(study.gp.kernel.levels, excluded, x[None, :]) ** 2, axis=1) >= distance**2)

    choosing = Choosing.of(study)
    score = _towards(choosing, acquisition.UCB(study.file.selection.weight))
    return _highest(choosing, plan, posterior, score, allowed).x


def _highest(
    choosing: Choosing, plan: Design, posterior: Posterior, score: OptimisticScore, allowed: Callable | None = None
) -> Choice:
    """Maximise a score over the feasible set: screening in float32 on the design's points, then polishing. `allowed`:
    further condition on a point (d,), or None. Returns the point and how it was found."""

    def score_at(x):
        """Score at the point x (d,)."""
        mean, variance = posterior.predict(x[None, :])
        return score(mean[0], variance[0])

    space = choosing.space.searched
    if choosing.selection.acquisition == "ucb":
        space["gain"] = _GAIN * jnp.sqrt(choosing.gp.kernel.variance)
    short = posterior.astype(jnp.float32)
    fitted = short.gp.kernel, short.trials.x, short.latent.weights, short.latent.factor
    if plan.lattice is None:
        assert plan.candidates is not None
        points = plan.candidates
        if allowed is None:
            values = screen_points(*fitted, points.astype(jnp.float32), score)
        else:  # which may rule out all points that were not skipped
            values = score(*short.predict(points.astype(jnp.float32)))
        return acquisition.maximise(values, points, score_at, **space, allowed=allowed)
    screened = screen(*fitted, plan.lattice, score, allowed)
    rows = spread(screened.hopes, screened.points, _STARTS)
    usable = screened.hopes[rows] > -jnp.inf
    return climb(screened.points[rows], usable, score_at, **space, allowed=allowed)


def _score(choosing: Choosing, posterior: Posterior, weight: ArrayLike) -> OptimisticScore:
    """The study's acquisition as a function of mean and variance; `weight`: of the standard deviation, for UCB only."""
    kind = choosing.selection.acquisition
    if kind == "ucb":
        return _towards(choosing, acquisition.UCB(weight))
    if kind == "log_ei":
        trials = posterior.trials
        near = choosing.goal.closeness(choosing.gp.likelihood, posterior.mean(trials.x))
        return _towards(choosing, acquisition.LogEI(jnp.max(jnp.where(trials.mask, near, -jnp.inf))))
    if choosing.goal.is_highest:
        return acquisition.TopCategory(choosing.gp.likelihood.thresholds[-1], choosing.gp.likelihood.noise)
    return acquisition.InCategory(choosing.gp.likelihood, choosing.goal.category)


def _towards(choosing: Choosing, score: acquisition.UCB | acquisition.LogEI) -> OptimisticScore:
    """The score by closeness to the study's goal; of the highest response that is the score itself."""
    return score if choosing.goal.is_highest else acquisition.TowardsGoal(score, choosing.goal, choosing.gp.likelihood)


def _searched(plan: Design, count: int | None) -> tuple[Float[Array, "m d"], Bool[Array, " m"]]:
    """The points (m, d) that are searched, of candidates only the first `count` (None: all), and which of them are
    feasible."""
    if plan.lattice is not None:
        return plan.lattice.everywhere()
    assert plan.candidates is not None
    points = plan.candidates[:count]
    return points, jnp.ones(len(points), bool)


def _keeps_distance(
    levels: tuple[int, ...],
    trials: Trials,
    points: Float[Array, "m d"],
    usable: Bool[Array, " m"],
    distance: float,
) -> Callable[[Float[Array, " d"]], Bool[Array, ""]]:
    """Return a function that tests whether a point keeps the distance to every earlier trial. If no usable point does,
    it accepts the points that are as far from all trials as the farthest of them."""

    def gap(x: Float[Array, " d"]) -> Float[Array, ""]:
        """Squared distance to the nearest trial."""
        away = differences(levels, trials.x, x[None, :])
        return jnp.min(jnp.where(trials.mask, jnp.sum(away**2, axis=1), jnp.inf))

    farthest = jnp.max(jnp.where(usable, jax.vmap(gap)(points), 0.0))
    rounding = 1.0 - 8.0 * jnp.finfo(trials.x.dtype).eps
    smallest = jnp.minimum(distance**2, rounding * farthest)
    return lambda x: gap(x) >= smallest


def _thompson_point(
    choosing: Choosing,
    posterior: Posterior,
    plan: Design,
    trial: Int[Array, ""] | int,
    allowed: Callable[[Float[Array, " d"]], Bool[Array, ""]] | None,
) -> Float[Array, " d"]:
    """Point (d,) at which a joint posterior draw is closest to the goal, among the candidates that are allowed (None:
    all). The draw is seeded by the design's key and `trial`."""
    assert plan.candidates is not None
    points = plan.candidates[:_JOINT_CANDIDATES]
    cross = gram(posterior.gp.kernel, points, posterior.trials.x)
    covariance = gram(posterior.gp.kernel, points, points) - cross @ posterior.latent.inverse @ cross.T
    key = jax.random.fold_in(plan.key, trial)
    row, draw = acquisition.thompson(key, cross @ posterior.latent.weights, covariance)
    if allowed is not None or not choosing.goal.is_highest:
        near = choosing.goal.closeness(choosing.gp.likelihood, draw)
        row = jnp.argmax(near if allowed is None else jnp.where(jax.vmap(allowed)(points), near, -jnp.inf))
    return points[row]
