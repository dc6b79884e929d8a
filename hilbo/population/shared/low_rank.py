"""The hierarchical model with a smooth shared function, at a cost that is linear in people.

    f_j = g + h_j,   cov(g) = shared k,   cov(h_j) = own k,   an answer of person j by edges of their own

A smooth g is known from few points: with Z the pivots of an incomplete Cholesky factorisation of k at all answered
points, L L' = k(Z, Z) and the features phi(x) = L^-1 k(Z, x), k(x, y) = phi(x)'phi(y) to an error that the
factorisation states. What is left between two answers of one person is kept, so that only covariances between people
are approximate. All answers then have the covariance

    K = F F' + blockdiag(K_j),   F_j = shared^(1/2) phi(x_j)',   K_j = own k(x_j, x_j) + what F_j F_j' lacks,

a random effect u_c of context c, such as the clip, is one more feature, effect^(1/2) where an answer is of it,

and with W the curvatures, L_j L_j' = I + W_j^(1/2) K_j W_j^(1/2), A_j = L_j^-1 W_j^(1/2) F_j and S = I + sum_j A_j'A_j
every system is solved by blocks of one person's answers and one of r x r: M n^3 + M n^2 r + M n r^2 + r^3 in place of
(M n)^3. S is the posterior precision of the weights of g, g(x) = shared^(1/2) phi(x)'w.

Laplace's method by Newton's steps, halved where the log posterior would fall. The evidence has exact first derivatives,
by the implicit function theorem at the mode. References: Rasmussen & Williams (2006), sections 3.4 and 5.5.1;
Snelson & Ghahramani (2007), AISTATS, for what is kept within a block; Harbrecht, Peters & Schneider (2012), Applied
Numerical Mathematics 62:428, for the factorisation.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float, Int

from hilbo.kernels import gram
from hilbo.likelihoods import OrdinalProbit
from hilbo.population.shared.features import Pivots, features_of
from hilbo.population.shared.people_model import PeopleModel
from hilbo.population.shared.tallies import Expansion, Tallies, expand_counts

__all__ = [
    "LowRankPrior",
    "Mode",
    "SharedEvidence",
    "System",
    "evidence_at",
    "mode_of",
    "prior_of",
    "shared_evidence",
    "system_at",
]

_STEPS, _HALVINGS = 60, 40


# --- the prior, and what answers make of it


class LowRankPrior(NamedTuple):
    """K = F F' + blockdiag(K_j)."""

    features: Float[Array, "M n r"]
    blocks: Float[Array, "M n n"]

    def times(self, weights: Float[Array, "M n"]) -> Float[Array, "M n"]:
        """K a."""
        together = jnp.einsum("jnr,jn->r", self.features, weights)
        return self.features @ together + jnp.einsum("jnm,jm->jn", self.blocks, weights)


class System(NamedTuple):
    root: Float[Array, "M n"]  # W^(1/2)
    lower: Float[Array, "M n n"]  # L_j
    half: Float[Array, "M n r"]  # A_j
    precision: Float[Array, "r r"]  # S
    factor: Float[Array, "r r"]  # its triangular factor
    log_determinant: Float[Array, ""]  # log |I + K W|

    def solve(self, right: Float[Array, "M n"]) -> Float[Array, "M n"]:
        """(K + W^-1)^-1 y, which needs no W^-1."""
        first = jax.lax.map(lambda p: solve_triangular(p[0], p[1], lower=True), (self.lower, self.root * right))
        together = jax.scipy.linalg.cho_solve((self.factor, True), jnp.einsum("jnr,jn->r", self.half, first))
        rest = first - self.half @ together
        return self.root * jax.lax.map(lambda p: solve_triangular(p[0], p[1], lower=True, trans=1), (self.lower, rest))


def prior_of(model: PeopleModel, answers: Tallies, pivots: Pivots) -> LowRankPrior:
    kernel = model.unit
    unit = features_of(kernel, pivots, answers.x)

    def block(person):
        x, own_features = person
        covariance = gram(kernel, x, x)
        return model.own * covariance + model.shared * (covariance - own_features @ own_features.T)

    features = jnp.sqrt(model.shared) * unit
    if model.effect is not None:
        of_context = jax.nn.one_hot(answers.context, answers.contexts, dtype=unit.dtype)
        features = jnp.concatenate([features, jnp.sqrt(model.effect) * of_context], axis=-1)
    return LowRankPrior(features, jax.lax.map(block, (answers.x, unit)))


