"""Quantisation error of a recorded channel, as by an encoder, and its contribution to the variance of the estimates.

The error of rounding to a step s, where the rounded value has moved by d between two rows, has the covariance

    s²/2·B₂({d/s}) = Σ_h s²/(2π²h²)·cos(2πh·d/s),      B₂(f) = f² - f + 1/6,

if the position within the step is uniformly distributed (Widrow & Kollár 2008, Quantization Noise, chapter 9). A
constant position has one error for the whole record, and so has a ramp that moves by a multiple of the step per row:
neither is visible in the residuals. White noise σ before the rounding multiplies term h by exp(-4π²h²σ²/s²): for more
than half a step of noise only white noise remains, which the residuals show.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hilbo.identification.fitting import Curve
from hilbo.identification.recorded import damping_radius, local_line

__all__ = ["Rounding", "rounding", "step_of", "variance_of_rounding"]

_HARMONICS = 4
_SMALLEST, _LARGEST = 1e-7, 5e-3  # step / range: smaller is float rounding, larger a programmed input
_SIZES = 3  # distinct row-to-row changes, which a recording has at least
_NEGLIGIBLE = 1e-3  # amplitude of the first harmonic after noise


class Rounding(eqx.Module):
    """Quantisation of one channel.

    `turns` (R, m): smoothed channel / step; `sizes` (H,): standard deviations of the harmonics.
    """

    turns: Float[Array, "R m"]
    sizes: Float[Array, " H"]


def rounding(values: Float[np.ndarray, "R m"], still: Bool[np.ndarray, " m"]) -> Rounding | None:
    """Quantisation of a channel with evenly timed rows; None if there is none or noise hides it.

    `values` (R, m), any unit; `still` (m,): rows without a significant change, from which the noise is estimated.
    """
    step = step_of(values)
    if step is None:
        return None
    # A fourth difference, which a smooth curve does not have, has the variance of 70 samples.
    flat = np.convolve(still, np.ones(5), "valid") == 5
    noise = np.square(np.diff(values, 4, axis=1)[:, flat]).mean() / 70 - step**2 / 12 if flat.any() else 0.0
    h = np.arange(1, _HARMONICS + 1)
    attenuation = np.exp(-4 * np.pi**2 * h**2 * max(noise, 0.0) / step**2)
    if attenuation[0] < _NEGLIGIBLE:
        return None
    turns = local_line(values, np.ones(values.shape[1], bool)) / step
    return Rounding(jnp.asarray(turns), jnp.asarray(step / (np.pi * h) * np.sqrt(attenuation / 2)))


def step_of(values: Float[np.ndarray, "R m"]) -> float | None:
    """Quantisation step of a recorded channel (smallest difference of distinct values); None if it is not quantised.

    `values` (R, m), any unit, as is the step. A programmed input has few distinct values too, but changes by few sizes
    from row to row: it counts as not quantised.
    """
    distinct = np.diff(np.unique(values))
    distinct = distinct[distinct > _SMALLEST * np.ptp(values)]
    if not distinct.size or distinct.min() > _LARGEST * np.ptp(values):
        return None
    step = float(distinct.min())
    sizes = np.unique(np.round(np.abs(np.diff(values, axis=1)) / step))
    return step if sizes.size >= _SIZES else None


def variance_of_rounding(
    model: Any, q: Float[Array, " p"], curve: Curve, weights: Float[Array, " R"], slopes: Float[Array, "m p"]
) -> Float[Array, "p p"]:
    """Variance (p, p) of Jᵀ r due to the quantisation of both channels of a curve, at coordinates `q`; 0 without any.

    `slopes` J (m, p).
    """
    total = jnp.zeros((q.size, q.size), q.dtype)
    to_residuals = slopes / (curve.scale * np.sqrt(curve.time.size))[:, None]

    def of_input(waves):
        damping = damping_radius(curve.length, q.dtype) ** -jnp.arange(waves.shape[1], dtype=q.dtype)
        spectra = jnp.fft.rfft(waves * damping[None, :], curve.length)
        alone = eqx.tree_at(
            lambda c: (c.spectra, c.changes, c.offset), curve, (spectra, jnp.zeros_like(spectra), jnp.zeros(2, q.dtype))
        )
        return jax.vmap(lambda w: model.predict(q, alone, w))(jnp.eye(2, dtype=q.dtype))

    for errors, response in ((curve.rounded_input, of_input), (curve.rounded_output, lambda waves: waves)):
        if errors is not None:
            total = total + _summed_variance(errors, weights, response, to_residuals)
    return total


def _summed_variance(
    errors: Rounding, weights: Float[Array, " R"], response: Any, to_residuals: Float[Array, "m p"]
) -> Any:
    """Variance (p, p) of Jᵀ r due to the quantisation of one channel, summed over repeats and harmonics.

    `response` maps quantisation errors (2, m) of the channel to the output, `to_residuals` that to Jᵀ r.
    """

    order = jnp.arange(1, errors.sizes.size + 1, dtype=errors.sizes.dtype)

    def one(which):
        repeat, harmonic = which
        angle = 2 * jnp.pi * order[harmonic] * errors.turns[repeat]
        pull = response(jnp.stack([jnp.cos(angle), jnp.sin(angle)])) @ to_residuals
        return jnp.square(errors.sizes[harmonic] * weights[repeat]) * pull.T @ pull

    repeats, harmonics = jnp.meshgrid(jnp.arange(weights.size), jnp.arange(errors.sizes.size))
    return jnp.sum(jax.lax.map(one, (repeats.ravel(), harmonics.ravel())), axis=0)
