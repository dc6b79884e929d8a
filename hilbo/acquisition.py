"""Acquisition functions for trial selection: scores of candidate stimuli, and their maximisation over a search space.

A score takes the posterior mean and variance of f at one point. The next stimulus maximises it over a candidate set and
is then refined by Newton's method in the optimiser's coordinates, in which the feasible set is a cube.

    UCB (paper, section IV-3):   mu + weight * sigma
    log expected improvement:    log( sigma * h((mu - best) / sigma) ),  h(z) = phi(z) + z Phi(z)
    top category:                log P(highest response) = log Phi((mu - t) / sqrt(noise^2 + sigma^2))
    Thompson:                    the maximum of one draw of f over the candidates

For a goal other than the highest response, UCB, log expected improvement and Thompson's draw use the closeness to it
(`Goal`) in place of mu or f. Between other responses UCB is then the straddle criterion of Bryan et al. (2005), NIPS
18:163.

Log expected improvement after Ament et al. (2023), arXiv:2310.20708: without the logarithm it is 0, and flat, wherever
an improvement is unlikely.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from hilbo.likelihoods import Goal, OrdinalProbit
from hilbo.numerics.climbing import Choice, climb, spread
from hilbo.numerics.linalg import eigh
from hilbo.numerics.normal import HALF_LOG_2PI, excess_hazard

__all__ = ["UCB", "InCategory", "LogEI", "Score", "TopCategory", "TowardsGoal", "maximise", "thompson"]


def __dir__() -> list[str]:
    return __all__


Score = Callable[[Float[Array, ""], Float[Array, ""]], Float[Array, ""]]
"""Posterior mean and variance at a point -> score of testing that point."""


class UCB(eqx.Module):
    """Upper confidence bound, mean + weight * sd."""

    weight: Float[Array, ""] = eqx.field(converter=jnp.asarray, default=0.7)

    def __call__(self, mean, variance):
        """Score of posterior `mean` and `variance`, arrays of one shape, which is also the result's; NaN for a negative
        variance.
        """
        return mean + self.weight.astype(mean.dtype) * jnp.sqrt(variance)

    def optimistic(self, mean: Float[Array, "..."], prior: Float[Array, ""]) -> Float[Array, "..."]:
        """Upper bound of the score given the posterior mean, for every variance up to the `prior` variance; mean's
        shape.

        Valid for a `weight` that is not negative.
        """
        return self(mean, prior)


class LogEI(eqx.Module):
    """Logarithm of the expected improvement over `best`, usually the largest posterior mean among the tested points.

    Where the variance is 0 the improvement is certain: log(mean - best), and -inf if it is not positive.
    """

    best: Float[Array, ""] = eqx.field(converter=jnp.asarray)

    def __call__(self, mean, variance):
        """Score of posterior `mean` and `variance`, arrays of one shape, which is also the result's; may be -inf."""
        gain, certain = mean - self.best.astype(mean.dtype), variance == 0
        sd = jnp.sqrt(jnp.where(certain, 1.0, variance))
        sure = jnp.where(gain > 0, jnp.log(jnp.where(gain > 0, gain, 1.0)), -jnp.inf)
        return jnp.where(certain, sure, jnp.log(sd) + _log_improvement(gain / sd))

    def optimistic(self, mean: Float[Array, "..."], prior: Float[Array, ""]) -> Float[Array, "..."]:
        """Upper bound of the score given the posterior mean, for every variance up to the `prior` variance; mean's
        shape.

        The score rises with the variance, so the bound is the score at the prior variance.
        """
        return self(mean, prior)


class TopCategory(eqx.Module):
    """Log probability that the response is in the highest category.

    `threshold`: lower edge of that category; `noise`: standard deviation of the response noise; scalars.
    """

    threshold: Float[Array, ""] = eqx.field(converter=jnp.asarray)
    noise: Float[Array, ""] = eqx.field(converter=jnp.asarray)

    def __call__(self, mean, variance):
        """Score of posterior `mean` and `variance`, arrays of one shape, which is also the result's."""
        spread = jnp.sqrt(self.noise.astype(mean.dtype) ** 2 + variance)
        return jax.scipy.special.log_ndtr((mean - self.threshold.astype(mean.dtype)) / spread)

    def optimistic(self, mean: Float[Array, "..."], prior: Float[Array, ""]) -> Float[Array, "..."]:
        """Upper bound of the score given the posterior mean, for every variance up to the `prior` variance; mean's
        shape.

        Reached with variance 0 where the mean is above the threshold, and with the `prior` variance below it.
        """
        return self(mean, jnp.where(mean > self.threshold.astype(mean.dtype), 0.0, prior))


