"""Bootstrap over participants: location of the population optimum in resamples of the participants.

The map of each resample is aggregated from the same posteriors, and its maximum is searched among given points: nothing
is fitted again.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import Posterior
from hilbo.population.pointwise import aggregate

__all__ = ["can_resample", "resampled_tops"]


def can_resample(posteriors: Posterior) -> bool:
    """Whether at least two participants have responses: with one, all resamples would be the same."""
    return int(np.any(np.asarray(posteriors.trials.mask), axis=1).sum()) > 1


def resampled_tops(
    posteriors: Posterior,
    points: Float[Array, "m d"],
    rule: str,
    share: ArrayLike | None,
    prior: ArrayLike,
    seed: int = 0,
    draws: int = 200,
) -> Int[np.ndarray, " draws"]:
    """Bootstrap over participants: for each resample the row of `points` (unit cube) where its map is highest.
    (draws,).

    **Arguments:** `rule`: a method of `POINTWISE`; `share`: shared variance fraction of the hierarchical one, otherwise
    None; `prior`: variance of the map without responses, a scalar.
    """
    people = posteriors.trials.mask.shape[0]
    rows = np.random.default_rng(seed).integers(0, people, (draws, people))
    return np.asarray(_tops(posteriors, points, jnp.asarray(rows), rule, share, jnp.asarray(prior)))


@program
def _tops(
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

    def one(chosen: Int[Array, " M"]) -> Int[Array, ""]:
        return jnp.argmax(aggregate(rule, means[chosen], explained[chosen], prior, share=share)[0])

    return jax.lax.map(one, rows)
