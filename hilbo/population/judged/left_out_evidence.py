"""Hyperparameters by maximum evidence of participants who are left out of a committee.

The criterion is the leave-one-participant-out marginal likelihood,

    sum_j log p(q_j | q_i of all i != j),

in which the population map without participant j is the prior of that participant's function: its mean and variance,
with the correlations of the kernel. The joint probability of j's responses is the product of their predictions in
turn, by assumed density filtering (`newcomer.in_turn`). For the hierarchical method the share is given.

The sum of the evidences of individual models is another criterion, and not one for a committee: with priors of mean 0
none of these models knows what participants have in common, and long length scales explain the common hill; the
committee then multiplies the long-ranged posteriors of all participants, and its optimum moves to a corner of the
search space.

The weak priors are those of `hilbo.hyperparameters.maximum_evidence`. Searches start at three values of theta.
Reference: Vehtari et al. (2016), JMLR 17(103):1, for leave-one-out densities of Gaussian latent variable models.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from hilbo.errors import InputError
from hilbo.hyperparameters.coordinates import Coordinates, coordinates_of, log_prior, model_at
from hilbo.kernels import gram
from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import OrdinalGP, Trials, fit
from hilbo.population.judged.evidence_search import Cost, Maximum, ran_away, searched
from hilbo.population.newcomer import in_turn, with_variances
from hilbo.population.pointwise import merged_without

__all__ = ["left_out_evidence", "maximise_left_out"]

_STARTS = (0.0, -1.4, 1.4)  # of log theta, from the model's: a factor of 4 either way
_LEFT_OUT = 64  # participants who are left out one by one, evenly spaced; the committee has all others


def left_out_evidence(
    gp: OrdinalGP,
    trials: Trials,
    rule: str,
    share: ArrayLike | None = None,
    *,
    rows: Sequence[int] | None = None,
    inference: str = "laplace",
) -> float:
    """Log probability of each participant's responses given those of all others, summed over participants, in nats.

    **Arguments:** `trials`: stacked (M, n), of at least two participants; `rule`: a method of
    `hilbo.population.pointwise`; `share`: of the hierarchical one; `rows`: participants who are left out,
    default: each.
    """
    left_out = np.arange(trials.mask.shape[0]) if rows is None else np.asarray(rows)
    return float(_left_out_evidence(gp, trials, jnp.asarray(left_out), share, rule, inference)[0])


def maximise_left_out(
    gp: OrdinalGP,
    trials: Trials,
    rule: str,
    learn: tuple[str, ...],
    share: ArrayLike | None = None,
    *,
    inference: str = "laplace",
) -> Maximum:
    """Hyperparameters, one set for all participants, that maximise the left-out evidence with weak priors.

    **Arguments:** `gp`: starting values, the priors' centre, and the fixed values; `learn`: which of
    "theta", "noise" and "thresholds"; others as for `left_out_evidence`. Of more than 64 participants, 64 evenly spaced
    ones are left out.

    Raises `InputError` for fewer than two participants with responses. A search that fails does not raise: read
    `converged`.
    """
    answered = np.flatnonzero(np.asarray(trials.mask).any(axis=1))
    if len(answered) < 2:
        raise InputError(f"maximise_left_out: {len(answered)} people gave answers; at least two are needed.")
    places = np.unique(np.linspace(0, len(answered) - 1, min(len(answered), _LEFT_OUT)).round().astype(int))
    rows = jnp.asarray(answered[places])
    initial = coordinates_of(gp, learn)
    restore = ravel_pytree(initial)[1]

    def cost(flat: Float[np.ndarray, " p"]) -> Cost:
        return _cost(jnp.asarray(flat, trials.x.dtype), gp, trials, rows, share, learn, rule, inference)

    begin = np.asarray(ravel_pytree(initial)[0], float)
    ends = [searched(cost, np.asarray(ravel_pytree(start)[0], float)) for start in _starts(initial)]
    end, before = min(ends, key=lambda each: each.cost if np.isfinite(each.cost) else np.inf), ends[0].first
    return Maximum(
        gp=model_at(restore(jnp.asarray(end.place, trials.x.dtype)), gp),
        log_evidence=end.log_evidence if np.isfinite(end.cost) else before,
        log_evidence_before=before,
        steps=end.steps,
        converged=end.converged,
        runaway=ran_away(restore(jnp.asarray(end.place - begin, trials.x.dtype))),
    )


def _starts(initial: Coordinates) -> list[Coordinates]:
    """Coordinates at which searches start: `initial`, and with other theta where it is learnt."""
    if "theta" not in initial:
        return [initial]
    return [initial | {"theta": initial["theta"] + shift} for shift in _STARTS]


@program
def _cost(
    flat: Float[Array, " p"],
    gp: OrdinalGP,
    trials: Trials,
    rows: Int[Array, " k"],
    share: ArrayLike | None,
    learn: tuple[str, ...],
    rule: str,
    inference: str,
) -> Cost:
    """Cost at the coordinates `flat` (p,), those that `learn` names, in the order of `ravel_pytree`; compiled.

    `gp`: the model at the priors' centre. Other arguments as for `_left_out_evidence`.
    """
    restore = ravel_pytree(coordinates_of(gp, learn))[1]

    def value(flat):
        model = model_at(restore(flat), gp)
        evidence, converged = _left_out_evidence(model, trials, rows, share, rule, inference)
        return -evidence - log_prior(model, gp, learn), (evidence, converged)

    (cost, (evidence, converged)), gradient = jax.value_and_grad(value, has_aux=True)(flat)
    return Cost(cost, gradient, evidence, converged)


@program
def _left_out_evidence(
    gp: OrdinalGP, trials: Trials, rows: Int[Array, " k"], share: ArrayLike | None, rule: str, inference: str
) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """Left-out evidence of the participants `rows` (k,), and whether all participants' fits converged."""
    posteriors = jax.vmap(lambda person: fit(gp, person, inference=inference, throw=False))(trials)
    x, q, mask = trials.x[rows], trials.q[rows], trials.mask[rows]
    prior, left_out = gp.kernel.variance, jnp.repeat(rows, q.shape[1])
    mean, variance = merged_without(rule, posteriors, x.reshape(-1, x.shape[2]), left_out, prior, share)
    apart = 0.0 if share is None else (1.0 - share) * prior

    @jax.checkpoint
    def predicted(person):
        x, q, mask, mean, variance = person
        covariance = with_variances(gram(gp.kernel, x, x), variance + apart)
        logs = in_turn(gp.likelihood, mean, covariance, q, mask).log_given
        return jnp.sum(jnp.where(mask, logs, 0.0))

    given = jax.lax.map(predicted, (x, q, mask, mean.reshape(q.shape), variance.reshape(q.shape)))
    return jnp.sum(given), jnp.all(posteriors.certificate.converged)
