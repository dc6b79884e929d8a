"""learnt-1: the hierarchical model with hyperparameters learnt from all answers, as a recipe that does not change.

In units of the classification noise, with d parameters and C categories, people's functions and answers are those of
`low_rank.PeopleModel`, and the hyperparameters have the priors

    log theta_i ~ N(log(24 / d), 1.2^2)       log shared ~ N(log 3, 1)       log own ~ N(0, 1)
    middle of the thresholds ~ N(0, 1.5^2)    log gap ~ N(log 0.8, 0.7^2)    log width_j ~ N(0, 0.4^2), if C > 2.

What maximises the Laplace evidence of all answers times these priors is taken, by L-BFGS from the priors' medians, at
first with the same widths for all; then with people's own, which are kept if they add 3 or more to the log evidence. A
hyperparameter that the study states is kept, and with a stated noise, or variance, everything is in its unit. The
normal approximation of their posterior says how well each is known; one that is known hardly better than before the
answers is not identified.
"""

import dataclasses
from collections.abc import Mapping, Set
from typing import Final, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from hilbo.errors import InputError
from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import OrdinalGP, Posterior, Trials
from hilbo.population.low_rank import PeopleModel, shared_evidence, shared_function
from hilbo.population.shared_features import rank_for
from hilbo.population.tallies import Tallies, tallied

__all__ = [
    "NOTHING",
    "PRIORS",
    "RECIPE",
    "Learnt",
    "Prior",
    "Stated",
    "learn",
    "learnt_function",
    "prior_model",
]

RECIPE: Final = "learnt-1"
Coordinates = dict[str, Float[Array, "..."]]

_STEPS, _FINE = 100, 1e-3  # of the search; of the finite differences for the curvature
_NEAR = 2e-6  # of the evidence: another choice of features moves it as much as a nearer step would
_WORTH = 3.0  # log Bayes factor from which people have widths of their own, about 20 to 1
_LEFT, _LARGEST = 1e-4, 256
"""Of the shared function's prior variance, what the search may leave: 2e-4 of the log evidence of 600 answers; but it
takes no more features than this, since functions that need more are too rugged to be shared by few answers."""
_ROUGH = 0.05


class Prior(NamedTuple):
    """Normal, of one coordinate."""

    mean: float
    sd: float


PRIORS = {
    "theta": Prior(float(np.log(24.0)), 1.2),  # less log d
    "shared": Prior(float(np.log(3.0)), 1.0),
    "own": Prior(0.0, 1.0),
    "middle": Prior(0.0, 1.5),
    "gaps": Prior(float(np.log(0.8)), 0.7),
    "widths": Prior(0.0, 0.4),
}


class Stated(NamedTuple):
    """What a study file states of the model; None is learnt."""

    theta: tuple[float, ...] | None = None
    variance: float | None = None
    thresholds: tuple[float, ...] | None = None
    noise: float | None = None


NOTHING = Stated()


class Learnt(eqx.Module):
    """Hyperparameters of all people's answers, and how well they are known."""

    model: PeopleModel
    weights: Float[Array, "M n"]
    """Near which the posterior's mode is; one for each point that a person was asked at (`tallied`)."""
    log_evidence: Float[Array, ""]
    coordinates: Coordinates
    """Logarithms in units of the noise, and the middle of the thresholds, as in the priors."""
    sd: Coordinates
    """Standard deviations of their posterior."""
    gain_of_widths: Float[Array, ""]
    """What widths of people's own add to the log evidence; they are in the model if it is above 3."""
    steps: Int[Array, ""]
    rank: Int[Array, ""]
    left: Float[Array, ""]
    """Largest part of the shared function's prior variance, at an answered point, that is not followed."""
    converged: Bool[Array, ""]

    @property
    def widths(self) -> bool:
        """Whether people have widths of their own."""
        return "widths" in self.coordinates


def prior_model(dim: int, categories: int, stated: Stated = NOTHING) -> OrdinalGP:
    """One person's model before any answer: what is stated, and the medians of the priors."""
    nobody = Tallies(jnp.zeros((1, 1, dim)), jnp.zeros((1, 1, categories)))
    return _model(_medians(nobody, stated, PRIORS), nobody, stated).gp


def learnt_function(learnt: Learnt, trials: Trials) -> Posterior:
    """The posterior of the shared function by learnt hyperparameters, from stacked trials (M, n)."""
    answers = tallied(trials, learnt.model.thresholds.size + 1)
    return shared_function(learnt.model, answers, learnt.weights, rank_for(learnt.model.theta, answers))


