"""Maximum evidence by Laplace's method, checked by expectation propagation.

Laplace's evidence is too high where the noise is small relative to the spread of the latent function, and its maximum
may then predict the responses badly. At the end of a search by Laplace's evidence its error is measured by expectation
propagation, which is within a hundredth of the exact evidence there. If it exceeds `TRUSTED` per response, the
hyperparameters are learnt again by the evidence of expectation propagation. Reference: Kuss & Rasmussen (2005), JMLR
6:1679, on both methods at such hyperparameters.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hilbo.hyperparameters.maximum_evidence import MaximumEvidence, maximise_evidence, maximise_shared_evidence
from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import OrdinalGP, Trials, fit

__all__ = ["TRUSTED", "Judged", "judged_sentences", "maximise_judged"]

TRUSTED = 0.05
"""Largest accepted difference of Laplace's evidence from that of expectation propagation, nats per response."""


class Judged(eqx.Module):
    """Learnt hyperparameters and the error of Laplace's evidence; leading axes as of `MaximumEvidence`.

    `error`: Laplace's minus EP's evidence, nats per response; `again`: whether the hyperparameters were learnt again by
    expectation propagation.
    """

    maximum: MaximumEvidence
    error: Float[Array, "*M"]
    """Laplace's minus EP's evidence at the end of the Laplace search, nats per response; 0 for other searches."""
    again: Bool[Array, "*M"]
    """Whether the hyperparameters were learnt again by expectation propagation."""


def maximise_judged(
    gp: OrdinalGP,
    trials: Trials,
    learn: Sequence[str],
    *,
    shared: bool = True,
    weak_priors: bool = True,
    inference: str = "laplace",
) -> Judged:
    """Learn hyperparameters of stacked trials (M, n) by maximum evidence; where Laplace's evidence is off by more than
    `TRUSTED`, or not finite, learn them again by expectation propagation.

    `learn`: names of hyperparameters; `shared`: the same for all participants, else individual ones; `weak_priors`: as
    for `maximise_evidence`; `inference`: method of the evidence; with another than "laplace" nothing is checked, and
    the error is 0. Not under `jit`: what is learnt again depends on values. Raises `InputError` for unknown or no names
    in `learn`, for variance, noise and thresholds together, and for exact inference.
    """
    settings = (tuple(learn), shared, weak_priors)
    maximum = _learnt(gp, trials, *settings, inference)
    if inference != "laplace":
        return Judged(maximum, jnp.zeros_like(maximum.log_evidence), jnp.zeros(maximum.log_evidence.shape, bool))
    error = _error(maximum, trials, shared)
    again = ~(jnp.abs(error) <= TRUSTED)
    if bool(again.any()):
        other = _learnt(gp, trials, *settings, "ep")
        maximum = jax.tree.map(lambda a, b: jnp.where(_broadcastable(again, a), a, b), other, maximum)
    return Judged(maximum, error, again)


def judged_sentences(judged: Judged) -> list[str]:
    """A list with one sentence if hyperparameters were learnt again because Laplace's evidence was inaccurate; else an
    empty list.
    """
    again, error = np.atleast_1d(np.asarray(judged.again)), np.atleast_1d(np.asarray(judged.error))
    if not again.any():
        return []
    whose = "" if len(again) == 1 else f" of {again.sum()} participants"
    return [
        f"Laplace's evidence{whose} was off by {np.max(np.abs(error[again])):.2g} nats per response at the"
        f" hyperparameters that it chose (more than {TRUSTED:g}): they were learnt by expectation propagation instead."
    ]


def _broadcastable(flags: Bool[Array, "*M"], leaf: Array) -> Bool[Array, "..."]:
    """Flags with axes of length 1 appended, so that they broadcast against `leaf`."""
    return flags.reshape(*flags.shape, *(1,) * (leaf.ndim - flags.ndim))


@program
def _learnt(
    gp: OrdinalGP, trials: Trials, learn: tuple[str, ...], shared: bool, weak_priors: bool, inference: str
) -> MaximumEvidence:
    """Maximum-evidence hyperparameters of stacked trials: one set if `shared`, else one for each participant,
    stacked.
    """
    if shared:
        return maximise_shared_evidence(gp, trials, learn, weak_priors=weak_priors, inference=inference)
    return jax.lax.map(lambda t: maximise_evidence(gp, t, learn, weak_priors=weak_priors, inference=inference), trials)


@program
def _error(maximum: MaximumEvidence, trials: Trials, shared: bool) -> Float[Array, "*M"]:
    """Laplace's minus EP's log evidence, nats per response, at the learnt hyperparameters.

    A scalar over all participants if `shared`, else (M,); 0 without responses.
    """

    def by_ep(gp, trials):
        return fit(gp, trials, inference="ep", throw=False).log_evidence

    counts = jnp.sum(trials.mask, axis=None if shared else 1, dtype=trials.x.dtype)
    if shared:
        evidence = jnp.sum(jax.lax.map(lambda t: by_ep(maximum.gp, t), trials))
    else:
        evidence = jax.lax.map(lambda pair: by_ep(*pair), (maximum.gp, trials))
    return jnp.where(counts > 0, (maximum.log_evidence - evidence) / jnp.maximum(counts, 1.0), 0.0)
