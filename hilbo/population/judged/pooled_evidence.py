"""Hyperparameters by maximum evidence of one function for all participants, with features of few points.

The model is the hierarchical one without individual functions, at the cost of its low rank
(`hilbo.population.shared.low_rank`). Laplace's method. The features stay fixed during a descent, and are chosen again
if it ends at other length scales. The weak priors are those of `hilbo.hyperparameters.maximum_evidence`.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from hilbo.errors import InputError
from hilbo.hyperparameters.coordinates import Coordinates, coordinates_of, log_prior, model_at
from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import OrdinalGP, Trials
from hilbo.population.judged.evidence_search import Cost, Maximum, ran_away, searched
from hilbo.population.shared.features import Pivots, pivots_for
from hilbo.population.shared.low_rank import shared_evidence
from hilbo.population.shared.people_model import PeopleModel
from hilbo.population.shared.tallies import Tallies, tallied

__all__ = ["maximise_pooled"]

_ROUNDS = 8
_LEFT = 1e-6  # part of the prior variance that the features may leave at a tested point
_MOST = 640  # features: those of all points of 24 people with 25 trials
_ROUGH = 0.05  # of the prior variance: what the features may leave at most
_MOVED, _REACH = 0.35, 1.5  # of log theta: after which features are chosen again, and in one descent


def maximise_pooled(gp: OrdinalGP, trials: Trials, learn: tuple[str, ...]) -> Maximum:
    """Hyperparameters that maximise the evidence of one function for all participants, with weak priors.

    **Arguments:** `gp`: starting values, the priors' centre, and the fixed values; `trials`: stacked
    (M, n); `learn`: which of "theta", "noise" and "thresholds".

    Raises `InputError` without responses. A search that fails does not raise: read `converged`.
    """
    if not np.asarray(trials.mask).any():
        raise InputError("maximise_pooled: there are no responses; at least one is needed.")
    answers = tallied(trials, gp.likelihood.categories)
    flat, restore = ravel_pytree(coordinates_of(gp, learn))

    def at(place: Float[np.ndarray, " p"]) -> Coordinates:
        return restore(jnp.asarray(place, flat.dtype))

    def cost(place: Float[np.ndarray, " p"], pivots: Pivots) -> Cost:
        return _cost(jnp.asarray(place, flat.dtype), gp, answers, pivots, learn)

    begin = np.asarray(flat, float)
    pivots = _pivots(gp, answers)
    end = searched(partial(cost, pivots=pivots), begin, _bounds(at(begin)))
    before, place, steps, settled = end.first, begin, end.steps, False
    for _ in range(_ROUNDS):
        settled = _settled(at(end.place - place))
        if settled:
            break
        place, pivots = end.place, _pivots(model_at(at(end.place), gp), answers)
        end = searched(partial(cost, pivots=pivots), place, _bounds(at(place)))
        steps += end.steps
    return Maximum(
        gp=model_at(at(end.place), gp),
        log_evidence=end.log_evidence if np.isfinite(end.cost) else before,
        log_evidence_before=before,
        steps=steps,
        converged=end.converged and settled and float(pivots.left) <= _ROUGH,
        runaway=ran_away(at(end.place - begin)),
    )


def _settled(moved: Coordinates) -> bool:
    """Whether the length scales changed so little that the features still serve."""
    return bool(np.all(np.abs(np.asarray(moved.get("theta", 0.0))) <= _MOVED))


def _pivots(gp: OrdinalGP, answers: Tallies) -> Pivots:
    """Pivots of the features for the length scales of `gp`."""
    unit = gp.kernel.with_numbers(gp.kernel.theta, jnp.ones_like(gp.kernel.variance))
    return pivots_for(unit, answers, _LEFT, most=_MOST)


def _bounds(start: Coordinates) -> list[tuple[float, float]]:
    """Bounds of each coordinate in one descent: log theta moves by at most 1.5, others freely."""
    ends = []
    for sign in (-1.0, 1.0):
        far = {name: jnp.full_like(value, sign * jnp.inf) for name, value in start.items()}
        near = {"theta": start["theta"] + sign * _REACH} if "theta" in start else {}
        ends.append(np.asarray(ravel_pytree(far | near)[0], float).tolist())
    return list(zip(*ends, strict=True))


@program
def _cost(flat: Float[Array, " p"], gp: OrdinalGP, answers: Tallies, pivots: Pivots, learn: tuple[str, ...]) -> Cost:
    """Cost at the coordinates `flat` (p,), those that `learn` names, in the order of `ravel_pytree`; compiled.

    `gp`: the model at the priors' centre.
    """
    restore = ravel_pytree(coordinates_of(gp, learn))[1]

    def value(flat):
        model = model_at(restore(flat), gp)
        pooled = PeopleModel.of(model, 1.0, answers.x.shape[0])
        evidence = shared_evidence(pooled, answers, jnp.zeros_like(answers.blank), pivots)
        return -evidence.value - log_prior(model, gp, learn), (evidence.value, evidence.arrived)

    (cost, (evidence, arrived)), gradient = jax.value_and_grad(value, has_aux=True)(flat)
    return Cost(cost, gradient, evidence, arrived)
