"""The hierarchical model with a smooth shared function, at a cost that is linear in participants.

    f_j = g + h_j,   cov(g) = shared k,   cov(h_j) = own k,   a response of participant j by individual thresholds

A smooth g is known from few points: with Z the pivots of an incomplete Cholesky factorisation of k at all tested
points, L L' = k(Z, Z) and the features phi(x) = L^-1 k(Z, x), k(x, y) = phi(x)'phi(y) up to an error that the
factorisation returns. The remainder between two responses of one participant is kept, so that only covariances between
participants are approximate. All responses then have the covariance

    K = F F' + blockdiag(K_j),   F_j = shared^(1/2) phi(x_j)',   K_j = own k(x_j, x_j) + what F_j F_j' lacks,

a random effect u_c of context c, such as the clip, is one more feature, effect^(1/2) for responses in that context,

and with W the curvatures, L_j L_j' = I + W_j^(1/2) K_j W_j^(1/2), A_j = L_j^-1 W_j^(1/2) F_j and S = I + sum_j A_j'A_j
every system is solved by blocks of one participant's responses and one of r x r: M n^3 + M n^2 r + M n r^2 + r^3 in
place of (M n)^3 (`system`). S is the posterior precision of the weights of g, g(x) = shared^(1/2) phi(x)'w.

Laplace's method by Newton's steps (`hilbo.newton_steps`). The evidence has exact first derivatives, by the implicit
function theorem at the mode. References: Rasmussen & Williams (2006), sections 3.4 and 5.5.1; Snelson & Ghahramani
(2007), AISTATS, for the exact blocks; Harbrecht, Peters & Schneider (2012), Applied Numerical Mathematics 62:428, for
the factorisation.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from hilbo.gaussian import distance, residual_tolerance
from hilbo.numerics.sharding import of_each_person
from hilbo.population.shared.features import Pivots
from hilbo.population.shared.people_model import PeopleModel
from hilbo.population.shared.scale_use import of_person
from hilbo.population.shared.system import LowRankPrior, System, prior_of, system_at
from hilbo.population.shared.tallies import Expansion, Tallies, expand_counts

__all__ = ["AtWeights", "Mode", "SharedEvidence", "evidence_at", "mode_of", "newton_step", "shared_evidence"]

_STEPS = 100


def _expand(model: PeopleModel, answers: Tallies, eta: Float[Array, "M n"]) -> Expansion:
    """Log-likelihood terms of all participants' responses, their slopes and curvatures at latent values `eta` (M,
    n).
    """

    def each(some, likelihood, fixed_point):
        def person(log_width, log_sensitivity, counts, eta):
            own = of_person(likelihood, log_width, log_sensitivity, fixed_point)
            return jax.vmap(partial(expand_counts, own))(eta, counts)

        return jax.vmap(person)(*some)

    people = model.log_widths, model.log_sensitivities, answers.counts, eta
    return of_each_person(each, people, model.likelihood, model.fixed_point)


# --- the mode


class Mode(NamedTuple):
    """Weights (M, n) at the mode, residual and its tolerance, and number of steps; converged if residual <=
    tolerance.
    """

    weights: Float[Array, "M n"]
    residual: Float[Array, ""]
    tolerance: Float[Array, ""]
    steps: Int[Array, ""]


class _OfWeights(eqx.Module):
    """Log posterior as a function of the weights a (M, n), with which the latent values are K a; an `Ascent`."""

    model: PeopleModel
    answers: Tallies
    prior: LowRankPrior

    def at(self, weights: Float[Array, "M n"]) -> tuple[PyTree, Expansion]:
        """Height at `weights` (M, n), with the residual as in `laplace`; and the log-likelihood terms there."""
        from hilbo.newton_steps import Height  # imports optimistix, which is slow

        prior = self.prior
        eta = prior.times(weights)
        terms = _expand(self.model, self.answers, eta)
        # Latent values are sums whose terms may cancel: their rounding errors do not.
        epsilon, absolute = jnp.finfo(weights.dtype).eps, jax.tree.map(jnp.abs, prior).times(jnp.abs(weights))
        off = terms.slope - weights
        summed = terms.slopes + terms.curvature * absolute + jnp.abs(weights)
        size = jnp.sum(jnp.abs(terms.value)) + jnp.sum((0.5 * jnp.abs(weights) + terms.slopes) * absolute)
        height = Height(
            objective=jnp.sum(terms.value) - 0.5 * jnp.sum(weights * eta),
            rounding=4.0 * epsilon * size,
            residual=distance(off, prior.times(off)),
            tolerance=residual_tolerance(distance(summed, prior.times(summed))),
        )
        return height, terms

    def towards(self, weights: Float[Array, "M n"], terms: Expansion) -> tuple[Float[Array, "M n"], Float[Array, ""]]:
        """Newton step from `weights` (M, n), and the slope of the log posterior along it; `terms` as from `at`."""
        return newton_step(self.prior, system_at(self.prior, terms.curvature), terms.slope - weights)


def newton_step(
    prior: LowRankPrior, system: System, off: Float[Array, "M n"]
) -> tuple[Float[Array, "M n"], Float[Array, ""]]:
    """Newton step r - (K + W^-1)^-1 K r (M, n), and the slope of the log posterior along it, a scalar.

    `off`: r = slope - a, (M, n). In this form an error of the step is relative to the size of r.
    """
    moved = prior.times(off)
    step = off - system.solve(moved)
    return step, jnp.sum(moved * step)


def mode_of(model: PeopleModel, answers: Tallies, prior: LowRankPrior, start: Float[Array, "M n"]) -> Mode:
    """Search for the mode by at most 100 damped Newton steps on the weights, from `start` (M, n). Never raises."""
    from hilbo.newton_steps import climbed  # imports optimistix, which is slow

    weights, height, steps = climbed(_OfWeights(model, answers, prior), start, _STEPS)
    return Mode(weights, height.residual, height.tolerance, steps)


class SharedEvidence(NamedTuple):
    """Laplace's log evidence of all responses, a scalar in nats; the weights (M, n) at the mode; and whether the search
    converged.
    """

    value: Float[Array, ""]
    weights: Float[Array, "M n"]
    """Near which the mode of similar hyperparameters is."""
    arrived: Bool[Array, ""]


def shared_evidence(model: PeopleModel, answers: Tallies, start: Float[Array, "M n"], pivots: Pivots) -> SharedEvidence:
    """Laplace's log evidence of all responses, differentiable once in `model`. Never raises: read `arrived`.

    **Arguments:** `start` (M, n): weights from which the mode is searched; `pivots`: of g, constant when the model
    changes. With other pivots the value changes in a small step, so that differences of values need equal ones.
    """
    still = jax.lax.stop_gradient
    prior = prior_of(model, answers, still(pivots))
    mode = still(mode_of(still(model), answers, still(prior), start))
    value = _evidence_at_mode(model, answers, prior, mode.weights)
    arrived = (mode.residual <= mode.tolerance) & jnp.isfinite(value)
    return SharedEvidence(value, mode.weights, arrived)


class AtWeights(NamedTuple):
    """Log evidence at given weights; slopes (M, n) of the log-likelihood, and the system of Newton's steps there."""

    log_evidence: Float[Array, ""]
    slope: Float[Array, "M n"]
    system: System


