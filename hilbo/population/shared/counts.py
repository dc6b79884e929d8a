"""The hierarchical model of people who answered at the same points, from counts of their answers: exact and cheap.

    f_j = g + h_j,   cov(g) = p k,   cov(h_j) = (1 - p) k            (see `hierarchical`)

Answers at one point are a sum of log-likelihood terms of one latent value, so that only how often each category was
chosen counts. With m points in all, M people, K the prior covariance of the points, W_j person j's curvatures and

    D_j = ((1 - p) K + W_j^-1)^-1,      S = sum_j D_j = L L',      V = chol(I + p L'K L)^-1 L',

people are independent given g, so that what all answers say of g is a factor V of m x m: the posterior of g has the
precision-like matrix V'V = (S^-1 + p K)^-1 at the covariance p K, and log|I + K_all W| is the sum of the people's
log|I + (1 - p) K W_j| and log|I + p L'K L|. The cost is M m^3 in place of (M m)^3. The posterior of g is a `Posterior`
like any other, of a prior p times as large; a new person's function has (1 - p) k more variance.

Laplace's method by Newton's steps, halved where the log posterior would fall; the certificate says whether they
arrived. The evidence has exact first derivatives: a last step from the mode, whose derivative in its start
is 0 there. Reference: Rasmussen & Williams (2006), sections 3.4 and 5.5.1.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hilbo.errors import InputError
from hilbo.gaussian import Certificate, GaussianPosterior, evidence_known, evidence_rounding, evidence_tolerance
from hilbo.kernels import gram
from hilbo.likelihoods import OrdinalProbit
from hilbo.numerics.host import to_device
from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import OrdinalGP, Posterior, Trials
from hilbo.population.shared.tallies import Expansion, expand_counts

__all__ = ["Counts", "counts_of", "evidence", "fit_counts", "one_person"]

_STEPS = 50
_HALVINGS = 6


class Counts(eqx.Module):
    """How often M people chose each of C categories at m points of the unit cube."""

    x: Float[Array, "m d"]
    counts: Float[Array, "M m C"]

    @property
    def people(self) -> int:
        """Of the M those who gave answers."""
        return int(np.count_nonzero(np.asarray(self.counts).any(axis=(1, 2))))

    def of(self, rows) -> "Counts":
        """Only these people; the points stay."""
        return Counts(self.x, self.counts[rows])


def counts_of(trials: Trials, categories: int) -> Counts:
    """Counts at the distinct points of stacked trials (M, n)."""
    mask = np.asarray(trials.mask)
    if not mask.any():
        raise InputError("counts: nobody gave an answer; at least one person's answers are needed.")
    x, q = np.asarray(trials.x)[mask], np.asarray(trials.q)[mask]
    points, place = np.unique(x, axis=0, return_inverse=True)
    person = np.broadcast_to(np.arange(len(mask))[:, None], mask.shape)[mask]
    counts = np.zeros((len(mask), len(points), categories), points.dtype)
    np.add.at(counts, (person, place.reshape(-1), q), 1.0)
    return Counts(to_device(points), to_device(counts))


def one_person(answers: Counts) -> Counts:
    """The same answers as if the first person had given them all: the pooled model's, whatever the share. The others
    keep their rows without answers, so that it is fitted by the same program."""
    counts = np.asarray(answers.counts)
    pooled = np.zeros_like(counts)
    pooled[0] = counts.sum(axis=0)
    return Counts(answers.x, to_device(pooled))


@program
def fit_counts(gp: OrdinalGP, share: Float[Array, ""], answers: Counts) -> Posterior:
    """Posterior of the shared function g, whose prior variance is `share` in [0, 1] times that of `gp`.

    Its log evidence is that of all answers. Never raises: read `certificate.converged`.
    """
    covariance = gram(gp.kernel, answers.x, answers.x)
    mode, residual, steps = _mode(gp.likelihood, share, covariance, answers.counts)
    terms = _expand(gp.likelihood, answers.counts, mode.eta)
    system = _system(share, covariance, terms.curvature)
    weights, shared = jnp.sum(mode.weights, axis=0), share * covariance
    prior, explained = jnp.diagonal(shared), jnp.sum((system.factor @ shared) ** 2, axis=0)
    smallest, largest = jnp.min(prior - explained), jnp.max(jnp.diagonal(covariance))
    resolution = jnp.finfo(prior.dtype).eps * largest * prior.shape[0] ** 0.5
    value = _log_evidence(terms, mode, system)
    tolerance = _tolerance(share, covariance, terms, mode.weights)
    # One step more would change the evidence by so much; what is left is of the size of that change or smaller.
    last = _newton_step(gp.likelihood, share, covariance, answers.counts, mode)
    beyond = _expand(gp.likelihood, answers.counts, last.eta)
    error = jnp.abs(_log_evidence(beyond, last, _system(share, covariance, beyond.curvature)) - value)
    every = jnp.concatenate([share**0.5 * weights[None, :], (1.0 - share) ** 0.5 * mode.weights])
    rounding = evidence_rounding(covariance, every)
    certificate = Certificate(
        residual=residual,
        tolerance=tolerance,
        iterations=steps,
        jitter=jnp.zeros_like(residual),
        condition=system.condition,
        smallest_variance=smallest,
        variance_resolution=resolution,
        evidence_error=error,
        evidence_tolerance=evidence_tolerance(value),
        evidence_rounding=rounding,
        converged=(residual <= tolerance) & evidence_known(value, error, rounding) & (smallest >= resolution),
    )
    inverse = system.factor.T @ system.factor
    latent = GaussianPosterior(shared @ weights, weights, system.factor, inverse, value, certificate)
    size = answers.x.shape[0]
    held = Trials(answers.x, jnp.zeros(size, jnp.int32), jnp.ones(size, bool))
    kernel = gp.kernel
    return Posterior(OrdinalGP(kernel.with_numbers(kernel.theta, share * kernel.variance), gp.likelihood), held, latent)


def evidence(gp: OrdinalGP, share: Float[Array, ""], answers: Counts) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """Log evidence of all answers, differentiable once in `gp` and in `share` in [0, 1]; and whether the mode was
    found."""
    covariance = gram(gp.kernel, answers.x, answers.x)
    fixed = jax.lax.stop_gradient((gp.likelihood, share, covariance))
    mode, residual, _ = _mode(*fixed, answers.counts)
    mode = jax.lax.stop_gradient(mode)
    last = _newton_step(gp.likelihood, share, covariance, answers.counts, mode)
    terms = _expand(gp.likelihood, answers.counts, last.eta)
    at_mode = _expand(fixed[0], answers.counts, mode.eta)
    arrived = residual <= _tolerance(*fixed[1:], at_mode, mode.weights)
    return _log_evidence(terms, last, _system(share, covariance, terms.curvature)), arrived


# --- the mode


class _State(NamedTuple):
    weights: Float[Array, "M m"]
    eta: Float[Array, "M m"]


class _System(NamedTuple):
    """What the curvatures make of the prior."""

    person_factors: Float[Array, "M m m"]  # triangular factors of I + (1 - p) W^(1/2) K W^(1/2)
    root: Float[Array, "M m"]  # W^(1/2)
    sum_root: Float[Array, "m m"]  # L, with L L' = S
    answered: Bool[Array, " m"]
    lower: Float[Array, "m m"]  # the triangular factor of I + p L'K L
    factor: Float[Array, "m m"]  # V
    log_determinant: Float[Array, ""]
    condition: Float[Array, ""]


def _tolerance(
    share: Float[Array, ""], covariance: Float[Array, "m m"], terms: Expansion, weights: Float[Array, "M m"]
) -> Float[Array, ""]:
    """eps^(2/3), or the rounding error of the residual where that is larger, as in `laplace`."""
    epsilon = jnp.finfo(covariance.dtype).eps
    size = jnp.abs(weights)
    summed = terms.slopes + terms.curvature * _latent(share, jnp.abs(covariance), size) + size
    rounding = jnp.linalg.norm(summed) * jnp.linalg.norm(_latent(share, covariance, summed))
    return jnp.clip(4.0 * epsilon * jnp.sqrt(rounding), epsilon ** (2 / 3), epsilon**0.25)


def _latent(
    share: Float[Array, ""], covariance: Float[Array, "m m"], weights: Float[Array, "M m"]
) -> Float[Array, "M m"]:
    """Prior covariance times weights: everybody's latent values (M, m)."""
    together = share * jnp.sum(weights, axis=0)
    return (together[None, :] + (1.0 - share) * weights) @ covariance