def system_at(prior: LowRankPrior, curvature: Float[Array, "M n"]) -> System:
    answered = curvature > 0
    root = jnp.where(answered, jnp.sqrt(jnp.where(answered, curvature, 1.0)), 0.0)
    unit = jnp.eye(root.shape[1], dtype=root.dtype)

    def person(block, features, root):
        lower = jnp.linalg.cholesky(unit + root[:, None] * block * root[None, :])
        return lower, solve_triangular(lower, root[:, None] * features, lower=True)

    lower, half = jax.lax.map(lambda p: person(*p), (prior.blocks, prior.features, root))
    flat = half.reshape(-1, half.shape[2])
    precision = jnp.eye(half.shape[2], dtype=root.dtype) + flat.T @ flat
    factor = jnp.linalg.cholesky(precision)
    logs = jnp.sum(jnp.log(jnp.diagonal(lower, axis1=1, axis2=2))) + jnp.sum(jnp.log(jnp.diagonal(factor)))
    return System(root, lower, half, precision, factor, 2.0 * logs)


def _expand(model: PeopleModel, answers: Tallies, eta: Float[Array, "M n"]) -> Expansion:
    """Log-likelihood terms, slopes and curvatures of everybody's answers."""

    def person(thresholds, counts, eta):
        return jax.vmap(partial(expand_counts, OrdinalProbit(thresholds, model.noise)))(eta, counts)

    return jax.vmap(person)(model.person_thresholds, answers.counts, eta)


# --- the mode


class Mode(NamedTuple):
    weights: Float[Array, "M n"]
    further: Float[Array, "M n"]
    """Where one more of Newton's steps ends."""
    residual: Float[Array, ""]
    tolerance: Float[Array, ""]
    steps: Int[Array, ""]


def _newton_step(
    prior: LowRankPrior, system: System, slope: Float[Array, "M n"], weights: Float[Array, "M n"]
) -> Float[Array, "M n"]:
    """a + r - (K + W^-1)^-1 K r, r = slope - a: an error of the step is one of r's size. `system` and `slope`, of the
    log-likelihood, are those at the weights."""
    off = slope - weights
    return weights + off - system.solve(prior.times(off))


class _Height(NamedTuple):
    """The log posterior at some weights, the size of its terms, and how far off the weights are."""

    value: Float[Array, ""]
    size: Float[Array, ""]
    residual: Float[Array, ""]
    tolerance: Float[Array, ""]


class _Search(NamedTuple):
    """The highest weights so far, and what is tried next: a part of the way to where Newton's step ends."""

    weights: Float[Array, "M n"]
    height: _Height
    steps: Int[Array, ""]
    full: Float[Array, "M n"]  # where Newton's step ends
    part: Float[Array, ""]  # of the way there


def _height(
    prior: LowRankPrior, sizes: LowRankPrior, terms: Expansion, eta: Float[Array, "M n"], weights: Float[Array, "M n"]
) -> _Height:
    """`sizes`: of the numbers of the prior, because latent values are sums whose terms may cancel."""
    epsilon = jnp.finfo(weights.dtype).eps
    absolute = sizes.times(jnp.abs(weights))
    value = jnp.sum(terms.value) - 0.5 * jnp.sum(weights * eta)
    size = jnp.sum(jnp.abs(terms.value)) + 0.5 * jnp.sum(jnp.abs(weights) * absolute)
    off = terms.slope - weights
    summed = terms.slopes + terms.curvature * absolute + jnp.abs(weights)
    residual, rounding = (
        jnp.sqrt(jnp.linalg.norm(vector) * jnp.linalg.norm(prior.times(vector))) for vector in (off, summed)
    )
    tolerance = jnp.clip(4.0 * epsilon * rounding, epsilon ** (2 / 3), epsilon**0.25)
    return _Height(value, size, residual, tolerance)


