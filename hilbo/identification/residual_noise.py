"""Residuals of a fit and how they hang together: each curve's as an autoregression.

Residuals of a curve are autocorrelated, by drift and by what the model cannot make. Each curve's are described by an
autoregression of order 0 to 8 (Yule-Walker, BIC).
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from hilbo.identification.fitting import Fit, curve_residuals
from hilbo.numerics.tracing import program

__all__ = ["Noise", "autoregression", "filtered", "fitted_residuals", "noise"]

LONGEST_MEMORY = 8  # largest order of the autoregression


class Noise(eqx.Module):
    """The residuals of one curve as an autoregression.

    `order` and `coefficients` (zero beyond the order), `lag_one`: their autocorrelation after one sample, `effective`:
    how many independent samples would tell a mean as well, `rms`: in units of the curve's range.
    """

    order: Int[Array, ""]
    coefficients: Float[Array, " 8"]
    lag_one: Float[Array, ""]
    effective: Float[Array, ""]
    rms: Float[Array, ""]
    innovation: Float[Array, ""]  # share of the variance that is new in each sample


@program
def noise(fitted: Fit) -> tuple[Noise, ...]:
    """The autoregressions of the residuals, curve by curve."""
    return tuple(autoregression(r) for r in fitted_residuals(fitted, fitted.q))


def fitted_residuals(fit: Fit, q: Float[Array, " p"]) -> tuple[Float[Array, " _"], ...]:
    """Those of each curve, under the weights of the fit."""
    return tuple(curve_residuals(fit.model, c, w, q) for c, w in zip(fit.curves, fit.weights, strict=True))


def autoregression(r: Float[Array, " m"]) -> Noise:
    """Of one curve's residuals: Yule-Walker by Levinson's recursion, the order by BIC."""
    m = r.size
    lags = jnp.stack([r[: m - k] @ r[k:] for k in range(LONGEST_MEMORY + 1)])
    rho = lags / lags[0]
    a, error = jnp.zeros(LONGEST_MEMORY, r.dtype), jnp.ones_like(rho[0])
    models, scores = [a], [jnp.zeros_like(error)]
    for p in range(1, LONGEST_MEMORY + 1):
        back = a[: p - 1][::-1]
        reflection = (rho[p] - a[: p - 1] @ rho[1:p][::-1]) / error
        a = a.at[: p - 1].add(-reflection * back).at[p - 1].set(reflection)
        error = error * (1 - reflection**2)
        models.append(a)
        scores.append(m * jnp.log(error) + p * jnp.log(float(m)))
    order = jnp.argmin(jnp.stack(scores))
    a = jnp.stack(models)[order]
    innovation = 1 - a @ rho[1:]
    return Noise(order, a, rho[1], m * (1 - jnp.sum(a)) ** 2 / innovation, jnp.sqrt(lags[0]), innovation)


def filtered(slopes: Float[Array, "m p"], model: Noise) -> Float[Array, "p p"]:
    """Jᵀ Γ J for the autocovariance Γ of variance 1, by its spectrum."""
    length = 2 * slopes.shape[0]
    response = jnp.fft.rfft(jnp.concatenate([jnp.ones(1, slopes.dtype), -model.coefficients]), length)
    density = model.innovation / jnp.abs(response) ** 2
    twice = jnp.full(density.size, 2.0, density.dtype).at[0].set(1).at[-1].set(1)
    waves = jnp.fft.rfft(slopes, length, axis=0)
    weight = (density * twice / length)[:, None]
    return waves.real.T @ (weight * waves.real) + waves.imag.T @ (weight * waves.imag)
