"""Posterior of the shared function g, and of the random effect of contexts, from all responses, by `low_rank`."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float, Int

from hilbo.gaussian import Certificate, GaussianPosterior, evidence_known, evidence_rounding, evidence_tolerance
from hilbo.kernels import Stationary, gram
from hilbo.likelihoods import OrdinalProbit
from hilbo.numerics.sharding import of_each_person, sum_over_people
from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import OrdinalGP, Posterior, Trials
from hilbo.population.shared.features import Pivots, features_of, root_of_pivots
from hilbo.population.shared.low_rank import Mode, evidence_at, mode_of, newton_step
from hilbo.population.shared.people_model import PeopleModel
from hilbo.population.shared.system import System, prior_of
from hilbo.population.shared.tallies import Tallies

__all__ = ["ContextEffects", "SharedFunction", "SharedMoments", "shared_function", "shared_moments"]


class ContextEffects(eqx.Module):
    """Posterior of the effects of c contexts on all participants' functions: `mean` and `variance` (c,), and their
    covariance with g; `prior`: variance of an untested context's effect.
    """

    prior: Float[Array, ""]
    """Variance of the effect of an untested context."""
    mean: Float[Array, " c"]
    variance: Float[Array, " c"]
    kernel: Stationary
    """Of g."""
    points: Float[Array, "r d"]
    cross: Float[Array, "r c"]
    """k(x, points) times it is the covariance of g(x) with the effects."""

    def added(self, x: Float[Array, "m d"], context: Int[Array, " m"]) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
        """Changes of mean and variance (m,) of g at points (m, d) when the effects of these contexts are added,
        `context` (m,) being their indices.
        """
        together = jnp.sum(gram(self.kernel, x, self.points) * self.cross[:, context].T, axis=1)
        return self.mean[context], self.variance[context] + 2.0 * together


class SharedFunction(NamedTuple):
    """Posterior of g, with a random effect integrated out; and the posterior of the effects, None without."""

    function: Posterior
    """Of g; a random effect is integrated out."""
    effects: ContextEffects | None
    """Of a model with a random effect."""


@program
def shared_function(model: PeopleModel, answers: Tallies, start: Float[Array, "M n"], pivots: Pivots) -> SharedFunction:
    """Posterior of the shared function g, as a GP with tested points at the pivots, and of the random effect.

    Arguments as for `shared_evidence`. All responses together inform g through its weights w, of precision S and mean
    F'a: with L L' = k(Z, Z) the mean is k(x, Z) L^-T w and k(x, Z) L^-T (I - S^-1) L^-1 k(Z, x) of the prior variance
    is explained. Weights of responses given at a pivot stay there: L, which may be nearly singular, only carries over
    the others. Never raises: read `certificate.converged`.
    """
    solved = _solved(model, answers, start, pivots)
    mode, system, weights, root = solved.mode, solved.system, solved.weights, solved.root
    rank = len(pivots.points)
    explained = solve_triangular(root, system.explained(rank).T, lower=True, trans=1).T
    factor = jnp.where(pivots.used[None, :], jnp.pad(explained, ((0, rank - len(explained)), (0, 0))), 0.0)

    kernel = model.of_variance(model.shared)
    covariance = gram(kernel, pivots.points, pivots.points)
    smallest = jnp.min(jnp.diagonal(covariance) - jnp.sum((factor @ covariance) ** 2, axis=0))
    resolution = jnp.finfo(root.dtype).eps * model.shared * root.shape[0] ** 0.5
    rounding = _rounding(model, answers, mode.weights, covariance, weights)
    known_well = evidence_known(solved.value, solved.error, rounding) & (smallest >= resolution)
    certificate = Certificate(
        residual=mode.residual,
        tolerance=mode.tolerance,
        iterations=mode.steps,
        jitter=pivots.left,
        condition=jnp.linalg.norm(system.inner),
        smallest_variance=smallest,
        variance_resolution=resolution,
        evidence_error=solved.error,
        evidence_tolerance=evidence_tolerance(solved.value),
        evidence_rounding=rounding,
        converged=(mode.residual <= mode.tolerance) & known_well,
    )
    latent = GaussianPosterior(covariance @ weights, weights, factor, factor.T @ factor, solved.value, certificate)
    asked = Trials(pivots.points, jnp.zeros(rank, jnp.int32), pivots.carry)
    function = Posterior(OrdinalGP(kernel, OrdinalProbit(model.thresholds, model.noise)), asked, latent)
    return SharedFunction(function, _effects_of(model, system, solved.together, pivots.points, root))


class SharedMoments(NamedTuple):
    """Mean and variance (m,) of g at m points, the random effect, and whether the fit converged, all as by
    `shared_function`."""

    mean: Float[Array, " m"]
    variance: Float[Array, " m"]
    effects: ContextEffects | None
    converged: Bool[Array, ""]


def shared_moments(
    model: PeopleModel, answers: Tallies, start: Float[Array, "M n"], pivots: Pivots, x: Float[Array, "m d"]
) -> SharedMoments:
    """Mean and variance of the shared function g at few points `x` (m, d) of the unit cube.

    What `shared_function` predicts there, to rounding, without an eigendecomposition. Can be traced; never raises.
    """
    solved = _solved(model, answers, start, pivots)
    mode, root, rank = solved.mode, solved.root, len(pivots.points)

    def left(features: Float[Array, "m r"]) -> Float[Array, " m"]:
        return model.shared - model.shared * solved.system.explained_variance(features)

    kernel = model.of_variance(model.shared)
    covariance = gram(kernel, pivots.points, pivots.points)
    at_pivots = jnp.where(pivots.used, left(root / jnp.sqrt(model.shared)), model.shared)
    resolution = jnp.finfo(root.dtype).eps * model.shared * rank**0.5
    rounding = _rounding(model, answers, mode.weights, covariance, solved.weights)
    known_well = evidence_known(solved.value, solved.error, rounding) & (jnp.min(at_pivots) >= resolution)
    return SharedMoments(
        gram(kernel, x, pivots.points) @ solved.weights,
        left(features_of(model.unit, pivots, x[None])[0]),
        _effects_of(model, solved.system, solved.together, pivots.points, root),
        (mode.residual <= mode.tolerance) & known_well,
    )


class _Solved(NamedTuple):
    """Mode and system there; log evidence and its `error`; posterior mean F'a of the weights of g and of the effects
    (`together`); Cholesky factor (r, r) of the covariance of g at the pivots (`root`), and their weights (r,)."""

    mode: Mode
    system: System
    value: Float[Array, ""]
    error: Float[Array, ""]
    together: Float[Array, " p"]
    root: Float[Array, "r r"]
    weights: Float[Array, " r"]


def _solved(model: PeopleModel, answers: Tallies, start: Float[Array, "M n"], pivots: Pivots) -> _Solved:
    """Laplace's method for all responses; arguments as for `shared_function`."""
    prior = prior_of(model, answers, pivots)
    mode = mode_of(model, answers, prior, start)
    value, slope, system = evidence_at(model, answers, prior, mode.weights)
    # One more step changes the evidence by the remaining distance, or more.
    further = mode.weights + newton_step(prior, system, slope - mode.weights)[0]
    error = jnp.abs(evidence_at(model, answers, prior, further).log_evidence - value)

    root = jnp.sqrt(model.shared) * root_of_pivots(model.unit, pivots)
    together = jnp.einsum("jnr,jn->r", prior.features, mode.weights)
    weights = _weights_at(answers, mode.weights, prior.features[..., : len(pivots.points)], pivots, root)
    return _Solved(mode, system, value, error, together, root, weights)


