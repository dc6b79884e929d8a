"""What the search for hyperparameters minimises: the negative log evidence, per answer, with or without weak priors.

Given with gradient and Hessian: of Laplace's and EP's evidence in closed form, of corrected EP's by differentiation.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from hilbo.hyperparameters.coordinates import OF_THE_LIKELIHOOD, Coordinates, coordinates_of, log_prior, model_at
from hilbo.hyperparameters.ep_evidence import ep_evidence
from hilbo.hyperparameters.laplace_evidence import Evidence, laplace_evidence
from hilbo.kernels import gram
from hilbo.numerics.linalg import one_at_a_time
from hilbo.numerics.newton import Expansion, expanded
from hilbo.ordinal_gp import OrdinalGP, OrdinalTerms, TiltedTerms, Trials, fit

__all__ = ["Seen", "divisor", "evidence_cost", "person_ep_evidence", "person_evidence"]


class Seen(NamedTuple):
    """The log evidence at some coordinates, whether it is certified, and where the posteriors were and are going."""

    log_evidence: Float[Array, ""]
    certified: Bool[Array, ""]
    at: Float[Array, " p"]
    place: PyTree[Float[Array, "M n"]]
    moved: PyTree[Float[Array, "M n p"]]


def evidence_cost(
    gp: OrdinalGP, trials: Trials, learn: tuple[str, ...], weak_priors: bool, inference: str
) -> tuple[Callable[[Coordinates, Seen], Expansion], Seen]:
    """The expansion of the cost of stacked `trials`, from coordinates and what was seen before, with what is seen
    there; and what was seen at first: nothing."""
    begin = ravel_pytree(coordinates_of(gp, learn))[0]
    zero = jnp.zeros((), begin.dtype)
    answers = divisor(trials)
    evidence = _differentiated if inference == "ep_corrected" else _closed

    def expand(coordinates, last):
        value, gradient, hessian, seen = evidence(gp, trials, inference, coordinates, last)
        if weak_priors:
            flat, restore = ravel_pytree(coordinates)
            prior = expanded(lambda at: (log_prior(model_at(restore(at), gp), gp, learn), None), flat)
            value, gradient, hessian = value + prior.value, gradient + prior.gradient, hessian + prior.hessian
        return Expansion(-value / answers, -gradient / answers, -hessian / answers, seen)

    place, moved = _unknown(trials, begin, inference)
    return expand, Seen(zero, jnp.zeros((), bool), begin, place, moved)


def divisor(trials: Trials) -> Float[Array, ""]:
    """What the evidence is divided by: answers, so that curvatures are near 1 and the first step, which is down the
    bare gradient, is a sensible one. One more, because there may be none."""
    return jnp.sum(trials.mask, dtype=trials.x.dtype) + 1.0


def _unknown(trials, begin, inference):
    none = jnp.zeros(trials.q.shape, begin.dtype)
    place = {"laplace": none, "ep": (none, none - jnp.inf)}.get(inference, ())
    return place, jax.tree.map(lambda leaf: jnp.zeros((*leaf.shape, begin.size), leaf.dtype), place)


def _differentiated(gp, trials, inference, coordinates, last):
    """Value, gradient and Hessian of the summed evidence by automatic differentiation."""
    del last
    flat, restore = ravel_pytree(coordinates)

    def one(model, person):
        posterior = fit(model, person, inference=inference, throw=False)
        return posterior.log_evidence, posterior.certificate.converged

    def summed(flat):
        evidences, converged = jax.vmap(one, in_axes=(None, 0))(model_at(restore(flat), gp), trials)
        return jnp.sum(evidences), jnp.all(converged)

    found = expanded(summed, flat)
    return *found[:3], Seen(found.value, found.aux, flat, (), ())


def _closed(gp, trials, inference, coordinates, last):
    """The same by closed derivatives; the posteriors are sought from where the last ones point."""
    expansion = {"laplace": person_evidence, "ep": person_ep_evidence}[inference]
    flat, _ = ravel_pytree(coordinates)
    ahead = flat - last.at
    starts = jax.tree.map(lambda place, moved: place + moved @ ahead, last.place, last.moved)
    if trials.q.shape[0] > 1:
        found = jax.vmap(expansion, in_axes=(None, None, 0, 0))(gp, coordinates, trials, starts)
    else:
        alone = expansion(gp, coordinates, *jax.tree.map(lambda leaf: leaf[0], (trials, starts)))
        found = jax.tree.map(lambda leaf: leaf[None], alone)
    value, gradient, hessian = (jnp.sum(part, axis=0) for part in found[:3])
    return value, gradient, hessian, Seen(value, jnp.all(found.certified), flat, found.place, found.moved)


@one_at_a_time
def person_evidence(gp: OrdinalGP, coordinates: Coordinates, trials: Trials, start: Float[Array, " n"]) -> Evidence:
    """One person's evidence by Laplace's method, expanded in the coordinates, which are in alphabetical order.

    `start`: weights near which the mode is sought.
    """
    covariance, likelihood, own, shape = _parts(gp, coordinates, trials, start.dtype)
    return laplace_evidence(
        covariance, lambda at: OrdinalTerms(likelihood(at), trials.q, trials.mask), own, shape, start
    )


@one_at_a_time
def person_ep_evidence(
    gp: OrdinalGP, coordinates: Coordinates, trials: Trials, start: tuple[Float[Array, " n"], Float[Array, " n"]]
) -> Evidence:
    """The same by expectation propagation; `start`: means and log variances of cavities, as in [`ep_evidence`][]."""
    covariance, likelihood, own, shape = _parts(gp, coordinates, trials, start[0].dtype)
    return ep_evidence(covariance, lambda at: TiltedTerms(likelihood(at), trials.q, trials.mask), own, shape, start)


def _parts(gp, coordinates, trials, dtype):
    """K as a function of the kernel's coordinates, the likelihood as one of its own, and both as vectors."""
    own = {name: value for name, value in coordinates.items() if name in OF_THE_LIKELIHOOD}
    shape = {name: value for name, value in coordinates.items() if name not in OF_THE_LIKELIHOOD}
    (flat_own, restore_own), (flat_shape, restore_shape) = ravel_pytree(own), ravel_pytree(shape)

    def covariance(at):
        return gram(model_at(own | restore_shape(at), gp).kernel, trials.x, trials.x)

    def likelihood(at):
        return model_at(restore_own(at) | shape, gp).likelihood

    return covariance, likelihood, flat_own.astype(dtype), flat_shape.astype(dtype)
