"""learnt-1: the hierarchical model with hyperparameters learnt from all answers, as a recipe that does not change.

In units of the classification noise, with d parameters and C categories, people's functions and answers are those of
`low_rank.PeopleModel`, and the hyperparameters have the priors

    log theta_i ~ N(log(24 / d), 1.2^2)       log shared ~ N(log 3, 1)       log own ~ N(0, 1)
    middle of the thresholds ~ N(0, 1.5^2)    log gap ~ N(log 0.8, 0.7^2)    log width_j ~ N(0, 0.4^2), if C > 2.

What maximises the Laplace evidence of all answers times these priors is taken, by L-BFGS from the priors' medians. A
hyperparameter that the study states is kept, and with a stated noise, or variance, everything is in its unit. The
normal approximation of their posterior says how well each is known; one that is known hardly better than before the
answers is not identified.
"""

from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float
from scipy.optimize import minimize

from hilbo.errors import InputError
from hilbo.ordinal_gp import Trials
from hilbo.population.low_rank import PeopleModel, rank_for, shared_evidence

__all__ = ["PRIORS", "Learnt", "Prior", "Stated", "learn"]

Coordinates = dict[str, Float[Array, "..."]]

_STEPS, _FINE = 100, 1e-3  # of the search; of the finite differences for the curvature
_UNKNOWN = 0.9  # of the prior's standard deviation
_LEFT = 1e-4
"""Of the shared function's prior variance, what the search may leave: 1e-5 of the log evidence of 600 answers."""


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
    """Near which the posterior's mode is."""
    log_evidence: Float[Array, ""]
    coordinates: Coordinates
    """Logarithms in units of the noise, and the middle of the thresholds, as in the priors."""
    sd: Coordinates
    """Standard deviations of their posterior."""
    steps: int = eqx.field(static=True)
    rank: int = eqx.field(static=True)
    left: Float[Array, ""]
    """Largest part of the shared function's prior variance, at an answered point, that is not followed."""
    converged: Bool[Array, ""]


def learn(
    trials: Trials,
    categories: int,
    stated: Stated = NOTHING,
    priors: Mapping[str, Prior] = PRIORS,
    widths: bool = True,
) -> Learnt:
    """The hyperparameters of stacked trials (M, n) of answers in `categories`.

    **Arguments:** `stated`: what is kept; `priors`: for studies of their influence; `widths`: whether people may differ
    in their widths. Raises InputError where nobody answered.
    """
    if not np.asarray(trials.mask).any():
        raise InputError("learnt-1: nobody gave an answer; at least one person's answers are needed.")
    start = _medians(trials, categories, stated, priors, widths)
    search = _Search(start, jnp.zeros(trials.q.shape, trials.x.dtype), 0, True)
    rank = rank_for(_model(start, trials, stated).theta, trials, _LEFT)
    while True:  # lengths that became shorter take more features
        search = _searched(search, _Problem(trials, stated, priors, rank))
        needed = rank_for(_model(search.coordinates, trials, stated).theta, trials, _LEFT)
        if needed <= rank:
            break
        rank = needed
    problem = _Problem(trials, stated, priors, rank)
    end = _cost(search.coordinates, search.weights, problem)
    return Learnt(
        model=_model(search.coordinates, trials, stated),
        weights=end.weights,
        log_evidence=end.log_evidence,
        coordinates=search.coordinates,
        sd=_standard_deviations(search.coordinates, end.weights, problem),
        steps=search.steps,
        rank=rank,
        left=end.left,
        converged=end.usable & jnp.asarray(search.ended) & (end.left <= _LEFT),
    )


class _Problem(eqx.Module):
    """What is given of a search."""

    trials: Trials
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


def _searched(search: _Search, problem: _Problem) -> _Search:
    """L-BFGS from where a search is; each mode is sought from the one before's."""
    flat, restore = ravel_pytree(search.coordinates)
    latest = search.weights

    def cost(z):
        nonlocal latest
        here = _cost(restore(jnp.asarray(z, flat.dtype)), latest, problem)
        if not bool(here.usable):  # the line search is to turn back
            return np.inf, np.zeros_like(z)
        latest = here.weights
        return float(here.value), np.asarray(ravel_pytree(here.gradient)[0], float)

    options = {"maxiter": _STEPS, "ftol": 1e-9, "gtol": 1e-3}
    result = minimize(cost, np.asarray(flat, float), jac=True, method="L-BFGS-B", options=options)
    end = restore(jnp.asarray(result.x, flat.dtype))
    return _Search(end, latest, search.steps + int(result.nit), bool(result.success))


