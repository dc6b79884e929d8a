"""Model of the force channel in a recorded test: a lag relative to the position, and a first-order low-pass filter.

The recorded force is F_r(t) = (A F)(t - d): d is the lag (negative where the position is late), A a low-pass filter of
first order with the time constant τ. Both are linear and time-invariant, so the recorded force is also that of the
position (A x)(t - d), and (A⁻¹ F_r)(t + d) the force of the recorded position. Between two samples a signal is taken as
a straight line, for which these formulas are exact:

    x(t + s)  = x + s·z·Δ (s >= 0),  x + s·Δ (s < 0),      Δ_n = x_n - x_{n-1},  |s| <= 1 sample
    A x       = x - g/(1 - e/z)·Δ,                          e = exp(-T/τ),  g = (1 - e)·τ/T
    A⁻¹ F     = F + g/((1 - g) + (g - e)/z)·Δ
    (A x)(t - f) = x - (f + τ·(1 - E)/T + E·g/(z - e))·Δ,   E = exp(-(T - f)/τ), 0 <= f < T

They act on the input of a curve, the position or the force of a creep test. Changes Δ that do not exceed the noise are
taken from a smoothed input (`without_noise`). A shift by a fraction of a sample averages two samples, and a filter
attenuates high frequencies: applied to the noise they would lower or raise the residuals, and bias the fitted lag and
filter. Units: lag in samples of T here and in coordinates, in ms under its name; corners 1/(2πτ) in Hz.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from hilbo.identification.fitting import Test
from hilbo.identification.recorded import AROUND, local_line
from hilbo.identification.rounding import step_of

__all__ = [
    "FASTEST_FILTER",
    "LARGEST_LAG",
    "SLOWEST_FILTER",
    "can_be_timed",
    "clear_changes",
    "is_fitted_in_force",
    "is_position_clearer",
    "multiplier",
    "without_noise",
]

LARGEST_LAG = 2  # samples, either way
SLOWEST_FILTER, FASTEST_FILTER = 5.0, 0.05  # time constants, samples
_CLEAR = 5.0  # standard deviations of the noise in a difference


def can_be_timed(tests: Sequence[Test]) -> bool:
    """Whether the input of any test has a significant row-to-row change, so that a lag can be estimated."""
    return any(bool(clear_changes(test.input).any()) for test in tests if test.input is not None)


def clear_changes(values: Float[np.ndarray, "R m"]) -> Bool[np.ndarray, " m"]:
    """Mask of the rows near which the mean of the repeats changes significantly from one row to the next.

    The row before the first one counts as 0; the 3 rows on either side of a change are included. The noise of a change
    is at least that of the quantisation step, since an encoder at rest shows no noise. `values` (R, m), any unit ->
    (m,).
    """
    mean, step = values.mean(axis=0), step_of(values)
    noise = max(_noise_of_change(mean), 0.0 if step is None else step / 6**0.5)
    clear = np.abs(np.diff(mean, prepend=0.0)) > _CLEAR * noise
    return np.convolve(clear, np.ones(2 * AROUND + 1), "same") > 0


def without_noise(values: Float[np.ndarray, "R m"], clear: Bool[np.ndarray, " m"]) -> Float[np.ndarray, "R m"]:
    """Input with the rows outside `clear` replaced by the local line through such rows around them.

    Noise of the input would bias the fitted stiffness towards 0, and shifting that noise would bias the lag. `values`
    (R, m) at even times, `clear` (m,): rows with a significant change, which stay as they are -> (R, m).
    """
    return np.where(clear, values, local_line(values, ~clear))


def is_position_clearer(test: Test) -> bool:
    """Whether the position has a higher ratio of its largest change to its noise than the force.

    The test must have a recorded input.
    """
    assert test.input is not None
    position, force = (test.input, test.output) if test.kind == "relaxation" else (test.output, test.input)
    return _clearness(position) > _clearness(force)


def is_fitted_in_force(test: Test) -> bool:
    """Whether a creep test is fitted with force as its output, because its force is the noisier channel.

    False for other tests.
    """
    return test.kind == "creep" and is_position_clearer(test)


def _clearness(values: Float[np.ndarray, "R m"]) -> float:
    """Ratio of the largest row-to-row change of the mean repeat to the noise of such a change; inf without noise."""
    mean = values.mean(axis=0)
    noise = _noise_of_change(mean)
    return float(np.max(np.abs(np.diff(mean, prepend=0.0))) / noise) if noise > 0 else np.inf


def _noise_of_change(mean: Float[np.ndarray, " m"]) -> float:
    """Standard deviation of the noise in a row-to-row change of `mean` (m,), from fourth differences."""
    # A fourth difference, which a smooth curve does not have, has the variance of 70 samples, a first one that of two.
    return float(1.4826 * np.median(np.abs(np.diff(mean, 4))) / np.sqrt(35))


def multiplier(
    on_position: bool, lag: Float[Array, ""], tau: Float[Array, ""] | None, z: Complex[Array, " w"]
) -> Complex[Array, " w"]:
    """Transfer factor of the input's changes by which lag and filter of the force channel alter the input.

    `lag`, `tau`: lag and time constant in samples; `tau` None: no filter. `on_position`: the input is the position,
    else the force. `z` (w,): points at which the transforms are evaluated -> (w,), dimensionless, to be multiplied by
    the changes and added to the input.
    """
    if tau is None:
        return _shift(-lag if on_position else lag, z)
    if on_position:
        return _late_filter(lag, tau, z)
    m = _shift(lag, z)
    e, g = (value.astype(z.dtype) for value in (jnp.exp(-1 / tau), tau * (1 - jnp.exp(-1 / tau))))
    inverse = g / ((1 - g) + (g - e) / z)
    return m + inverse * (1 + (1 - 1 / z) * m)


def _late_filter(lag: Float[Array, ""], tau: Float[Array, ""], z: Complex[Array, " w"]) -> Complex[Array, " w"]:
    """Multiplier of a first-order filter (time constant `tau`, samples) and a delay by `lag` samples combined.

    Exact for a signal that is linear between samples, also for a fractional lag: the delayed signal has its kinks
    between samples, so a filter for signals linear between samples must not be applied after the delay.
    """
    # At the largest lag the part is a whole sample, which the formula covers as well.
    whole = jnp.clip(jnp.floor(lag), -LARGEST_LAG, LARGEST_LAG - 1)
    part, m = lag - whole, _shift(-whole, z)
    e, g, decay = jnp.exp(-1 / tau), tau * (1 - jnp.exp(-1 / tau)), jnp.exp((part - 1) / tau)
    at_part, from_before, e = (value.astype(z.dtype) for value in (part + tau * (1 - decay), decay * g, e))
    return m - (1 + (1 - 1 / z) * m) * (at_part + from_before / (z - e))


def _shift(s: Float[Array, ""], z: Complex[Array, " w"]) -> Complex[Array, " w"]:
    """Multiplier of an advance by s samples (delay for s < 0), with linear interpolation between samples."""
    total, later, earlier = jnp.zeros_like(z), z, jnp.ones_like(z)
    for k in range(LARGEST_LAG):
        ahead, behind = (jnp.clip(value, 0, 1).astype(z.dtype) for value in (s - k, -s - k))
        total = total + ahead * later - behind * earlier
        later, earlier = later * z, earlier / z
    return total
