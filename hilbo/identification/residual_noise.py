"""Noise model of the residuals of each curve: autoregression, low-frequency excess and random walk.

Residuals of a curve are autocorrelated, through drift and model error. Each curve's are described by an autoregression
of order 0 to 8 (Yule-Walker, BIC), either of the residuals themselves or of the noise of the recorded input that would
produce them: noise of the force in a creep test reaches the predicted position through 1/H, a slow filter. BIC decides
between the two (`Sampled.as_input_noise`). Such a short autoregression misses slow components, but the estimate of the
equilibrium stiffness averages over the whole record. Two terms are therefore added, estimated from the cosines c_k =
√(2/m) Σ_t r_t cos(πk(t + ½)/m), whose variance is the spectral density at ω_k = πk/m:

- `slow`: the mean of c_k²/S(ω_k) over k = 9 … 48, at least 1, multiplies the density S up to ω_48.
- `walk`: a random walk's density w/ω², with w from k = 1 … 8, is added if these cosines exceed k = 9 … 48 significantly
  (probability below `DRIFTS` in noise that is flat there; in records of less than 960 samples, whose cosines are
  faster, the autoregression is the null model). The test is made for the curve itself, and for all curves by Fisher's
  product of the probabilities, since one sensor records them. At ω = 0 the density is that of the mean of a walk of m
  samples from 0.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from hilbo.identification.fitting import Curve, Fit, curve_residuals
from hilbo.numerics.tracing import program

__all__ = ["Noise", "autoregression", "fitted_residuals", "noise", "noises", "weighted_normal"]

LONGEST_MEMORY = 8  # largest order of the autoregression
DRIFTS = 0.003  # probability of a walk in noise without one
_SLOWEST, _SLOW = 8, 48  # number of cosines for the walk, and for slow noise
_PERIOD = 60  # m over the highest k for which noise is taken as flat: a period of 120 samples
_START = 1.31  # ω·m at which a walk's density equals that of its mean


class Noise(eqx.Module):
    """Noise model of the residuals of one curve.

    `order` and `coefficients` (zero beyond the order) of the autoregression; `lag_one`: autocorrelation after one
    sample; `effective`: effective number of independent samples for a mean; `rms` in units of the curve's range;
    `slow`, `walk`: see the module docstring; `drift`: probability of such slow residuals without a random walk; `gain`:
    factor of the spectral density at πj/m, j = 0 … m, if the autoregression is that of the input, else 1.
    """

    order: Int[Array, ""]
    coefficients: Float[Array, " 8"]
    lag_one: Float[Array, ""]
    effective: Float[Array, ""]
    rms: Float[Array, ""]
    innovation: Float[Array, ""]  # innovation variance / variance
    slow: Float[Array, ""] | float = 1.0
    walk: Float[Array, ""] | float = 0.0
    drift: Float[Array, ""] | float = 1.0
    gain: Float[Array, "*w"] | float = 1.0


@program
def noise(fitted: Fit) -> tuple[Noise, ...]:
    """Noise models of the residuals of a fit, one per curve (compiled)."""
    return noises(fitted)


def noises(fitted: Fit) -> tuple[Noise, ...]:
    """Noise models of the residuals of a fit, one per curve, for use inside another compiled function.

    A random walk is part of a model only if its `drift`, tested for the curve alone and for all curves, is below
    `DRIFTS`.
    """
    single = [
        _noise(fitted, curve, r) for curve, r in zip(fitted.curves, fitted_residuals(fitted, fitted.q), strict=True)
    ]
    log_product = -sum(jnp.log(jnp.maximum(one.drift, jnp.finfo(one.lag_one.dtype).tiny)) for one in single)
    joint = jax.scipy.special.gammaincc(float(len(single)), log_product)
    drifts = [jnp.where(one.drift < 0.5, jnp.minimum(one.drift, joint), one.drift) for one in single]
    return tuple(_with_drift(one, drift) for one, drift in zip(single, drifts, strict=True))


def _with_drift(model: Noise, drift: Float[Array, ""]) -> Noise:
    """Copy of the model with this drift probability; its random walk becomes 0 unless that is below `DRIFTS`."""
    walk = jnp.where(drift < DRIFTS, model.walk, 0)
    return eqx.tree_at(lambda n: (n.walk, n.drift), model, (walk, drift))


def _noise(fitted: Fit, curve: Curve, r: Float[Array, " m"]) -> Noise:
    """Noise model of the residuals `r`: their own autoregression, or that of the input's noise if its BIC is lower.

    The latter only for a `regular` curve. A random walk is included whatever its `drift` is.
    """
    own = autoregression(r)
    if not curve.fitted.regular:
        return own
    source, gain, first = fitted.model.as_input_noise(fitted.q, curve.fitted, r)
    other = autoregression(source)
    # Likelihoods of r: r = source/first + past samples.
    scores = _bic(own, r.size), _bic(other, r.size) - 2 * r.size * jnp.log(first)
    density = _density(other, jnp.pi * jnp.arange(gain.size, dtype=r.dtype) / r.size) * gain
    gain = gain / _mean(density)
    effective = r.size / (_density(other, jnp.zeros(1, r.dtype))[0] * gain[0])
    slow = other.slow, other.walk, other.drift
    other = Noise(own.order, other.coefficients, own.lag_one, effective, own.rms, other.innovation, *slow, gain)
    own = eqx.tree_at(lambda n: n.gain, own, jnp.ones_like(gain))
    return jax.tree.map(lambda a, b: jnp.where(scores[1] < scores[0], a, b), other, own)


def _bic(model: Noise, m: int) -> Float[Array, ""]:
    """Bayesian information criterion of the autoregression for m samples; lower is better."""
    return m * jnp.log(model.innovation * model.rms**2) + model.order.astype(model.rms.dtype) * float(np.log(m))


def _mean(density: Float[Array, " w"]) -> Float[Array, ""]:
    """Mean of a spectral density over the whole circle, from its values at 0 … π: the variance."""
    return (jnp.sum(density) - (density[0] + density[-1]) / 2) / (density.size - 1)


def fitted_residuals(fit: Fit, q: Float[Array, " p"]) -> tuple[Float[Array, " _"], ...]:
    """Residuals of each curve at coordinates q, with the repeat weights of the fit."""
    return tuple(curve_residuals(fit.model, c, w, q) for c, w in zip(fit.curves, fit.weights, strict=True))


def autoregression(r: Float[Array, " m"]) -> Noise:
    """Noise model of one curve's residuals r: Yule-Walker autoregression with the order chosen by BIC.

    The random walk is included whatever its `drift` probability is.
    """
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
    parts = order, a, rho[1], m * (1 - jnp.sum(a)) ** 2 / innovation, jnp.sqrt(lags[0]), innovation
    return Noise(*parts, *_slow(r * jnp.sqrt(m / lags[0]), Noise(*parts)))


def _slow(r: Float[Array, " m"], model: Noise) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """`slow`, `walk` and `drift` of residuals `r` scaled to variance 1, given their autoregression `model`."""
    m = r.size
    omega = jnp.pi * jnp.arange(1, min(_SLOW, m // 4) + 1, dtype=r.dtype) / m
    energy = 2 / m * jnp.square(jnp.cos(omega[:, None] * (jnp.arange(m, dtype=r.dtype) + 0.5)[None, :]) @ r)
    density = _density(model, omega)
    slow = jnp.maximum(jnp.mean((energy / density)[_SLOWEST:]), 1) if omega.size > _SLOWEST else jnp.ones_like(r[0])
    slowest = energy[:_SLOWEST]
    walk = jnp.sum(slowest - slow * density[:_SLOWEST]) / jnp.sum(omega[:_SLOWEST] ** -2)
    flat = energy[_SLOWEST : m // _PERIOD]
    if flat.size >= slowest.size:
        return slow, jnp.maximum(walk, 0), _exceeds(slowest, flat)
    rest = slow * density[:_SLOWEST]
    return slow, jnp.maximum(walk, 0), jax.scipy.special.gammaincc(slowest.size / 2, jnp.sum(slowest / rest) / 2)


def _exceeds(few: Float[Array, " a"], rest: Float[Array, " b"]) -> Float[Array, ""]:
    """Probability, for flat noise, of cosines as large relative to `rest` as `few` (beta distribution)."""
    share = jnp.sum(rest) / (jnp.sum(rest) + jnp.sum(few))  # has a beta distribution
    return jax.scipy.special.betainc(rest.size / 2, few.size / 2, share)


def _density(model: Noise, omega: Float[Array, " w"]) -> Float[Array, " w"]:
    """Spectral density of the autoregression, scaled to variance 1, at `omega` (w,), rad per sample."""
    orders = jnp.arange(1, model.coefficients.size + 1, dtype=omega.dtype)
    phases = omega[:, None] * orders[None, :]
    real, imaginary = 1 - jnp.cos(phases) @ model.coefficients, jnp.sin(phases) @ model.coefficients
    return model.innovation / (real**2 + imaginary**2)


def weighted_normal(slopes: Float[Array, "m p"], model: Noise) -> Float[Array, "p p"]:
    """Jᵀ Γ J / variance (p, p) for the autocovariance Γ of the noise model, computed from its spectrum.

    `slopes` J (m, p).
    """
    m = slopes.shape[0]
    length = 2 * m
    omega = jnp.pi * jnp.arange(m + 1, dtype=slopes.dtype) / m
    density = _density(model, omega) * jnp.where(omega <= jnp.pi * _SLOW / m, model.slow, 1)
    density = (density + model.walk / jnp.maximum(omega, _START / m) ** 2) * model.gain
    twice = jnp.full(density.size, 2.0, density.dtype).at[0].set(1).at[-1].set(1)
    waves = jnp.fft.rfft(slopes, length, axis=0)
    weight = (density * twice / length)[:, None]
    return waves.real.T @ (weight * waves.real) + waves.imag.T @ (weight * waves.imag)