class TowardsGoal(eqx.Module):
    """A score that takes the closeness of the mean to the `goal`, by the thresholds of `likelihood`, for the mean."""

    score: UCB | LogEI
    goal: Goal = eqx.field(static=True)
    likelihood: OrdinalProbit

    def __call__(self, mean, variance):
        """Score of posterior `mean` and `variance`, arrays of one shape, which is also the result's."""
        return self.score(self.goal.closeness(self.likelihood, mean), variance)

    def optimistic(self, mean: Float[Array, "..."], prior: Float[Array, ""]) -> Float[Array, "..."]:
        """Upper bound of the score given the posterior mean, for every variance up to the `prior` variance; mean's
        shape.
        """
        return self.score.optimistic(self.goal.closeness(self.likelihood, mean), prior)


class InCategory(eqx.Module):
    """Log probability that the response is in a `category` of the `likelihood`."""

    likelihood: OrdinalProbit
    category: int = eqx.field(static=True)

    def __call__(self, mean, variance):
        """Score of posterior `mean` and `variance`, arrays of one shape, which is also the result's."""
        log_mass = jnp.vectorize(lambda m, v: self.likelihood.smoothed(m, v, self.category)[0])
        return log_mass(mean, variance)

    def optimistic(self, mean: Float[Array, "..."], prior: Float[Array, ""]) -> Float[Array, "..."]:
        """Upper bound of the score given the posterior mean, for every variance up to the `prior` variance; mean's
        shape.

        Within the category the bound is reached with variance 0; outside, it is the log probability of all latent
        values beyond the category's nearer threshold, by the `prior` variance.
        """
        inf = jnp.full(1, jnp.inf, mean.dtype)
        edges = jnp.concatenate([-inf, self.likelihood.thresholds.astype(mean.dtype), inf])
        lower, upper = edges[self.category], edges[self.category + 1]
        spread = jnp.sqrt(self.likelihood.noise.astype(mean.dtype) ** 2 + prior)
        beyond = jax.scipy.special.log_ndtr(jnp.minimum(mean - lower, upper - mean) / spread)
        return jnp.where((lower < mean) & (mean < upper), self(mean, jnp.zeros_like(mean)), beyond)


def _log_improvement(z: Float[Array, "*m"]) -> Float[Array, "*m"]:
    """log(phi(z) + z Phi(z)), elementwise, of any shape.

    For z < 0 it is computed as phi(z) (1 - |z| Q/phi) = phi(z) * excess / hazard to avoid cancellation.
    """
    below = jnp.where(z < 0, -z, 0.0)
    excess = excess_hazard(below)
    left = -0.5 * below**2 - HALF_LOG_2PI + jnp.log(excess) - jnp.log(below + excess)
    above = jnp.where(z < 0, 0.0, z)
    density = jnp.exp(-0.5 * above**2 - HALF_LOG_2PI)
    upper = above + excess_hazard(above)
    right = jnp.log(above + density * (1.0 - above / upper))  # z Phi + phi = z + phi (1 - z / hazard)
    return jnp.where(z < 0, left, right)


def maximise(
    values: Float[Array, " m"],
    candidates: Float[Array, "m d"],
    score: Callable[[Float[Array, " d"]], Float[Array, ""]],
    *,
    allowed: Callable[[Float[Array, " d"]], Bool[Array, ""]] | None = None,
    starts: int = 3,
    steps: int = 50,
    **search: Any,
) -> Choice:
    """Maximise a score over candidates, and refine the `starts` best ones by Newton's method.

    **Arguments:**

    - `values`: scores (m,) of the `candidates` (m, d), feasible points of the unit cube. They only rank the candidates,
      so single precision is sufficient: the best ones are scored again.
    - `score`: the same score for one point, differentiable.
    - `allowed`: which points may be chosen, e.g. none too close to earlier ones.
    - `starts`, `steps`: number of candidates, at least 0.1 apart, that are refined, and the largest number of Newton
      steps of each; 0 starts: the best candidate, not refined.
    - `search`: the feasible set, as [`climb`][hilbo.numerics.climbing.climb] takes it: `space.searched`.

    **Returns:** the best point (d,), its score, the row of the best candidate in `candidates`, and that candidate's
    score. Both scores are -inf if no candidate is allowed.
    """
    if allowed is not None:
        values = jnp.where(jax.vmap(allowed)(candidates), values, -jnp.inf)
    rows = spread(values, candidates, max(starts, 1))
    usable = values[rows] > -jnp.inf
    choice = climb(candidates[rows], usable, score, allowed=allowed, steps=steps if starts else 0, **search)
    return eqx.tree_at(lambda c: c.candidate, choice, rows[choice.candidate])


def thompson(
    key: PRNGKeyArray, mean: Float[Array, " m"], covariance: Float[Array, "m m"]
) -> tuple[Int[Array, ""], Float[Array, " m"]]:
    """Index of the maximum of one joint draw of f at m candidates, a scalar, and the draw (m,).

    `mean` (m,) and `covariance` (m, m): of the joint posterior; negative eigenvalues of the covariance are taken as 0.
    """
    eigenvalues, vectors = eigh(covariance)
    root = vectors * jnp.sqrt(jnp.where(eigenvalues > 0, eigenvalues, 0.0))[None, :]
    draw = mean + root @ jax.random.normal(key, mean.shape, mean.dtype)
    return jnp.argmax(draw), draw
