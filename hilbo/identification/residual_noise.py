"""Residuals of a fit and how they hang together: the spectrum of each curve's.

Residuals of a curve are autocorrelated, by drift and by what the model cannot make. Each curve's are described by an
autoregression of order 0 to 8 (Yule-Walker, BIC), of themselves or of the noise of the recorded input that would
make them: noise of the force in a creep test reaches the predicted position through 1/H, which is slow. The better of
the two is taken, by BIC again (`Sampled.as_input_noise`).
So few coefficients do not see what is slow, but the estimate of a lasting stiffness averages over the whole record.
Two terms are therefore added, measured on the cosines c_k = √(2/m) Σ_t r_t cos(πk(t + ½)/m), whose variance is the
spectral density at ω_k = πk/m:

- `slow`: the mean of c_k²/S(ω_k) over k = 9 … 48, at least 1, multiplies the density S up to ω_48.
- `walk`: a random walk's density w/ω², w from k = 1 … 8, where those exceed k = 9 … 48 with a probability of less than
  `DRIFTS` in noise that is flat there (an autoregression of one record would take the walk for its own; it is the null
  in records of less than 960 samples, whose cosines are faster): in the curve itself, or in all curves by Fisher's
  product of the probabilities, since one sensor records them. At ω = 0 it has the density with which the mean of a walk
  of m samples from 0 varies.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from hilbo.identification.fitting import Curve, Fit, curve_residuals
from hilbo.numerics.tracing import program

__all__ = ["Noise", "autoregression", "filtered", "fitted_residuals", "noise", "noises"]

LONGEST_MEMORY = 8  # largest order of the autoregression
DRIFTS = 0.003  # probability of a walk in noise without one
_SLOWEST, _SLOW = 8, 48  # cosines that show a walk, and slow noise
_PERIOD = 60  # m over the fastest cosine for which noise is taken as flat: a period of 120 samples
_START = 1.31  # ω·m at which a walk's density has that of its mean, about its start


class Noise(eqx.Module):
    """The residuals of one curve as an autoregression.

    `order` and `coefficients` (zero beyond the order), `lag_one`: their autocorrelation after one sample, `effective`:
    how many independent samples would tell a mean as well, `rms`: in units of the curve's range. `slow`, `walk`: of
    this module's head; `drift`: probability of such slow residuals without a walk. `gain`: what the density is
    multiplied by at πj/m, j = 0 … m, where the autoregression is the input's; 1 elsewhere.
    """

    order: Int[Array, ""]
    coefficients: Float[Array, " 8"]
    lag_one: Float[Array, ""]
    effective: Float[Array, ""]
    rms: Float[Array, ""]
    innovation: Float[Array, ""]  # share of the variance that is new in each sample
    slow: Float[Array, ""] | float = 1.0
    walk: Float[Array, ""] | float = 0.0
    drift: Float[Array, ""] | float = 1.0
    gain: Float[Array, "*w"] | float = 1.0


@program
def noise(fitted: Fit) -> tuple[Noise, ...]:
    """The noise of the residuals, curve by curve."""
    return noises(fitted)


def noises(fitted: Fit) -> tuple[Noise, ...]:
    """The same within another program."""
    alone = [
        _noise(fitted, curve, r) for curve, r in zip(fitted.curves, fitted_residuals(fitted, fitted.q), strict=True)
    ]
    surprise = -sum(jnp.log(jnp.maximum(one.drift, jnp.finfo(one.lag_one.dtype).tiny)) for one in alone)
    together = jax.scipy.special.gammaincc(float(len(alone)), surprise)
    slower = [jnp.where(one.drift < 0.5, jnp.minimum(one.drift, together), one.drift) for one in alone]
    return tuple(_drifting(one, drift) for one, drift in zip(alone, slower, strict=True))


def _drifting(model: Noise, drift: Float[Array, ""]) -> Noise:
    """The noise with this probability of its slow part, and a walk only where that is small."""
    walk = jnp.where(drift < DRIFTS, model.walk, 0)
    return eqx.tree_at(lambda n: (n.walk, n.drift), model, (walk, drift))


def _noise(fitted: Fit, curve: Curve, r: Float[Array, " m"]) -> Noise:
    """The autoregression of the residuals r, or that of the input's noise if it describes them better."""
    own = autoregression(r)
    if not curve.fitted.regular:
        return own
    source, gain, first = fitted.model.as_input_noise(fitted.q, curve.fitted, r)
    other = autoregression(source)
    # Likelihoods of r: r = source/first + past samples.
    scores = _score(own, r.size), _score(other, r.size) - 2 * r.size * jnp.log(first)
    density = _density(other, jnp.pi * jnp.arange(gain.size, dtype=r.dtype) / r.size) * gain
    gain = gain / _mean(density)
    effective = r.size / (_density(other, jnp.zeros(1, r.dtype))[0] * gain[0])
    slow = other.slow, other.walk, other.drift
    other = Noise(own.order, other.coefficients, own.lag_one, effective, own.rms, other.innovation, *slow, gain)
    own = eqx.tree_at(lambda n: n.gain, own, jnp.ones_like(gain))
    return jax.tree.map(lambda a, b: jnp.where(scores[1] < scores[0], a, b), other, own)