class _Place(NamedTuple):
    """Where the search stands: the likelihood is expanded there once, for all that is asked of it."""

    state: _State
    height: Float[Array, ""]  # log posterior
    size: Float[Array, ""]  # of what it is a sum of, by which its rounding is judged
    residual: Float[Array, ""]
    tolerance: Float[Array, ""]


def _mode(
    likelihood: OrdinalProbit, share: Float[Array, ""], covariance: Float[Array, "m m"], counts: Float[Array, "M m C"]
) -> tuple[_State, Float[Array, ""], Int[Array, ""]]:
    """Full Newton steps on the weights from 0; the mode, its distance from stationarity, and the steps taken."""

    def evaluated(state):
        terms = _expand(likelihood, counts, state.eta)
        value, off = jnp.sum(terms.value), terms.slope - state.weights
        residual = jnp.sqrt(jnp.linalg.norm(off) * jnp.linalg.norm(_latent(share, covariance, off)))
        tolerance = _tolerance(share, covariance, terms, state.weights)
        return _Place(state, value - 0.5 * jnp.sum(state.weights * state.eta), jnp.abs(value), residual, tolerance)

    def forward(carry):
        current, steps = carry
        full = _newton_step(likelihood, share, covariance, counts, current.state)
        return _damped(evaluated, current, full), steps + 1

    def going(carry):
        current, steps = carry
        return (current.residual > current.tolerance) & (steps < _STEPS)

    start = jnp.zeros(counts.shape[:2], covariance.dtype)
    current, steps = jax.lax.while_loop(going, forward, (evaluated(_State(start, start)), jnp.asarray(0)))
    return current.state, current.residual, steps


