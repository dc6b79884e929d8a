"""What a population map predicts of a person who gave no answers: that person's own function is integrated out, and the
width of their middle categories where people differ in it."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import log_ndtr, logsumexp
from jaxtyping import Array, Float

from hilbo.likelihoods import OrdinalProbit
from hilbo.population.recipes import WIDTHS

__all__ = ["class_probabilities", "log_highest"]

_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(7)
_WEIGHTS = _WEIGHTS / _WEIGHTS.sum()


def class_probabilities(
    likelihood: OrdinalProbit, mean: Float[Array, " m"], variance: Float[Array, " m"], widths: bool = False
) -> Float[Array, "m C"]:
    """Probabilities (m, C) of a new person's answers, from the mean and variance (m,) of that person's function.

    **Arguments:** `widths`: whether people's distances between thresholds differ, as the recipes' prior says; they are
    then integrated out by Gauss and Hermite, with 7 nodes.
    """
    if not widths:
        return jax.vmap(likelihood.class_probabilities)(mean, variance)

    def given(log_width: Float[Array, ""]) -> Float[Array, "m C"]:
        person = OrdinalProbit(_widened(likelihood, log_width), likelihood.noise)
        return jax.vmap(person.class_probabilities)(mean, variance)

    return jnp.tensordot(jnp.asarray(_WEIGHTS, mean.dtype), jax.vmap(given)(_log_widths(mean)), 1)


def log_highest(
    likelihood: OrdinalProbit, mean: Float[Array, " m"], variance: Float[Array, " m"], widths: bool = False
) -> Float[Array, " m"]:
    """The log probability (m,) of the highest category, as accurate where it is small; arguments as above."""
    spread = jnp.sqrt(likelihood.noise**2 + variance)
    if not widths:
        return log_ndtr((mean - likelihood.thresholds[-1]) / spread)
    highest = jax.vmap(lambda w: _widened(likelihood, w)[-1])(_log_widths(mean))
    each = log_ndtr((mean[:, None] - highest[None, :]) / spread[:, None])
    return logsumexp(each, axis=1, b=jnp.asarray(_WEIGHTS, mean.dtype)[None, :])


def _log_widths(like: Array) -> Float[Array, " nodes"]:
    return WIDTHS.mean + WIDTHS.sd * jnp.asarray(_NODES, like.dtype)


def _widened(likelihood: OrdinalProbit, log_width: Float[Array, ""]) -> Float[Array, " edges"]:
    middle = jnp.mean(likelihood.thresholds)
    return middle + jnp.exp(log_width) * (likelihood.thresholds - middle)
