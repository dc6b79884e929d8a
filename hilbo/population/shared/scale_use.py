"""Differences between participants in the use of the response scale: a factor of each participant, 1 for the median."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hilbo.likelihoods import OrdinalProbit

__all__ = ["ScaleUse", "with_factor"]

_GAUSS = np.polynomial.hermite_e.hermegauss(7)
# Trapezoidal rule over 4 standard deviations to both sides: its error of a probability is below 3e-5 for spreads of
# sensitivities up to 0.8, where that of 7 Gauss-Hermite nodes is up to 0.03: low thresholds move with the factor.
_EVEN = np.linspace(-4.0, 4.0, 21), np.exp(-(np.linspace(-4.0, 4.0, 21) ** 2) / 2)


class ScaleUse(eqx.Module):
    """Distribution of participants' factors, log-normal with median 1: `sd` of the logarithm.

    `sensitivity`: what the factors are, as for `with_factor`.
    """

    sd: Float[Array, ""]
    sensitivity: bool = eqx.field(static=True, default=False)

    @property
    def log_factors(self) -> Float[Array, " nodes"]:
        """Nodes of a quadrature over the log factor: 7 Gauss-Hermite nodes for widths, 21 evenly spaced
        ones for sensitivities.
        """
        return self.sd * jnp.asarray(self._rule[0], self.sd.dtype)

    @property
    def weights(self) -> Float[Array, " nodes"]:
        """Weights of the quadrature, which sum to 1."""
        weights = self._rule[1]
        return jnp.asarray(weights / weights.sum(), self.sd.dtype)

    @property
    def _rule(self) -> tuple[np.ndarray, np.ndarray]:
        return _EVEN if self.sensitivity else _GAUSS

    def of_person(self, likelihood: OrdinalProbit, log_factor: Float[Array, ""]) -> OrdinalProbit:
        """Likelihood of a participant with this factor; `likelihood`: the median participant's."""
        return with_factor(likelihood, log_factor, self.sensitivity)


def with_factor(likelihood: OrdinalProbit, log_factor: Float[Array, ""], sensitivity: bool) -> OrdinalProbit:
    """Likelihood of a participant, from the median participant's and the logarithm of the participant's factor.

    The factor multiplies the distances of the thresholds from their mean (widths of the middle categories); with
    `sensitivity` those from the highest threshold t, and the noise. The responses are then those of a participant whose
    function is t + s (f - t), with the sensitivity s = exp(-log_factor).
    """
    thresholds, factor = likelihood.thresholds, jnp.exp(log_factor)
    about = thresholds[-1] if sensitivity else jnp.mean(thresholds)
    noise = factor * likelihood.noise if sensitivity else likelihood.noise
    return OrdinalProbit(about + factor * (thresholds - about), noise)