def _newton_step(
    likelihood: OrdinalProbit,
    share: Float[Array, ""],
    covariance: Float[Array, "m m"],
    counts: Float[Array, "M m C"],
    state: _State,
) -> _State:
    """a <- a + (I + W K)^-1 r, r = slope - a, of all people by way of g: an error of the step is one of r's size."""
    eta = _latent(share, covariance, state.weights)  # not state.eta: derivatives come through here
    terms = _expand(likelihood, counts, eta)
    system = _system(share, covariance, terms.curvature)
    off = terms.slope - state.weights
    person_terms = _solve_people(system, _latent(share, covariance, off))
    # (S + (p K)^-1)^-1 s = p K L (I + p L'K L)^-1 L^-1 s: nothing is subtracted
    solve = jax.scipy.linalg.solve_triangular
    shared_term = solve(
        system.sum_root + jnp.diag(jnp.where(system.answered, 0.0, 1.0)), jnp.sum(person_terms, axis=0), lower=True
    )
    moved = share * covariance @ (system.factor.T @ solve(system.lower, shared_term, lower=True))
    weights = (
        state.weights + off - person_terms + _solve_people(system, jnp.broadcast_to(moved[None, :], person_terms.shape))
    )
    return _State(weights, _latent(share, covariance, weights))