def learn(
    trials: Trials,
    categories: int,
    stated: Stated = NOTHING,
    priors: Mapping[str, Prior] = PRIORS,
    near: Learnt | None = None,
) -> Learnt:
    """The hyperparameters of stacked trials (M, n) of answers in `categories`.

    **Arguments:** `stated`: what is kept; `priors`: for studies of their influence; `near`: what was learnt from nearly
    the same answers of as many people, where the search may begin. Raises InputError where nobody answered.
    """
    if not np.asarray(trials.mask).any():
        raise InputError("learnt-1: nobody gave an answer; at least one person's answers are needed.")
    answers = tallied(trials, categories)
    start = _medians(answers, stated, priors)
    common = frozenset(start) - {"widths"}
    if near is not None:
        start |= {name: near.coordinates[name] for name in common}
    problem = _Problem(answers, stated, priors, 0)
    alike = _Search(start, answers.blank, 0, True)
    alike, problem = _searched(alike, problem, common)
    chosen, free, gain = alike, common, 0.0
    if "widths" in start:
        different, wider = _searched(alike, problem, frozenset(start))
        gain = _gain_of_widths(alike, different, wider)
        if gain > _WORTH:
            chosen, free, problem = different, frozenset(start), wider
    end = _cost(chosen.coordinates, chosen.weights, problem)
    return Learnt(
        model=_model(chosen.coordinates, answers, stated),
        weights=end.weights,
        log_evidence=end.log_evidence,
        coordinates={name: value for name, value in chosen.coordinates.items() if name in free},
        sd=_standard_deviations(chosen.coordinates, end.weights, problem, free),
        gain_of_widths=jnp.asarray(gain),
        steps=jnp.asarray(chosen.steps),
        rank=jnp.asarray(problem.rank),
        left=end.left,
        converged=end.usable & jnp.asarray(chosen.ended) & (end.left <= _ROUGH),
    )


class _Problem(eqx.Module):
    """What is given of a search."""

    answers: Tallies
    stated: Stated = eqx.field(static=True)
    priors: Mapping[str, Prior]
    rank: int = eqx.field(static=True)


class _Search(NamedTuple):
    """Where a search is."""

    coordinates: Coordinates
    weights: Float[Array, "M n"]
    steps: int
    ended: bool


class _Cost(NamedTuple):
    """Minus the log posterior of the hyperparameters and its gradient; and what was seen on the way."""

    value: Float[Array, ""]
    gradient: Coordinates
    log_evidence: Float[Array, ""]
    weights: Float[Array, "M n"]
    usable: Bool[Array, ""]
    left: Float[Array, ""]


def _searched(search: _Search, problem: _Problem, free: Set[str]) -> tuple[_Search, _Problem]:
    """The maximum over the coordinates that are `free`, from where a search is; and the problem with the features that
    it takes: lengths that became shorter need more of them."""
    problem = _with_features(search, problem)
    while True:
        search = _descended(search, problem, free)
        larger = _with_features(search, problem)
        if larger.rank == problem.rank:
            return search, problem
        problem = larger


def _with_features(search: _Search, problem: _Problem) -> _Problem:
    theta = _model(search.coordinates, problem.answers, problem.stated).theta
    needed = min(rank_for(theta, problem.answers, _LEFT), _LARGEST)
    return dataclasses.replace(problem, rank=max(problem.rank, needed))


