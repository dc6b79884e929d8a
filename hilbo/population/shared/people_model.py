"""Hyperparameters of the hierarchical model of M participants: f_j = g + h_j, with a shared function g and individual
functions h_j of one kernel; in context c, such as a clip, f_j + u_c.
"""

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from hilbo.kernels import RBF, Stationary
from hilbo.likelihoods import OrdinalProbit
from hilbo.ordinal_gp import OrdinalGP

__all__ = ["PeopleModel"]


class PeopleModel(eqx.Module):
    """Hyperparameters of the hierarchical model of M participants: kernel and its theta, prior variances of the shared
    and of the individual functions, thresholds, noise, and each participant's use of the scale.
    """

    theta: Float[Array, "*d"]
    """Inverse squared lengths, per squared unit of x; one, or one for each coordinate."""
    shared: Float[Array, ""]
    """Prior variance of g."""
    own: Float[Array, ""]
    """Prior variance of each h_j."""
    thresholds: Float[Array, " edges"]
    noise: Float[Array, ""]
    log_widths: Float[Array, " M"]
    """Logarithm of each person's width (`scale_use`)."""
    kernel: type[Stationary] = eqx.field(static=True, default=RBF)
    """Of g and of each h_j."""
    levels: tuple[int, ...] = eqx.field(static=True, default=())
    """For each coordinate its number of unordered levels, as kernels take it."""
    effect: Float[Array, ""] | None = None
    """Prior variance of what each context adds to each participant's function; None without a random effect."""
    log_sensitivities: Float[Array, " M"] | None = None
    """Logarithm of each person's sensitivity (`scale_use`); None: all participants have the same one."""
    fixed_point: Float[Array, ""] | None = None
    """Latent value that a sensitivity leaves unchanged, as a position between the mean of the thresholds, 0, and the
    highest one, 1; None is 1."""

    @classmethod
    def of(cls, gp: OrdinalGP, share: ArrayLike, people: int) -> "PeopleModel":
        """Hierarchical model from one participant's model `gp`: `share`, in [0, 1], of its prior variance is common.

        All of the `people` participants have its thresholds; no random effect.
        """
        kernel, likelihood = gp.kernel, gp.likelihood
        share, widths = jnp.asarray(share, kernel.variance.dtype), jnp.zeros(people, kernel.variance.dtype)
        shared, own = share * kernel.variance, (1.0 - share) * kernel.variance
        model = kernel.theta, shared, own, likelihood.thresholds, likelihood.noise, widths
        return cls(*model, kernel=type(kernel), levels=kernel.levels)

    @property
    def share(self) -> Float[Array, ""]:
        """Part of a participant's prior variance that all have in common, from 0 to 1, a scalar."""
        return self.shared / (self.shared + self.own)

    @property
    def gp(self) -> OrdinalGP:
        """One participant's model, with the median distances between thresholds; without random effect."""
        return OrdinalGP(self.of_variance(self.shared + self.own), self.likelihood)

    @property
    def likelihood(self) -> OrdinalProbit:
        """Likelihood of the median participant, whose width and sensitivity are 1."""
        return OrdinalProbit(self.thresholds, self.noise)

    @property
    def unit(self) -> Stationary:
        """The kernel with variance 1."""
        return self.of_variance(jnp.ones_like(self.shared))

    def of_variance(self, variance: Float[Array, ""]) -> Stationary:
        """The kernel with this variance, a scalar."""
        return self.kernel(self.theta, variance, self.levels)
