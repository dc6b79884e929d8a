"""Differences between participants in the use of the response scale: a factor of each participant, 1 for the median."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hilbo.likelihoods import OrdinalProbit

__all__ = ["WEIGHTS", "ScaleUse", "with_factor"]

_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(7)
WEIGHTS = _WEIGHTS / _WEIGHTS.sum()
"""Weights (7,) of `ScaleUse.log_factors`; they sum to 1."""


class ScaleUse(eqx.Module):
    """Distribution of participants' factors, log-normal with median 1: `sd` of the logarithm.

    `sensitivity`: what the factors are, as for `with_factor`.
    """

    sd: Float[Array, ""]
    sensitivity: bool = eqx.field(static=True, default=False)

    @property
    def log_factors(self) -> Float[Array, " 7"]:
        """Nodes of Gauss-Hermite quadrature for the log factor, of the weights `WEIGHTS`."""
        return self.sd * jnp.asarray(_NODES, self.sd.dtype)

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
