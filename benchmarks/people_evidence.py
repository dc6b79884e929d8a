"""Hyperparameters of the hierarchical model by maximum evidence: length scales, variance, thresholds and the share.

For benchmarks/people.py, where rules without a recipe are to have the best hyperparameters that there are for them.

All people's answers count together (`low_rank.shared_evidence`): the prior variance of one person's function, of which
the share p is common to all, the inverse squared lengths theta and the thresholds are learnt, in units of the
classification noise, which stays as it is (the scale of f is free). With the share held at 1 this is the pooled
model's evidence, at 0 the sum of everybody's own. The search is L-BFGS on exact gradients, in the coordinates
log theta, log variance, log noise, first threshold, log gaps, logit p.
"""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.optimize import minimize

from hilbo.likelihoods import OrdinalProbit
from hilbo.ordinal_gp import OrdinalGP
from hilbo.population.shared.features import pivots_of
from hilbo.population.shared.low_rank import SharedEvidence, shared_evidence
from hilbo.population.shared.people_model import PeopleModel
from hilbo.population.shared.tallies import Tallies

__all__ = ["LearntPeople", "evidence", "learn_people"]

_REFUSED = 1e3  # per answer: more than any answers cost
_MOST = 256  # pivots
_LEFT = 1e-9  # of the shared function's prior variance
_REACH = 7.0  # coordinates stay so far from where they began: a factor of 1,100


class LearntPeople(eqx.Module):
    """A model of one person, the share that people have in common, and how the search for them ended."""

    gp: OrdinalGP
    share: Float[Array, ""]
    log_evidence: Float[Array, ""]
    steps: int = eqx.field(static=True)
    converged: Bool[Array, ""]
    """The search ended by itself, and the fit at its end held its certificate."""


def learn_people(
    gp: OrdinalGP,
    answers: Tallies,
    share: float = 0.8,
    *,
    learn: Sequence[str] = ("theta", "variance", "thresholds", "share"),
    max_steps: int = 60,
    tolerance: float = 1e-6,
) -> LearntPeople:
    """The hyperparameters under which all answers are most probable, from the values of `gp` and `share` on.

    **Arguments:** `learn`: which of "theta" (as many as `gp` has), "variance", "noise", "thresholds" and "share";
    `tolerance`: of the log evidence per answer, at which the search ends.
    """
    count = float(jnp.sum(answers.counts))
    coordinates = {name: value for name, value in _coordinates(gp, share).items() if name in _coordinates_of(learn)}
    flat, rebuild = jax.flatten_util.ravel_pytree(coordinates)
    fixed_share = jnp.asarray(share, flat.dtype)  # an array: another number is no other function to compile

    def cost(z):
        value, slope, usable = _cost(jnp.asarray(z, flat.dtype), rebuild, gp, fixed_share, answers)
        if not usable:  # no mode, no evidence: the line search is to turn back
            return _REFUSED, np.zeros(len(z))
        return float(value) / count, np.asarray(slope, float) / count

    start = np.asarray(flat, float)
    bounds = [(z - _REACH, z + _REACH) for z in start]
    options = {"maxiter": max_steps, "ftol": tolerance, "gtol": 1e-6}
    result = minimize(cost, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    best = jnp.asarray(result.x, flat.dtype)
    value, _, usable = _cost(best, rebuild, gp, fixed_share, answers)
    model, learnt_share = _model(rebuild(best), gp, fixed_share)
    return LearntPeople(
        model, learnt_share, -value, int(result.nit), jnp.asarray(bool(result.success) and bool(usable))
    )


@eqx.filter_jit
def _cost(
    z: Float[Array, " z"],
    rebuild: Callable[[Array], dict[str, Array]],
    gp: OrdinalGP,
    share: Float[Array, ""],
    answers: Tallies,
) -> tuple[Float[Array, ""], Float[Array, " z"], Bool[Array, ""]]:
    """Minus the log evidence, its gradient, and whether both may be used."""

    def value(z):
        model, learnt_share = _model(rebuild(z), gp, share)
        end = evidence(model, learnt_share, answers)
        return -end.value, end.arrived

    (negative_evidence, arrived), slope = jax.value_and_grad(value, has_aux=True)(z)
    return negative_evidence, slope, arrived & jnp.isfinite(negative_evidence) & jnp.all(jnp.isfinite(slope))


def evidence(gp: OrdinalGP, share: Float[Array, ""], answers: Tallies) -> SharedEvidence:
    """Log evidence of all answers, differentiable once in `gp` and in `share`."""
    model = PeopleModel.of(gp, share, len(answers.x))
    room = min(answers.blank.size, _MOST)
    return shared_evidence(
        model, answers, answers.blank, pivots_of(jax.lax.stop_gradient(model.unit), answers, room, _LEFT)
    )


def _coordinates_of(learn: Sequence[str]) -> set[str]:
    """Which coordinates belong to the names of hyperparameters."""
    return {field for name in learn for field in ({"first", "gaps"} if name == "thresholds" else {name})}


def _coordinates(gp: OrdinalGP, share: float) -> dict[str, Float[Array, "..."]]:
    """A model and a share in the coordinates of the search."""
    thresholds, inner = gp.likelihood.thresholds, min(max(share, 1e-3), 1 - 1e-3)
    return {
        "theta": jnp.log(gp.kernel.theta),
        "variance": jnp.log(gp.kernel.variance),
        "noise": jnp.log(gp.likelihood.noise),
        "first": thresholds[0],
        "gaps": jnp.log(jnp.diff(thresholds)),
        "share": jnp.asarray(np.log(inner / (1 - inner)), thresholds.dtype),
    }


def _model(
    z: dict[str, Float[Array, "..."]], gp: OrdinalGP, share: Float[Array, ""]
) -> tuple[OrdinalGP, Float[Array, ""]]:
    """The model and the share at some coordinates; what is not among them stays as it is."""
    positive = {"theta": gp.kernel.theta, "variance": gp.kernel.variance, "noise": gp.likelihood.noise}
    positive |= {name: jnp.exp(z[name]) for name in positive if name in z}
    thresholds = gp.likelihood.thresholds
    if "first" in z:
        thresholds = jnp.cumsum(jnp.concatenate([z["first"][None], jnp.exp(z["gaps"])]))
    learnt_share = jax.nn.sigmoid(z["share"]) if "share" in z else jnp.asarray(share, thresholds.dtype)
    kernel = gp.kernel.with_numbers(positive["theta"], positive["variance"])
    model = OrdinalGP(kernel, OrdinalProbit(thresholds, positive["noise"]))
    return model, learnt_share