def _weights_at(
    answers: Tallies,
    weights: Float[Array, "M n"],
    features: Float[Array, "M n r"],
    pivots: Pivots,
    root: Float[Array, "r r"],
) -> Float[Array, " r"]:
    """Weights (r,) of the pivots from those of the responses, (M, n): a response at a pivot keeps its own, the others
    are carried over through their `features`. `root`: L of the shared function's covariance.
    """

    def of_person(person, pivots):
        x, weights, features = person
        same = jnp.all(x[:, None] == pivots.points[None], axis=2) & pivots.carry[None]
        elsewhere = jnp.where(jnp.any(same, axis=1), 0.0, weights)
        return weights @ same.astype(weights.dtype), elsewhere @ features

    there, carried = sum_over_people(of_person, (answers.x, weights, features), pivots)
    return there + jnp.where(pivots.used, solve_triangular(root, carried, lower=True, trans=1), 0.0)


def _effects_of(
    model: PeopleModel,
    system: System,
    together: Float[Array, " p"],
    points: Float[Array, "r d"],
    root: Float[Array, "r r"],
) -> ContextEffects | None:
    """Posterior of the random effect; None if the model has none.

    `together` (p,): posterior mean F'a of the weights of g and, after them, of the effects; their covariance is S^-1.
    """
    if model.effect is None:
        return None
    rank, sd = len(points), jnp.sqrt(model.effect)
    covariance = system.covariance()
    return ContextEffects(
        prior=model.effect,
        mean=sd * together[rank:],
        variance=model.effect * jnp.diagonal(covariance)[rank:],
        kernel=model.of_variance(model.shared),
        points=points,
        cross=sd * solve_triangular(root, covariance[:rank, rank:], lower=True, trans=1),
    )


def _rounding(
    model: PeopleModel,
    answers: Tallies,
    weights: Float[Array, "M n"],
    covariance: Float[Array, "r r"],
    of_pivots: Float[Array, " r"],
) -> Float[Array, ""]:
    """Error of the log evidence due to the rounding of the individual covariances and of that of g, a scalar in nats.

    `weights` (M, n): of the responses; `covariance`, `of_pivots`: of the pivots.
    """
    kernel = model.of_variance(model.own)

    def each(people, kernel):
        return jax.lax.map(lambda p: evidence_rounding(gram(kernel, p[0], p[0]), p[1][None, :]), people)

    of_people = of_each_person(each, (answers.x, weights), kernel)
    return jnp.linalg.norm(of_people) + evidence_rounding(covariance, of_pivots[None, :])