@eqx.filter_jit
def _cost(coordinates: Coordinates, start: Float[Array, "M n"], problem: _Problem) -> _Cost:
    def value(coordinates):
        model = _model(coordinates, problem.trials, problem.stated)
        evidence = shared_evidence(model, problem.trials, start, problem.rank, _LEFT)
        return -evidence.value - _log_prior(coordinates, problem), evidence

    (cost, evidence), gradient = jax.value_and_grad(value, has_aux=True)(coordinates)
    finite = jnp.all(jnp.isfinite(ravel_pytree(gradient)[0])) & jnp.isfinite(cost)
    return _Cost(cost, gradient, evidence.value, evidence.weights, evidence.arrived & finite, evidence.left)


def _medians(trials: Trials, categories: int, stated: Stated, priors: Mapping[str, Prior], widths: bool) -> Coordinates:
    """Where the search begins: the medians of what is learnt."""
    dtype, d = trials.x.dtype, trials.x.shape[-1]
    every = {
        "theta": jnp.full(d, priors["theta"].mean - np.log(d), dtype),
        "shared": jnp.asarray(priors["shared"].mean, dtype),
        "own": jnp.asarray(priors["own"].mean, dtype),
        "middle": jnp.asarray(priors["middle"].mean, dtype),
        "gaps": jnp.full(categories - 2, priors["gaps"].mean, dtype),
        "widths": jnp.full(trials.mask.shape[0], priors["widths"].mean, dtype),
    }
    kept = {"theta"} if stated.theta is not None else set()
    kept |= {"middle", "gaps"} if stated.thresholds is not None else set()
    kept |= {"widths"} if not widths or categories < 3 else set()
    return {name: value for name, value in every.items() if name not in kept and value.size}


def _model(coordinates: Coordinates, trials: Trials, stated: Stated) -> PeopleModel:
    """The hyperparameters at some coordinates, in units of the stated noise, or variance, or else of a noise of 1."""
    dtype, people = trials.x.dtype, trials.mask.shape[0]
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
        theta = jnp.broadcast_to(jnp.asarray(stated.theta, dtype), trials.x.shape[-1:])
    if stated.thresholds is None:
        gaps = jnp.exp(coordinates["gaps"]) if "gaps" in coordinates else jnp.zeros(0, dtype)
        edges = jnp.concatenate([jnp.zeros(1, dtype), jnp.cumsum(gaps)])
        thresholds = noise * (coordinates["middle"] + edges - jnp.mean(edges))
    else:
        thresholds = jnp.asarray(stated.thresholds, dtype)
    return PeopleModel(theta, shared, own, thresholds, noise, coordinates.get("widths", jnp.zeros(people, dtype)))


def _log_prior(coordinates: Coordinates, problem: _Problem) -> Float[Array, ""]:
    """Up to a constant."""
    d = problem.trials.x.shape[-1]
    total = jnp.zeros((), problem.trials.x.dtype)
    for name, value in coordinates.items():
        mean, sd = problem.priors[name]
        total -= 0.5 * jnp.sum(((value - mean + (jnp.log(d) if name == "theta" else 0.0)) / sd) ** 2)
    return total


def _standard_deviations(coordinates: Coordinates, start: Float[Array, "M n"], problem: _Problem) -> Coordinates:
    """Of the posterior, taken for normal: its curvature from differences of gradients.

    People's widths are independent given the rest, up to what their answers share: their part of the curvature is
    taken for diagonal, and costs one difference for all.
    """
    common = {name: value for name, value in coordinates.items() if name != "widths"}
    flat, restore = ravel_pytree(common)
    widths = coordinates.get("widths", jnp.zeros(0, flat.dtype))

    def gradient(common: Array, widths: Array) -> tuple[Array, Array]:
        moved = restore(common)
        slope = _cost(moved | ({"widths": widths} if widths.size else {}), start, problem).gradient
        return ravel_pytree({name: slope[name] for name in moved})[0], slope["widths"] if widths.size else widths

    def difference(common_step, width_step):
        ahead, behind = (gradient(flat + s * common_step, widths + s * width_step) for s in (_FINE, -_FINE))
        return [np.asarray((a - b) / (2 * _FINE)) for a, b in zip(ahead, behind, strict=True)]

    units = jnp.eye(flat.size, dtype=flat.dtype)
    columns = [difference(unit, 0.0 * widths) for unit in units]
    hessian, mixed = (np.stack([column[i] for column in columns]) for i in (0, 1))
    own = difference(0.0 * flat, jnp.ones_like(widths))[1] if widths.size else np.zeros(0)
    covariance = np.linalg.inv(hessian - (mixed / own) @ mixed.T)
    of_widths = 1.0 / own + np.einsum("iw,ij,jw->w", mixed / own, covariance, mixed / own)
    sd = restore(jnp.asarray(np.sqrt(np.diagonal(covariance))))
    return sd | ({"widths": jnp.asarray(np.sqrt(of_widths))} if widths.size else {})
