"""Maximum evidence that is not fooled by Laplace's method.

Laplace's evidence is too high where the noise is small against the latent function's spread, and its maximum may then
lie where people's answers are predicted badly. Where a search by it ended, expectation propagation, which is within a
hundredth of the exact evidence there, says by how much. Above `TRUSTED` an answer the hyperparameters are learnt again,
by the evidence of expectation propagation. Reference: Kuss & Rasmussen (2005), JMLR 6:1679, on what both do at such
hyperparameters.
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
"""Nats an answer by which Laplace's evidence may differ from that of expectation propagation."""


class Judged(eqx.Module):
    """What was learnt, and how far Laplace's evidence was off; leading axes as of `MaximumEvidence`."""

    maximum: MaximumEvidence
    error: Float[Array, "*M"]
    """Nats an answer, Laplace's less the other's, where the search by Laplace's evidence ended; 0 of other searches."""
    again: Bool[Array, "*M"]
    """Learnt again, by expectation propagation."""


def maximise_judged(
    gp: OrdinalGP,
    trials: Trials,
    learn: Sequence[str],
    *,
    shared: bool = True,
    weak_priors: bool = True,
    inference: str = "laplace",
) -> Judged:
    """Hyperparameters of stacked trials (M, n), the same for all, or (not `shared`) everybody's own; by `inference`'s
    evidence, Laplace's judged. Not under `jit`: what is learnt again depends on what was learnt."""
    settings = (tuple(learn), shared, weak_priors)
    maximum = _learnt(gp, trials, *settings, inference)
    if inference != "laplace":
        return Judged(maximum, jnp.zeros_like(maximum.log_evidence), jnp.zeros(maximum.log_evidence.shape, bool))
    error = _error(maximum, trials, shared)
    again = ~(jnp.abs(error) <= TRUSTED)
    if bool(again.any()):
        other = _learnt(gp, trials, *settings, "ep")
        maximum = jax.tree.map(lambda a, b: jnp.where(_like(again, a), a, b), other, maximum)
    return Judged(maximum, error, again)


def judged_sentences(judged: Judged) -> list[str]:
    """What must be said of hyperparameters that Laplace's evidence misjudged; nothing where it did not."""
    again, error = np.atleast_1d(np.asarray(judged.again)), np.atleast_1d(np.asarray(judged.error))
    if not again.any():
        return []
    whose = "" if len(again) == 1 else f" of {again.sum()} people"
    return [
        f"Laplace's evidence{whose} was off by {np.max(np.abs(error[again])):.2g} nats an answer at the hyperparameters"
        f" that it chose (more than {TRUSTED:g}): they were learnt by expectation propagation instead."
    ]


def _like(flags: Bool[Array, "*M"], leaf: Array) -> Bool[Array, "..."]:
    return flags.reshape(*flags.shape, *(1,) * (leaf.ndim - flags.ndim))


@program
def _learnt(
    gp: OrdinalGP, trials: Trials, learn: tuple[str, ...], shared: bool, weak_priors: bool, inference: str
) -> MaximumEvidence:
    if shared:
        return maximise_shared_evidence(gp, trials, learn, weak_priors=weak_priors, inference=inference)
    return jax.lax.map(lambda t: maximise_evidence(gp, t, learn, weak_priors=weak_priors, inference=inference), trials)


@program
def _error(maximum: MaximumEvidence, trials: Trials, shared: bool) -> Float[Array, "*M"]:
    """Laplace's log evidence less that of expectation propagation, an answer: of all, or (not `shared`) of each."""

    def by_ep(gp, trials):
        return fit(gp, trials, inference="ep", throw=False).log_evidence

    counts = jnp.sum(trials.mask, axis=1, dtype=trials.x.dtype)
    if shared:
        together = jnp.sum(jax.lax.map(lambda t: by_ep(maximum.gp, t), trials))
        return (maximum.log_evidence - together) / jnp.sum(counts)
    errors = maximum.log_evidence - jax.lax.map(lambda pair: by_ep(*pair), (maximum.gp, trials))
    return jnp.where(counts > 0, errors / jnp.where(counts > 0, counts, 1.0), 0.0)  # no answers, nothing to err in