def _score(model: Noise, m: int) -> Float[Array, ""]:
    """BIC, with the variance of each sample's innovation."""
    return m * jnp.log(model.innovation * model.rms**2) + model.order.astype(model.rms.dtype) * float(np.log(m))


def _mean(density: Float[Array, " w"]) -> Float[Array, ""]:
    """Over the whole circle, of a density at 0 … π: the variance."""
    return (jnp.sum(density) - (density[0] + density[-1]) / 2) / (density.size - 1)


def fitted_residuals(fit: Fit, q: Float[Array, " p"]) -> tuple[Float[Array, " _"], ...]:
    """Those of each curve, under the weights of the fit."""
    return tuple(curve_residuals(fit.model, c, w, q) for c, w in zip(fit.curves, fit.weights, strict=True))


def autoregression(r: Float[Array, " m"]) -> Noise:
    """Of one curve's residuals: Yule-Walker by Levinson's recursion, the order by BIC; its walk whatever `drift` is."""
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


def _slow(unit: Float[Array, " m"], known: Noise) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """`slow`, `walk` and `drift` of residuals with variance 1."""
    m = unit.size
    omega = jnp.pi * jnp.arange(1, min(_SLOW, m // 4) + 1, dtype=unit.dtype) / m
    energy = 2 / m * jnp.square(jnp.cos(omega[:, None] * (jnp.arange(m, dtype=unit.dtype) + 0.5)[None, :]) @ unit)
    density = _density(known, omega)
    slow = jnp.maximum(jnp.mean((energy / density)[_SLOWEST:]), 1) if omega.size > _SLOWEST else jnp.ones_like(unit[0])
    few = energy[:_SLOWEST]
    walk = jnp.sum(few - slow * density[:_SLOWEST]) / jnp.sum(omega[:_SLOWEST] ** -2)
    flat = energy[_SLOWEST : m // _PERIOD]
    if flat.size >= few.size:
        return slow, jnp.maximum(walk, 0), _exceeds(few, flat)
    rest = slow * density[:_SLOWEST]
    return slow, jnp.maximum(walk, 0), jax.scipy.special.gammaincc(few.size / 2, jnp.sum(few / rest) / 2)


def _exceeds(few: Float[Array, " a"], rest: Float[Array, " b"]) -> Float[Array, ""]:
    """Probability of cosines so much larger than the rest in noise that is flat below the fastest of them."""
    share = jnp.sum(rest) / (jnp.sum(rest) + jnp.sum(few))  # has a beta distribution
    return jax.scipy.special.betainc(rest.size / 2, few.size / 2, share)


def _density(model: Noise, omega: Float[Array, " w"]) -> Float[Array, " w"]:
    """Spectral density of the autoregression with variance 1 at `omega` (w,), rad a sample."""
    orders = jnp.arange(1, model.coefficients.size + 1, dtype=omega.dtype)
    phases = omega[:, None] * orders[None, :]
    real, imaginary = 1 - jnp.cos(phases) @ model.coefficients, jnp.sin(phases) @ model.coefficients
    return model.innovation / (real**2 + imaginary**2)


def filtered(slopes: Float[Array, "m p"], model: Noise) -> Float[Array, "p p"]:
    """Jᵀ Γ J for the autocovariance Γ of the residuals, over their variance, by its spectrum."""
    m = slopes.shape[0]
    length = 2 * m
    omega = jnp.pi * jnp.arange(m + 1, dtype=slopes.dtype) / m
    density = _density(model, omega) * jnp.where(omega <= jnp.pi * _SLOW / m, model.slow, 1)
    density = (density + model.walk / jnp.maximum(omega, _START / m) ** 2) * model.gain
    twice = jnp.full(density.size, 2.0, density.dtype).at[0].set(1).at[-1].set(1)
    waves = jnp.fft.rfft(slopes, length, axis=0)
    weight = (density * twice / length)[:, None]
    return waves.real.T @ (weight * waves.real) + waves.imag.T @ (weight * waves.imag)