def _descended(search: _Search, problem: _Problem, free: Set[str]) -> _Search:
    """L-BFGS from where a search is; each mode is sought from the one before's."""
    from scipy.optimize import minimize  # a fifth of a second, which commands that learn nothing need not wait

    held = {name: value for name, value in search.coordinates.items() if name not in free}
    flat, restore = ravel_pytree({name: value for name, value in search.coordinates.items() if name in free})
    latest = search.weights

    def cost(z: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal latest
        here = _cost(held | restore(jnp.asarray(z, flat.dtype)), latest, problem)
        if not bool(here.usable):  # the line search is to turn back
            return np.inf, np.zeros(flat.size)
        latest = here.weights
        slope = ravel_pytree({name: here.gradient[name] for name in free})[0]
        return float(here.value), np.asarray(slope, float)

    options = {"maxiter": _STEPS, "ftol": _NEAR, "gtol": 1e-3}
    result = minimize(cost, np.asarray(flat, float), jac=True, method="L-BFGS-B", options=options)
    end = held | restore(jnp.asarray(result.x, flat.dtype))
    return _Search(end, latest, search.steps + int(result.nit), bool(result.success))


def _gain_of_widths(alike: _Search, different: _Search, problem: _Problem) -> float:
    """What widths of people's own add to the log evidence, by Laplace's method in each width alone."""
    costs = [float(_cost(s.coordinates, s.weights, problem).value) for s in (alike, different)]
    widths = different.coordinates["widths"]

    def slope(step):
        moved = different.coordinates | {"widths": widths + step}
        return np.asarray(_cost(moved, different.weights, problem).gradient["widths"])

    curvature = (slope(_FINE) - slope(-_FINE)) / (2 * _FINE)
    return costs[0] - costs[1] - float(np.sum(np.log(problem.priors["widths"].sd * np.sqrt(curvature))))


@program
def _cost(coordinates: Coordinates, start: Float[Array, "M n"], problem: _Problem) -> _Cost:
    def value(coordinates):
        model = _model(coordinates, problem.answers, problem.stated)
        evidence = shared_evidence(model, problem.answers, start, problem.rank, _LEFT)
        return -evidence.value - _log_prior(coordinates, problem), evidence

    (cost, evidence), gradient = jax.value_and_grad(value, has_aux=True)(coordinates)
    finite = jnp.all(jnp.isfinite(ravel_pytree(gradient)[0])) & jnp.isfinite(cost)
    return _Cost(cost, gradient, evidence.value, evidence.weights, evidence.arrived & finite, evidence.left)


def _medians(answers: Tallies, stated: Stated, priors: Mapping[str, Prior]) -> Coordinates:
    """Where the search begins: the medians of what is learnt."""
    (people, _, d), categories, dtype = answers.x.shape, answers.counts.shape[-1], answers.x.dtype
    every = {
        "theta": jnp.full(d, priors["theta"].mean - np.log(d), dtype),
        "shared": jnp.asarray(priors["shared"].mean, dtype),
        "own": jnp.asarray(priors["own"].mean, dtype),
        "middle": jnp.asarray(priors["middle"].mean, dtype),
        "gaps": jnp.full(categories - 2, priors["gaps"].mean, dtype),
        "widths": jnp.full(people, priors["widths"].mean, dtype),
    }
    kept = {"theta"} if stated.theta is not None else set()
    kept |= {"middle", "gaps"} if stated.thresholds is not None else set()
    kept |= {"widths"} if categories < 3 else set()
    return {name: value for name, value in every.items() if name not in kept and value.size}


def _model(coordinates: Coordinates, answers: Tallies, stated: Stated) -> PeopleModel:
    """The hyperparameters at some coordinates, in units of the stated noise, or variance, or else of a noise of 1."""
    (people, _, d), dtype = answers.x.shape, answers.x.dtype
    shared, own = jnp.exp(coordinates["shared"]), jnp.exp(coordinates["own"])
    noise = jnp.asarray(1.0 if stated.noise is None else stated.noise, dtype)
    if stated.variance is not None:
        scale = stated.variance / (shared + own)
        noise = jnp.sqrt(scale) if stated.noise is None else noise
        shared, own = scale * shared, scale * own
    else:
        shared, own = noise**2 * shared, noise**2 * own
    if stated.theta is None:
        theta = jnp.exp(coordinates["theta"])
    else:
        theta = jnp.broadcast_to(jnp.asarray(stated.theta, dtype), (d,))
    if stated.thresholds is None:
        gaps = jnp.exp(coordinates["gaps"]) if "gaps" in coordinates else jnp.zeros(0, dtype)
        edges = jnp.concatenate([jnp.zeros(1, dtype), jnp.cumsum(gaps)])
        thresholds = noise * (coordinates["middle"] + edges - jnp.mean(edges))
    else:
        thresholds = jnp.asarray(stated.thresholds, dtype)
    return PeopleModel(theta, shared, own, thresholds, noise, coordinates.get("widths", jnp.zeros(people, dtype)))


def _log_prior(coordinates: Coordinates, problem: _Problem) -> Float[Array, ""]:
    """Up to a constant."""
    d = problem.answers.x.shape[-1]
    total = jnp.zeros((), problem.answers.x.dtype)
    for name, value in coordinates.items():
        mean, sd = problem.priors[name]
        total -= 0.5 * jnp.sum(((value - mean + (jnp.log(d) if name == "theta" else 0.0)) / sd) ** 2)
    return total


def _standard_deviations(
    coordinates: Coordinates, start: Float[Array, "M n"], problem: _Problem, free: Set[str]
) -> Coordinates:
    """Of the posterior of what is `free`, taken for normal: its curvature from differences of gradients.

    People's widths are independent given the rest, up to what their answers share: their part of the curvature is
    taken for diagonal, and costs one difference for all.
    """
    common = {name: value for name, value in coordinates.items() if name in free - {"widths"}}
    flat, restore = ravel_pytree(common)

    def difference(way: Coordinates) -> Coordinates:
        ahead, behind = (
            _cost({n: v + s * way[n] if n in way else v for n, v in coordinates.items()}, start, problem).gradient
            for s in (_FINE, -_FINE)
        )
        return jax.tree.map(lambda a, b: (a - b) / (2 * _FINE), ahead, behind)

    def of_common(moved: Coordinates) -> np.ndarray:
        return np.asarray(ravel_pytree({name: moved[name] for name in common})[0])

    columns = [difference(restore(unit)) for unit in jnp.eye(flat.size, dtype=flat.dtype)]
    hessian = np.stack([of_common(column) for column in columns])
    if "widths" not in free:
        return restore(jnp.asarray(np.sqrt(np.diagonal(np.linalg.inv(hessian)))))
    mixed = np.stack([np.asarray(column["widths"]) for column in columns])
    own = np.asarray(difference({"widths": jnp.ones_like(coordinates["widths"])})["widths"])
    covariance = np.linalg.inv(hessian - (mixed / own) @ mixed.T)
    of_widths = 1.0 / own + np.einsum("iw,ij,jw->w", mixed / own, covariance, mixed / own)
    return restore(jnp.asarray(np.sqrt(np.diagonal(covariance)))) | {"widths": jnp.asarray(np.sqrt(of_widths))}