def mode_of(model: PeopleModel, answers: Tallies, prior: LowRankPrior, start: Float[Array, "M n"]) -> Mode:
    """Newton's steps on the weights, from `start`, each halved until the log posterior does not fall; the residual is
    that of `laplace`. The likelihood is expanded at one place of the program, because each place takes time to compile:
    the start is evaluated as a first step, from a log posterior of minus infinity."""
    epsilon, sizes = jnp.finfo(start.dtype).eps, jax.tree.map(jnp.abs, prior)

    def going(search):
        here = search.height
        return (here.residual > here.tolerance) & (search.steps < _STEPS) & (search.part > 0.5 ** (_HALVINGS + 1))

    def forward(search):
        weights, here, steps, full, part = search
        trial = jnp.where(part == 1.0, full, weights + part * (full - weights))
        eta = prior.times(trial)
        terms = _expand(model, answers, eta)
        reached = _height(prior, sizes, terms, eta, trial)
        not_below = reached.value >= here.value - 8.0 * epsilon * here.size
        weights, here, part, steps = jax.tree.map(
            lambda new, old: jnp.where(not_below, new, old),
            (trial, reached, jnp.ones_like(part), steps + 1),
            (weights, here, 0.5 * part, steps),
        )
        full = jax.lax.cond(
            not_below,
            lambda: _newton_step(prior, system_at(prior, terms.curvature), terms.slope, trial),
            lambda: full,
        )
        return _Search(weights, here, steps, full, part)

    infinite = jnp.full_like(start[0, 0], jnp.inf)
    nowhere = _Height(-infinite, jnp.zeros_like(infinite), infinite, jnp.zeros_like(infinite))
    begin = _Search(start, nowhere, jnp.asarray(-1), start, jnp.ones_like(infinite))
    end = jax.lax.while_loop(going, forward, begin)
    return Mode(end.weights, end.full, end.height.residual, end.height.tolerance, end.steps)


class SharedEvidence(NamedTuple):
    """Laplace's log evidence of all answers, and how it was found."""

    value: Float[Array, ""]
    weights: Float[Array, "M n"]
    """Near which the mode of similar hyperparameters is."""
    arrived: Bool[Array, ""]


def shared_evidence(model: PeopleModel, answers: Tallies, start: Float[Array, "M n"], pivots: Pivots) -> SharedEvidence:
    """Log evidence of all answers, differentiable once in `model`.

    **Arguments:** `start`: weights near which the mode is sought; `pivots`: of g, which stay where they are when the
    model moves. With others the value changes in a small step, which differences and searches must not be taken across.
    """
    still = jax.lax.stop_gradient
    prior = prior_of(model, answers, still(pivots))
    mode = still(mode_of(still(model), answers, still(prior), start))
    value = _evidence_at_mode(model, answers, prior, mode.further)
    arrived = (mode.residual <= mode.tolerance) & jnp.isfinite(value)
    return SharedEvidence(value, mode.weights, arrived)


def evidence_at(
    model: PeopleModel, answers: Tallies, prior: LowRankPrior, weights: Float[Array, "M n"]
) -> tuple[Float[Array, ""], System]:
    """The log evidence at some weights, and the system there."""
    eta = prior.times(weights)
    terms = _expand(model, answers, eta)
    system = system_at(prior, terms.curvature)
    return jnp.sum(terms.value) - 0.5 * jnp.sum(weights * eta) - 0.5 * system.log_determinant, system


@jax.custom_vjp
def _evidence_at_mode(
    model: PeopleModel, answers: Tallies, prior: LowRankPrior, weights: Float[Array, "M n"]
) -> Float[Array, ""]:
    """`evidence_at` at the mode's weights, which follow model and prior. Differentiable once, in these two."""
    return evidence_at(model, answers, prior, weights)[0]


def _evidence_forward(model: PeopleModel, answers: Tallies, prior: LowRankPrior, weights: Float[Array, "M n"]):
    value, pull, system = jax.vjp(lambda *at: evidence_at(at[0], answers, *at[1:]), model, prior, weights, has_aux=True)
    return value, (pull, system, model, answers, prior, weights)


def _evidence_backward(kept, slope: Float[Array, ""]):
    """The mode solves slope(K a) - a = 0, so that da = (I + W K)^-1 d slope. With g the derivative in the weights, what
    moves with the mode is (I + K W)^-1 g times d slope, and (I + K W)^-1 = I - K (K + W^-1)^-1."""
    pull, system, model, answers, prior, weights = kept
    of_model, of_prior, of_weights = pull(slope)
    adjoint = of_weights - prior.times(system.solve(of_weights))
    slopes = jax.vjp(lambda model, prior: _expand(model, answers, prior.times(weights)).slope, model, prior)[1]
    of_model, of_prior = jax.tree.map(jnp.add, (of_model, of_prior), slopes(adjoint))
    return of_model, None, of_prior, None


_evidence_at_mode.defvjp(_evidence_forward, _evidence_backward)
