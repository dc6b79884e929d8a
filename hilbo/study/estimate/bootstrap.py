"""Bootstrap over participants: location of the population optimum in resamples of the participants.

The map of each resample is aggregated from the same posteriors, and its maximum is searched among given points: nothing
is fitted again.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from hilbo.likelihoods import Goal, OrdinalProbit
from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import Posterior
from hilbo.population.pointwise import aggregate
from hilbo.study.config import Study
from hilbo.study.estimate.optimum import score

__all__ = ["can_resample", "resampled_tops"]


def can_resample(posteriors: Posterior) -> bool:
    """Whether at least two participants have responses: with one, all resamples would be the same."""
    return int(np.any(np.asarray(posteriors.trials.mask), axis=1).sum()) > 1


def resampled_tops(
    study: Study,
    posteriors: Posterior,
    points: Float[Array, "m d"],
    rule: str,
    share: ArrayLike | None,
    prior: ArrayLike,
    seed: int = 0,
    draws: int = 200,
) -> Int[np.ndarray, " draws"]:
    """Bootstrap over participants: for each resample the row of `points` (unit cube) where its map
    is highest by `score`. (draws,).

    **Arguments:** `rule`: a method of `POINTWISE`; `share`: shared variance fraction of the hierarchical one, otherwise
    None; `prior`: variance of the map without responses, a scalar.
    """
    people = posteriors.trials.mask.shape[0]
    rows = np.random.default_rng(seed).integers(0, people, (draws, people))
    return np.asarray(
        _tops(study.goal, study.gp.likelihood, posteriors, points, jnp.asarray(rows), rule, share, jnp.asarray(prior))
    )


@program
def _tops(
    goal: Goal,
    likelihood: OrdinalProbit,
    posteriors: Posterior,
    points: Float[Array, "m d"],
    rows: Int[Array, "draws M"],
    rule: str,
    share: ArrayLike | None,
    prior: Float[Array, ""],
) -> Int[Array, " draws"]:
    """For each resample of participants (`rows`: their indices) the row of `points` where its map is highest,
    compiled."""
    means, explained = jax.lax.map(lambda person: person.predict_explained(points), posteriors)

    apart = 0.0 if share is None else (1.0 - share) * prior

    def one(chosen: Int[Array, " M"]) -> Int[Array, ""]:
        moments = aggregate(rule, means[chosen], explained[chosen], prior, share=share)
        return jnp.argmax(score(goal, likelihood, *moments, apart))

    return jax.lax.map(one, rows)
