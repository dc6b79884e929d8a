"""Differences between participants in the use of the response scale: log-normal factors with median 1."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hilbo.likelihoods import OrdinalProbit

__all__ = ["INDIVIDUAL", "ScaleUse", "of_person"]

INDIVIDUAL = ("widths", "sensitivities")
"""Names of the factors; each participant has one of each."""
_GAUSS = np.polynomial.hermite_e.hermegauss(7)
# Trapezoidal rule over 4 standard deviations to both sides: its error of a probability is below 3e-5 for spreads of
# sensitivities up to 0.8, where that of 7 Gauss-Hermite nodes is up to 0.03: low thresholds move with the factor.
_EVEN = np.linspace(-4.0, 4.0, 21), np.exp(-(np.linspace(-4.0, 4.0, 21) ** 2) / 2)


class ScaleUse(eqx.Module):
    """Distribution of participants' widths and sensitivities, which are independent: standard deviations of their
    logarithms, None where participants do not differ; and the `fixed_point` of sensitivities, as for `of_person`.
    """

    width: Float[Array, ""] | None = None
    sensitivity: Float[Array, ""] | None = None
    fixed_point: Float[Array, ""] | None = None

    def people(self, likelihood: OrdinalProbit) -> tuple[OrdinalProbit, Float[Array, " k"]]:
        """Likelihoods, stacked, of k participants, and their weights, which sum to 1: a quadrature over the factors.

        `likelihood`: the median participant's. 7 Gauss-Hermite nodes for widths, 21 evenly spaced ones for
        sensitivities, and all pairs where there are both.
        """
        dtype = likelihood.thresholds.dtype
        width = None if self.width is None else self.width * jnp.asarray(_GAUSS[0], dtype)
        sensitivity = None if self.sensitivity is None else self.sensitivity * jnp.asarray(_EVEN[0], dtype)
        of_widths, of_sensitivities = _weights(_GAUSS[1], dtype), _weights(_EVEN[1], dtype)
        if width is None or sensitivity is None:
            weights = of_widths if sensitivity is None else of_sensitivities
        else:
            weights = jnp.outer(of_widths, of_sensitivities).ravel()
            width, sensitivity = jnp.repeat(width, sensitivity.size), jnp.tile(sensitivity, width.size)
        return jax.vmap(lambda w, s: of_person(likelihood, w, s, self.fixed_point))(width, sensitivity), weights


def _weights(weights: Float[np.ndarray, " k"], dtype: jnp.dtype) -> Float[Array, " k"]:
    return jnp.asarray(weights / weights.sum(), dtype)


def of_person(
    likelihood: OrdinalProbit,
    log_width: Float[Array, ""] | None = None,
    log_sensitivity: Float[Array, ""] | None = None,
    fixed_point: Float[Array, ""] | None = None,
) -> OrdinalProbit:
    """Likelihood of a participant, from the median participant's and the logarithms of the participant's factors.

    The width multiplies the distances of the thresholds from their mean. The sensitivity s divides their distances from
    a threshold t, and the noise: the responses are those of a participant whose function is t + s (f - t). t is at
    `fixed_point` between the mean of the participant's own thresholds, 0, and the highest one, 1; None is 1.
    """
    thresholds, noise = likelihood.thresholds, likelihood.noise
    if log_width is not None:
        middle = jnp.mean(thresholds)
        thresholds = middle + jnp.exp(log_width) * (thresholds - middle)
    if log_sensitivity is not None:
        t, factor = thresholds[-1], jnp.exp(-log_sensitivity)
        if fixed_point is not None:
            t = (1.0 - fixed_point) * jnp.mean(thresholds) + fixed_point * t
        thresholds, noise = t + factor * (thresholds - t), factor * noise
    return OrdinalProbit(thresholds, noise)
