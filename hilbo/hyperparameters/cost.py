"""Objective of the search for hyperparameters: negative log evidence per response, with or without weak priors.

With gradient and Hessian: in closed form for Laplace's and EP's evidence, by differentiation for corrected EP's.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, PyTree

from hilbo.gaussian import Matrix, Scalar, Vector
from hilbo.hyperparameters.coordinates import OF_THE_LIKELIHOOD, Coordinates, coordinates_of, log_prior, model_at
from hilbo.hyperparameters.ep_evidence import ep_evidence
from hilbo.hyperparameters.laplace_evidence import Evidence, laplace_evidence
from hilbo.kernels import gram
from hilbo.likelihoods import OrdinalTerms, TiltedTerms
from hilbo.numerics.linalg import one_at_a_time
from hilbo.numerics.newton import Expansion, expanded
from hilbo.ordinal_gp import OrdinalGP, Trials, fit

__all__ = ["Seen", "divisor", "evidence_cost", "person_ep_evidence", "person_evidence"]


class Seen(NamedTuple):
    """Evaluation of the evidence: value (summed over participants), whether all posteriors are certified, coordinates
    (p,), and starts for the next posteriors: `place` and its derivatives by the coordinates, `moved`.
    """

    log_evidence: Scalar
    certified: Bool[Array, ""]
    coordinates: Float[Array, " p"]
    place: PyTree[Float[Array, "M n"]]
    moved: PyTree[Float[Array, "M n p"]]


def evidence_cost(
    gp: OrdinalGP, trials: Trials, learn: tuple[str, ...], weak_priors: bool, inference: str
) -> tuple[Callable[[Coordinates, Seen], Expansion], Seen]:
    """Build the objective to be minimised for stacked `trials`, and an empty evaluation to begin with.

    The objective maps coordinates and the last evaluation to the expansion (value, gradient, Hessian) of minus the log
    evidence over `divisor`, with the weak priors if wanted; its `aux` is the new evaluation. The posteriors are started
    from the last one. `learn`: names of hyperparameters; `inference`: "laplace", "ep" or "ep_corrected".
    """
    initial = ravel_pytree(coordinates_of(gp, learn))[0]
    zero = jnp.zeros((), initial.dtype)
    answers = divisor(trials)
    evidence = _differentiated if inference == "ep_corrected" else _closed

    def expand(coordinates, last):
        value, gradient, hessian, seen = evidence(gp, trials, inference, coordinates, last)
        if weak_priors:
            flat, restore = ravel_pytree(coordinates)
            prior = expanded(lambda flat: (log_prior(model_at(restore(flat), gp), gp, learn), None), flat)
            value, gradient, hessian = value + prior.value, gradient + prior.gradient, hessian + prior.hessian
        return Expansion(-value / answers, -gradient / answers, -hessian / answers, seen)

    place, moved = _no_starts(trials, initial, inference)
    return expand, Seen(zero, jnp.zeros((), bool), initial, place, moved)


def divisor(trials: Trials) -> Scalar:
    """Divisor of the evidence, a scalar: number of responses + 1, which scales curvatures to about 1; never 0."""
    return jnp.sum(trials.mask, dtype=trials.x.dtype) + 1.0


def _no_starts(
    trials: Trials, initial: Float[Array, " p"], inference: str
) -> tuple[PyTree[Float[Array, "M n"]], PyTree[Float[Array, "M n p"]]]:
    """Starting values of the posteriors that stand for no start, and their derivatives, which are 0; `initial` (p,):
    coordinates. Empty tuples for an inference without starts.
    """
    none = jnp.zeros(trials.q.shape, initial.dtype)
    place = {"laplace": none, "ep": (none, none - jnp.inf)}.get(inference, ())
    return place, jax.tree.map(lambda leaf: jnp.zeros((*leaf.shape, initial.size), leaf.dtype), place)


def _differentiated(gp: OrdinalGP, trials: Trials, inference: str, coordinates: Coordinates, last: Seen) -> Expansion:
    """Value, gradient and Hessian of the log evidence summed over participants, by automatic differentiation; `aux` is
    the evaluation. `last` is ignored.
    """
    del last
    flat, restore = ravel_pytree(coordinates)

    def one(model, person):
        posterior = fit(model, person, inference=inference, throw=False)
        return posterior.log_evidence, posterior.certificate.converged

    def summed(flat):
        evidences, converged = jax.vmap(one, in_axes=(None, 0))(model_at(restore(flat), gp), trials)
        return jnp.sum(evidences), jnp.all(converged)

    evidence = expanded(summed, flat)
    return evidence._replace(aux=Seen(evidence.value, evidence.aux, flat, (), ()))


def _closed(gp: OrdinalGP, trials: Trials, inference: str, coordinates: Coordinates, last: Seen) -> Expansion:
    """Value, gradient and Hessian of the log evidence summed over participants, in closed form; `aux` is the
    evaluation.

    The posteriors are started from extrapolations of those of the evaluation `last`.
    """
    expansion = {"laplace": person_evidence, "ep": person_ep_evidence}[inference]
    flat, _ = ravel_pytree(coordinates)
    step = flat - last.coordinates
    starts = jax.tree.map(lambda place, moved: place + moved @ step, last.place, last.moved)
    if trials.q.shape[0] > 1:
        evidence = jax.vmap(expansion, in_axes=(None, None, 0, 0))(gp, coordinates, trials, starts)
    else:
        alone = expansion(gp, coordinates, *jax.tree.map(lambda leaf: leaf[0], (trials, starts)))
        evidence = jax.tree.map(lambda leaf: leaf[None], alone)
    value, gradient, hessian = (jnp.sum(per_person, axis=0) for per_person in evidence[:3])
    seen = Seen(value, jnp.all(evidence.certified), flat, evidence.place, evidence.moved)
    return Expansion(value, gradient, hessian, seen)


@one_at_a_time
def person_evidence(gp: OrdinalGP, coordinates: Coordinates, trials: Trials, start: Vector) -> Evidence:
    """Laplace's log evidence of one participant, with gradient and Hessian in the coordinates (in alphabetical order).

    `start` (n,): weights from which the mode is searched.
    """
    return laplace_evidence(*_evidence_arguments(gp, coordinates, trials, start.dtype, OrdinalTerms), start)


@one_at_a_time
def person_ep_evidence(
    gp: OrdinalGP, coordinates: Coordinates, trials: Trials, start: tuple[Vector, Vector]
) -> Evidence:
    """EP's log evidence of one participant, with gradient and Hessian in the coordinates (in alphabetical order).

    `start`: means and log variances (n,) of the cavities, as for [`ep_evidence`][].
    """
    return ep_evidence(*_evidence_arguments(gp, coordinates, trials, start[0].dtype, TiltedTerms), start)


_Terms = TypeVar("_Terms", OrdinalTerms, TiltedTerms)


def _evidence_arguments(
    gp: OrdinalGP, coordinates: Coordinates, trials: Trials, dtype: DTypeLike, terms: type[_Terms]
) -> tuple[
    Callable[[Float[Array, " k"]], Matrix],
    Callable[[Float[Array, " l"]], _Terms],
    Float[Array, " l"],
    Float[Array, " k"],
]:
    """Arguments of the evidence functions for one participant: K as a function of the kernel's coordinates (k,), terms
    of the class `terms` as a function of the likelihood's coordinates (l,), and both vectors, the likelihood's first,
    in `dtype`.
    """
    of_likelihood = {name: value for name, value in coordinates.items() if name in OF_THE_LIKELIHOOD}
    of_kernel = {name: value for name, value in coordinates.items() if name not in OF_THE_LIKELIHOOD}
    flat_likelihood, restore_likelihood = ravel_pytree(of_likelihood)
    flat_kernel, restore_kernel = ravel_pytree(of_kernel)

    def covariance(flat: Float[Array, " k"]) -> Matrix:
        return gram(model_at(of_likelihood | restore_kernel(flat), gp).kernel, trials.x, trials.x)

    def answers(flat: Float[Array, " l"]) -> _Terms:
        return terms(model_at(restore_likelihood(flat) | of_kernel, gp).likelihood, trials.q, trials.mask)

    return covariance, answers, flat_likelihood.astype(dtype), flat_kernel.astype(dtype)