def evidence_at(model: PeopleModel, answers: Tallies, prior: LowRankPrior, weights: Float[Array, "M n"]) -> AtWeights:
    """Laplace's log evidence with the given `weights` (M, n) in place of the mode's."""
    eta = prior.times(weights)
    terms = _expand(model, answers, eta)
    system = system_at(prior, terms.curvature)
    value = jnp.sum(terms.value) - 0.5 * jnp.sum(weights * eta) - 0.5 * system.log_determinant
    return AtWeights(value, terms.slope, system)


@jax.custom_vjp
def _evidence_at_mode(
    model: PeopleModel, answers: Tallies, prior: LowRankPrior, weights: Float[Array, "M n"]
) -> Float[Array, ""]:
    """Laplace's log evidence at the mode, whose `weights` (M, n) are given. Differentiable once, in model and prior;
    the derivative takes into account that the mode moves with them.
    """
    return evidence_at(model, answers, prior, weights).log_evidence


def _evidence_forward(model: PeopleModel, answers: Tallies, prior: LowRankPrior, weights: Float[Array, "M n"]):
    """Log evidence, and what `_evidence_backward` needs."""

    def value(*at):
        end = evidence_at(at[0], answers, *at[1:])
        return end.log_evidence, end.system

    log_evidence, pull, system = jax.vjp(value, model, prior, weights, has_aux=True)
    return log_evidence, (pull, system, model, answers, prior, weights)


def _evidence_backward(kept, slope: Float[Array, ""]):
    """Derivatives of the log evidence in model and prior times `slope`; None for the other two arguments.

    The mode solves slope(K a) - a = 0, so that da = (I + W K)^-1 d slope. With g the derivative in the weights, what
    moves with the mode is (I + K W)^-1 g times d slope, and (I + K W)^-1 = I - K (K + W^-1)^-1.
    """
    pull, system, model, answers, prior, weights = kept
    of_model, of_prior, of_weights = pull(slope)
    adjoint = of_weights - prior.times(system.solve(of_weights))
    slopes = jax.vjp(lambda model, prior: _expand(model, answers, prior.times(weights)).slope, model, prior)[1]
    of_model, of_prior = jax.tree.map(jnp.add, (of_model, of_prior), slopes(adjoint))
    return of_model, None, of_prior, None


_evidence_at_mode.defvjp(_evidence_forward, _evidence_backward)