def _damped(evaluated: Callable[[_State], _Place], current: _Place, full: _State) -> _Place:
    """The largest of a few shares of a step at which the log posterior has not fallen, beyond its rounding."""

    def between(scale):
        return jax.tree.map(lambda a, b: jnp.where(scale == 1.0, b, a + scale * (b - a)), current.state, full)

    def fallen(carry):
        candidate, scale = carry
        slack = 8.0 * jnp.finfo(candidate.size.dtype).eps * (current.size + candidate.size)
        return (candidate.height < current.height - slack) & (scale > 0.5 ** (_HALVINGS - 1))

    def halved(carry):
        scale = 0.5 * carry[1]
        return evaluated(between(scale)), scale

    # The whole step is tried first and is nearly always taken; the others wait until it is not.
    return jax.lax.while_loop(fallen, halved, (evaluated(full), jnp.ones_like(current.height)))[0]


def _solve_people(system: _System, right: Float[Array, "M m"]) -> Float[Array, "M m"]:
    """D_j r_j for everybody, (M, m)."""

    def solved(lower, root, r):
        solve = jax.scipy.linalg.solve_triangular
        return root * solve(lower, solve(lower, root * r, lower=True), lower=True, trans=1)

    def one(person):
        return jax.lax.cond(jnp.any(person[1] > 0), solved, lambda lower, root, r: jnp.zeros_like(r), *person)

    return jax.lax.map(one, (system.person_factors, system.root, right))


def _system(share: Float[Array, ""], covariance: Float[Array, "m m"], curvature: Float[Array, "M m"]) -> _System:
    """Factors of everybody's (1 - p) K + W_j^-1, and of what all people add up to."""
    size = covariance.shape[0]
    unit = jnp.eye(size, dtype=covariance.dtype)
    held = curvature > 0
    root = jnp.where(held, jnp.sqrt(jnp.where(held, curvature, 1.0)), 0.0)

    def added(total, root):
        lower = jnp.linalg.cholesky(unit + (1.0 - share) * root[:, None] * covariance * root[None, :])
        half = jax.scipy.linalg.solve_triangular(lower, jnp.diag(root), lower=True)
        return total + half.T @ half, lower

    def add(total, root):  # who gave no answers adds nothing
        return jax.lax.cond(jnp.any(root > 0), added, lambda total, root: (total, unit), total, root)

    total, person_factors = jax.lax.scan(add, jnp.zeros_like(covariance), root)
    answered = jnp.any(held, axis=0)  # a point at which nobody answered stands apart from the rest
    sum_root = jnp.linalg.cholesky(total + jnp.diag(jnp.where(answered, 0.0, 1.0)))
    sum_root = jnp.where(answered[:, None], sum_root, 0.0)
    matrix = unit + share * sum_root.T @ covariance @ sum_root
    lower = jnp.linalg.cholesky(matrix)
    factor = jax.scipy.linalg.solve_triangular(lower, sum_root.T, lower=True)
    of_people = jnp.sum(jnp.log(jnp.diagonal(person_factors, axis1=1, axis2=2)))
    log_determinant = 2.0 * (of_people + jnp.sum(jnp.log(jnp.diagonal(lower))))
    return _System(person_factors, root, sum_root, answered, lower, factor, log_determinant, jnp.linalg.norm(matrix))


def _expand(likelihood: OrdinalProbit, counts: Float[Array, "M m C"], eta: Float[Array, "M m"]) -> Expansion:
    """Sums of log-likelihood terms, slopes and curvatures at everybody's latent values (M, m)."""

    one = partial(expand_counts, likelihood)
    return jax.vmap(jax.vmap(one))(eta, counts)


def _log_evidence(terms: Expansion, state: _State, system: _System) -> Float[Array, ""]:
    """Laplace's approximation: log likelihood and log prior at the mode, less half of log|I + K_all W|."""
    return jnp.sum(terms.value) - 0.5 * jnp.sum(state.weights * state.eta) - 0.5 * system.log_determinant
